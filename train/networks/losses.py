"""Losses relative to each pattern's size, so that light contacts weigh as much as firm ones."""

from typing import Any, Final

from torch import Tensor, nn

from train.data.batches import Batch

_LEAST_TRUTH_MM: Final = 1e-4
"""Least RMS of a truth, in [mm]; smaller ones count as this, because a micrometre deep is no contact."""
_LEAST_SHARE_SQUARED: Final = 1e-6
"""Term added below the root, whose slope at 0 is unbounded."""


def relative_error(patterns: Tensor, truth: Tensor) -> Tensor:
    """Return the mean over (n, H, W) of each pattern's mean absolute error as a share of its truth's RMS."""
    return ((patterns - truth).abs() / truth_size(truth)).mean()


def relative_rms_error(patterns: Tensor, truth: Tensor) -> Tensor:
    """Return the mean over (n, H, W) of each pattern's RMS error as a share of its truth's RMS.

    Its minimum is near the mean of the possible patterns, that of the mean absolute error at their median; it gains .1
    dB (docs/decisions.md).
    """
    share = (patterns - truth) / truth_size(truth)
    return (share.square().mean(dim=(1, 2)) + _LEAST_SHARE_SQUARED).sqrt().mean()


def truth_size(truth: Tensor) -> Tensor:
    """Return the RMS of each pattern of (n, H, W), bounded below, as (n, 1, 1) in [mm]."""
    return truth.square().mean(dim=(1, 2), keepdim=True).sqrt().clamp_min(_LEAST_TRUTH_MM)


class RelativeError:
    """Objective of a network that predicts a pattern alone."""

    def loss(self, net: nn.Module, batch: Batch) -> Tensor:
        """Return the relative error of the patterns."""
        return relative_error(net(batch.window).float(), batch.pattern)

    def after_step(self) -> None:
        """Do nothing, because the objective has no network of its own."""

    def state_dict(self) -> dict[str, Any]:
        """Return an empty state."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load nothing."""
