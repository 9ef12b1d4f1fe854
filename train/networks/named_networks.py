"""Networks by name, each with its width; those of the bundled models are in `train.fit.BUNDLED`."""

from collections.abc import Callable
from typing import Any, Final

from train.errors import CheckpointError
from train.networks.blocks import PatternNet
from train.networks.compact import CompactNet
from train.networks.fusion import FusionNet
from train.networks.published import SeedNet, TactileSRCNN, TactileSRGAN
from train.surfaces.poses import MAX_TAPS

_TAPS: Final = {"stsr": 1} | {f"mtsr{taps}": taps for taps in range(2, MAX_TAPS + 1)}
_WIDE: Final = {"channels": 64, "blocks": 6}

# Class of each network, and the arguments that options may replace, by name.
NETWORKS: Final[dict[str, tuple[Callable[..., PatternNet], dict[str, int]]]] = {
    "srcnn": (TactileSRCNN, {}),
    "srgan": (TactileSRGAN, {}),
    **{name: (SeedNet, {"taps": taps}) for name, taps in _TAPS.items()},
    "compact-stsr": (CompactNet, _WIDE),
    **{f"fusion-{name}": (FusionNet, {"taps": taps} | _WIDE) for name, taps in _TAPS.items() if taps > 1},
    "small-stsr": (CompactNet, {"channels": 32, "blocks": 4}),  # a quarter of the work
}


def build(name: str, scale: int, **options: Any) -> PatternNet:
    """Build a new network; CheckpointError if there is none of that name, or an option is out of range."""
    if name not in NETWORKS:
        raise CheckpointError(f"no network {name!r}, expected one of {', '.join(NETWORKS)}")
    make, says = NETWORKS[name]
    return make(scale=scale, **says | options)


def grown(start: PatternNet, name: str, scale: int, **options: Any) -> PatternNet:
    """Build a new network that starts from copies of another's weights; CheckpointError if the weights do not fit."""
    net = build(name, scale, **options)
    try:
        net.take_over(start)
    except (ValueError, RuntimeError) as error:
        kind = f"a {type(start).__name__} of {start.taps} taps at scale {start.scale}"
        raise CheckpointError(f"{name} at scale {scale} cannot start from {kind}: {error}") from error
    return net
