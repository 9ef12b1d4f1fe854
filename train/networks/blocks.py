"""Bases of all networks and objectives; a loss is relative to each pattern's size, so light contacts count."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from train.data.press_batches import Batch


class PatternNet(nn.Module):
    """Network from windows (n, 3K, rows, cols) in network units, newest tap first, to patterns (n, H, W) in [mm]."""

    taps: int  # K
    scale: int  # pattern pixels per taxel pitch
    known: int = 0  # numbers that it takes of the pad's constants
    takes_poses: bool = False  # those of the taps as well, and any number of taps up to K

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


class Objective:
    """Loss function of a training. One with networks of its own, such as a discriminator, trains and keeps them."""

    def loss(self, net: nn.Module, batch: Batch) -> Tensor:
        """Return the scalar loss of a batch."""
        raise NotImplementedError

    def after_step(self) -> None:
        """Update the objective's own networks after the network has taken its step."""

    def state_dict(self) -> dict[str, Any]:
        """Return all learned state."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore learned state."""


class RelativeError(Objective):
    """Objective of a network that predicts a pattern alone."""

    def loss(self, net: nn.Module, batch: Batch) -> Tensor:
        """Return the relative error of the patterns."""
        return relative_error(net(batch.window).float(), batch.pattern)


def relative_error(patterns: Tensor, truth: Tensor) -> Tensor:
    """Return the mean over (n, H, W) of each pattern's mean absolute error as a share of its truth's RMS."""
    return ((patterns - truth).abs() / truth_size(truth)).mean()


def relative_rms_errors(patterns: Tensor, truth: Tensor) -> Tensor:
    """Return each pattern's RMS error as a share of its truth's RMS, (n,), of patterns (n, H, W).

    Its minimum is near the mean of the possible patterns, which gains 0.1 dB over their median (docs/decisions.md).
    """
    share = (patterns - truth) / truth_size(truth)
    return (share.square().mean(dim=(1, 2)) + 1e-6).sqrt()  # the root's slope at 0 is unbounded


def truth_size(truth: Tensor) -> Tensor:
    """Return the RMS of each pattern of (n, H, W), bounded below, as (n, 1, 1) in [mm]."""
    # A tenth of a micrometre deep is no contact.
    return truth.square().mean(dim=(1, 2), keepdim=True).sqrt().clamp_min(1e-4)
