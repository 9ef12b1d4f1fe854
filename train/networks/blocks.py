"""Bases of all networks and losses; a loss is relative to each pattern's size, so light contacts count."""

from collections.abc import Callable
from typing import Final

import torch
from torch import Tensor, nn

from train.data.press_batches import Batch

Loss = Callable[[nn.Module, Batch], Tensor]
"""Function from a network in training and a batch to a scalar."""
_LEAST_TRUTH_MM: Final = 1e-4
"""Least RMS of a truth, in [mm]; smaller ones count as this, because a micrometre deep is no contact."""
_LEAST_SHARE_SQUARED: Final = 1e-6
"""Term added below the root, whose slope at 0 is unbounded."""


class PatternNet(nn.Module):
    """Network from windows (n, 3K, rows, cols) in network units, newest tap first, to patterns (n, H, W) in [mm].

    Attributes:
        taps: K.
        scale: pattern pixels per taxel pitch.
        known: numbers that it takes of the pad's constants.
        takes_poses: True if it takes the poses of the taps as well, and any number of taps up to K.
    """

    taps: int
    scale: int
    known: int = 0
    takes_poses: bool = False

    def take_over(self, start: "PatternNet") -> None:
        """Copy another network's weights; RuntimeError or ValueError if they do not fit."""
        self.load_state_dict(start.state_dict())


class Residual(nn.Module):
    """Two convolutions parallel to an identity path; without normalisation, so that amplitudes pass."""

    def __init__(self, convolution: Callable[[], nn.Module]) -> None:
        super().__init__()
        self.body = nn.Sequential(convolution(), nn.ReLU(), convolution())

    def forward(self, x: Tensor) -> Tensor:
        """Return maps of the same shape, (n, channels, H, W)."""
        return torch.relu(x + self.body(x))


def pattern_loss(net: nn.Module, batch: Batch) -> Tensor:
    """Return the loss of a network that predicts a pattern alone: the relative error."""
    return relative_error(net(batch.window).float(), batch.pattern)


def relative_error(patterns: Tensor, truth: Tensor) -> Tensor:
    """Return the mean over (n, H, W) of each pattern's mean absolute error as a share of its truth's RMS."""
    return ((patterns - truth).abs() / truth_size(truth)).mean()


def relative_rms_error(patterns: Tensor, truth: Tensor) -> Tensor:
    """Return the mean over (n, H, W) of each pattern's RMS error as a share of its truth's RMS.

    Its minimum is near the mean of the possible patterns, which gains .1 dB over their median (docs/decisions.md).
    """
    share = (patterns - truth) / truth_size(truth)
    return (share.square().mean(dim=(1, 2)) + _LEAST_SHARE_SQUARED).sqrt().mean()


def truth_size(truth: Tensor) -> Tensor:
    """Return the RMS of each pattern of (n, H, W), bounded below, as (n, 1, 1) in [mm]."""
    return truth.square().mean(dim=(1, 2), keepdim=True).sqrt().clamp_min(_LEAST_TRUTH_MM)
