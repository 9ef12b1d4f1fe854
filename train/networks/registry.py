"""Networks by name."""

from collections.abc import Callable
from typing import Any, Final

from train.networks.blocks import PatternNet
from train.networks.compact import CompactNet
from train.networks.fusion import FusionNet
from train.networks.published import MAX_TAPS, SeedNet, TactileSRCNN, TactileSRGAN

_TAPS: Final = {"stsr": 1} | {f"mtsr{taps}": taps for taps in range(2, MAX_TAPS + 1)}

_SMALL: Final = {"channels": 32, "blocks": 4}
"""Options of a compact network with a quarter of the work, for a smaller time budget."""

NETWORKS: Final[dict[str, tuple[Callable[..., PatternNet], dict[str, int]]]] = {
    "srcnn": (TactileSRCNN, {}),
    "srgan": (TactileSRGAN, {}),
    **{name: (SeedNet, {"taps": taps}) for name, taps in _TAPS.items()},
    **{f"compact-{name}": (CompactNet, {"taps": taps}) for name, taps in _TAPS.items()},
    **{f"fusion-{name}": (FusionNet, {"taps": taps}) for name, taps in _TAPS.items() if taps > 1},
    **{f"small-{name}": (CompactNet, {"taps": taps} | _SMALL) for name, taps in _TAPS.items()},
}
"""Class and fixed arguments of each network, by name."""


def build(name: str, scale: int, **options: Any) -> PatternNet:
    """Build a new network.

    Raises:
        ValueError: no network of that name; or scale or an option is out of range.
    """
    if name not in NETWORKS:
        raise ValueError(f"no network {name!r}, expected one of {', '.join(NETWORKS)}")
    make, says = NETWORKS[name]
    return make(scale=scale, **says, **options)


def grown(start: PatternNet, name: str, scale: int, **options: Any) -> PatternNet:
    """Build a new network that starts from copies of another's weights.

    An MTSR-K can start from an STSR, a compact network from one of any taps, and any from its own kind. At
    another scale a compact network keeps its trunk, and its output layers are initialised again.

    Raises:
        ValueError: as `build`, or the weights do not fit.
    """
    net = build(name, scale, **options)
    if isinstance(net, CompactNet) and isinstance(start, CompactNet):
        try:
            net.take_over(start)
        except ValueError as error:
            raise ValueError(f"{name} at scale {scale} cannot start from {_kind(start)}: {error}") from error
        return net
    if isinstance(net, SeedNet) and isinstance(start, SeedNet) and start.taps == 1:
        start = SeedNet.from_stsr(start, net.taps)
    try:
        net.load_state_dict(start.state_dict())
    except RuntimeError as error:
        raise ValueError(f"{name} at scale {scale} cannot start from {_kind(start)}: {error}") from error
    return net


def _kind(net: PatternNet) -> str:
    return f"a {type(net).__name__} of {net.taps} taps at scale {net.scale}"
