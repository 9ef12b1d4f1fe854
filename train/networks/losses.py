"""What networks are trained for: error relative to each pattern's size, so that light contacts count as firm ones."""

from typing import Any, Final

from torch import Tensor, nn

from train.data.batch import Batch

_LEAST_TRUTH_MM: Final = 1e-4
"""RMS below which a truth counts as this large: a micrometre's contact is no contact."""
_LEAST_SHARE_SQUARED: Final = 1e-6
"""Added below the root, whose slope at 0 knows no bounds."""


def relative_error(patterns: Tensor, truth: Tensor) -> Tensor:
    """Mean over (n, H, W) of each pattern's mean absolute error as a share of its truth's RMS."""
    return ((patterns - truth).abs() / truth_size(truth)).mean()


def relative_rms_error(patterns: Tensor, truth: Tensor) -> Tensor:
    """Mean over (n, H, W) of each pattern's RMS error as a share of its truth's RMS: it draws the mean of what may be.

    Against the mean absolute error, that draws the median, it gains .1 dB (docs/log.md).
    """
    share = (patterns - truth) / truth_size(truth)
    return (share.square().mean(dim=(1, 2)) + _LEAST_SHARE_SQUARED).sqrt().mean()


def truth_size(truth: Tensor) -> Tensor:
    """RMS of each pattern of (n, H, W), or the least that counts, as (n, 1, 1) in [mm]."""
    return truth.square().mean(dim=(1, 2), keepdim=True).sqrt().clamp_min(_LEAST_TRUTH_MM)


class RelativeError:
    """Objective of a network that gives a pattern alone."""

    def loss(self, net: nn.Module, batch: Batch) -> Tensor:
        """Relative error of the patterns."""
        return relative_error(net(batch.window).float(), batch.pattern)

    def after_step(self) -> None:
        """Nothing of its own to train."""

    def state_dict(self) -> dict[str, Any]:
        """Nothing learnt."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing to load."""
