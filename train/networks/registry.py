"""Networks by name."""

from collections.abc import Callable
from typing import Any, Final

from train.networks.blocks import PatternNet
from train.networks.compact import CompactNet
from train.networks.seed import MAX_TAPS, SeedNet
from train.networks.srcnn import TactileSRCNN
from train.networks.srgan import TactileSRGAN

_TAPS: Final = {"stsr": 1} | {f"mtsr{taps}": taps for taps in range(2, MAX_TAPS + 1)}

_SMALL: Final = {"channels": 32, "blocks": 4}
"""A compact network of a quarter of the work, for a budget that the other does not fit."""

NETWORKS: Final[dict[str, tuple[Callable[..., PatternNet], dict[str, int]]]] = {
    "srcnn": (TactileSRCNN, {}),
    "srgan": (TactileSRGAN, {}),
    **{name: (SeedNet, {"taps": taps}) for name, taps in _TAPS.items()},
    **{f"compact-{name}": (CompactNet, {"taps": taps}) for name, taps in _TAPS.items()},
    **{f"small-{name}": (CompactNet, {"taps": taps} | _SMALL) for name, taps in _TAPS.items()},
}
"""Name to class and what the name says."""

_PIXELS: Final = ("leave.2.", "doubt.2.")
"""The layers of a compact network whose size is that of a taxel's pixels."""


def build(name: str, scale: int, **options: Any) -> PatternNet:
    """A new network.

    Args:
        name: one of NETWORKS.
        scale: pattern pixels per taxel pitch.
        options: further arguments of its class.

    Raises:
        ValueError: no network of that name; or scale or an option is out of range.
    """
    if name not in NETWORKS:
        raise ValueError(f"no network {name!r}, expected one of {', '.join(NETWORKS)}")
    make, says = NETWORKS[name]
    return make(scale=scale, **says, **options)


def grown(start: PatternNet, name: str, scale: int, **options: Any) -> PatternNet:
    """A new network that starts from another's weights, in copies of its own.

    An MTSR-K can start from an STSR, a compact network from one of any taps, and any from its own kind. At
    another scale a compact network keeps its trunk, and what makes pixels of it starts anew.

    Args:
        start: whose weights.
        name: one of NETWORKS.
        scale: pattern pixels per taxel pitch.
        options: further arguments of its class.

    Raises:
        ValueError: as `build`, or the weights do not fit.
    """
    net = build(name, scale, **options)
    if isinstance(net, CompactNet) and isinstance(start, CompactNet):
        resized = start.with_fewer_taps if net.taps <= start.taps else start.with_more_taps
        start = resized(net.taps)
    elif isinstance(net, SeedNet) and isinstance(start, SeedNet) and start.taps == 1:
        start = SeedNet.from_stsr(start, net.taps)
    learnt = start.state_dict()
    if isinstance(net, CompactNet) and start.scale != scale:
        fresh = net.state_dict()
        learnt |= {key: value for key, value in fresh.items() if key.startswith(_PIXELS)}
    try:
        net.load_state_dict(learnt)
    except RuntimeError as error:
        kind = f"{type(start).__name__} of {start.taps} taps at scale {start.scale}"
        raise ValueError(f"{name} at scale {scale} cannot start from a {kind}: {error}") from error
    return net
