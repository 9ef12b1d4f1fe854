"""Blocks and losses shared by several networks; a loss is relative to each pattern's size, so light contacts count."""

from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from train.data.press_batches import Batch

MM_PER_UNIT: Final = 0.02
"""Size of an output of 1 of the published networks, in [mm].

They were made for patterns of up to 25, while those here reach 0.5 mm: with this unit their initial weights give
patterns of the same size relative to the truth.
"""

_NORM_START: Final = 0.1
"""Initial scale and shift of batch normalisation, as in the authors' code."""


class PatternNet(nn.Module):
    """Network from windows (n, 3K, rows, cols) in network units to patterns (n, rows*scale, cols*scale) in [mm].

    The newest tap comes first in a window.

    Attributes:
        taps: K.
        scale: pattern pixels per taxel pitch.
        takes_poses: True if it takes the poses of the taps as well, and any number of taps up to K.
    """

    taps: int
    scale: int
    takes_poses: bool = False


class Residual(nn.Module):
    """Two 3 x 3 convolutions parallel to an identity path; without normalisation, so that amplitudes pass."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU(), nn.Conv2d(channels, channels, 3, padding=1)
        )

    def forward(self, x: Tensor) -> Tensor:
        """Return maps of the same shape, (n, channels, H, W)."""
        return torch.relu(x + self.body(x))


class MultiScaleResidual(nn.Module):
    """3 x 3 and 5 x 5 paths, exchanged half-way, fused by a 1 x 1 convolution parallel to an identity path.

    Source: Li et al. 2018 (MSRN), Fig. 2, with batch normalisation after each of the four convolutions as in Wu and Liu
    2024.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fine = normed_conv(channels, channels, 3, bias=True)
        self.coarse = normed_conv(channels, channels, 5, bias=True)
        self.fine_of_both = normed_conv(2 * channels, 2 * channels, 3, bias=True)
        self.coarse_of_both = normed_conv(2 * channels, 2 * channels, 5, bias=True)
        self.fuse = nn.Conv2d(4 * channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return maps of the same shape, (n, channels, H, W)."""
        both = torch.cat([self.fine(x), self.coarse(x)], dim=1)
        both = torch.cat([self.fine_of_both(both), self.coarse_of_both(both)], dim=1)
        return torch.relu(x + self.fuse(both))


def normed_conv(inputs: int, outputs: int, kernel: int, *, bias: bool = False) -> nn.Sequential:
    """Build a convolution that keeps the size, batch normalisation, and ReLU.

    Normalisation makes a bias redundant; the authors' blocks have one nevertheless, and parameters are counted with it.
    """
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2, bias=bias), nn.BatchNorm2d(outputs), nn.ReLU()
    )


def initialise(net: nn.Module) -> None:
    """Initialise the weights of a published network.

    Source: He et al. 2015, normal, by fan-out.
    """
    for module in net.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        elif isinstance(module, nn.BatchNorm2d):
            nn.init.constant_(module.weight, _NORM_START)
            nn.init.constant_(module.bias, _NORM_START)


def upsample(window: Tensor, scale: int) -> Tensor:
    """Interpolate bilinearly to (n, C, rows*scale, cols*scale), aligned as in the classical methods."""
    return F.interpolate(window, scale_factor=scale, mode="bilinear", align_corners=False)


def to_pattern(output: Tensor, *, training: bool) -> Tensor:
    """Convert a published network's last convolution, (n, 1, H, W), to patterns (n, H, W) in [mm].

    Patterns are cut at zero in evaluation but not in training. The published ones are cut in both: without a bias and
    with positive features only, the last convolution starts below zero everywhere for 3 of 16 seeds tried, and would
    never learn.
    """
    pattern = output[:, 0].float() * MM_PER_UNIT
    return pattern if training else torch.relu(pattern)


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
