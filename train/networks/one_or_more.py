"""Pair of networks, for a single tap and for several: a single tap keeps its own network's time and error."""

from torch import Tensor

from train.networks.blocks import PatternNet

_APART = 5
"""Dimensions of a window whose taps have a dimension of their own."""


class OneOrMoreNet(PatternNet):
    """Network that gives windows of one tap to one network and all others to another, which takes poses.

    Args:
        one: of one tap.
        more: of 2 to K taps.
    """

    takes_poses = True

    def __init__(self, one: PatternNet, more: PatternNet) -> None:
        super().__init__()
        self.one, self.more = one, more
        self.taps, self.scale, self.known = more.taps, more.scale, getattr(more, "known", 0)

    def forward(
        self, window: Tensor, pad: Tensor | None = None, poses: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the outputs of the network for so many taps; arguments as `FusionNet.forward`."""
        apart = window.ndim == _APART
        if window.shape[1] == (1 if apart else 3):
            return self.one(window[:, 0] if apart else window, pad)
        return self.more(window, pad, poses)
