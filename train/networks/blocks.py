"""What several networks are built of."""

from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F

MM_PER_UNIT: Final = 0.02
"""What an output of 1 stands for in the published networks, in [mm].

They were made for patterns that reach 25, ours reach 0.5 mm: their first weights then give patterns of the same size
beside the truth as there.
"""

_NORM_START: Final = 0.1
"""First scale and shift of batch normalisation, as in the authors' code."""


class PatternNet(nn.Module):
    """Windows (n, 3K, rows, cols) in network units, newest tap first, to patterns (n, rows*scale, cols*scale) in [mm].

    Attributes:
        taps: K.
        scale: pattern pixels per taxel pitch.
    """

    taps: int
    scale: int


class Residual(nn.Module):
    """Two 3 x 3 convolutions beside a straight path; no normalisation, so amplitudes pass."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU(), nn.Conv2d(channels, channels, 3, padding=1)
        )

    def forward(self, x: Tensor) -> Tensor:
        """The same shape, (n, channels, H, W)."""
        return torch.relu(x + self.body(x))


class MultiScaleResidual(nn.Module):
    """3 x 3 and 5 x 5 paths, exchanged half-way, fused by a 1 x 1 convolution beside a straight path.

    Source: Li et al. 2018 (MSRN), Fig. 2, with batch normalisation after each of the four convolutions as Wu and Liu
    2024 have it.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fine = normed_conv(channels, channels, 3, bias=True)
        self.coarse = normed_conv(channels, channels, 5, bias=True)
        self.fine_of_both = normed_conv(2 * channels, 2 * channels, 3, bias=True)
        self.coarse_of_both = normed_conv(2 * channels, 2 * channels, 5, bias=True)
        self.fuse = nn.Conv2d(4 * channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """The same shape, (n, channels, H, W)."""
        both = torch.cat([self.fine(x), self.coarse(x)], dim=1)
        both = torch.cat([self.fine_of_both(both), self.coarse_of_both(both)], dim=1)
        return torch.relu(x + self.fuse(both))


def normed_conv(inputs: int, outputs: int, kernel: int, *, bias: bool = False) -> nn.Sequential:
    """Convolution that keeps the size, batch normalisation, ReLU.

    The norm makes a bias idle; the authors' blocks have one all the same, and parameters are counted with it.
    """
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2, bias=bias), nn.BatchNorm2d(outputs), nn.ReLU()
    )


def initialise(net: nn.Module) -> None:
    """Draw the first weights of a published network.

    Source: He et al. 2015, normal, by fan-out.
    """
    for module in net.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        elif isinstance(module, nn.BatchNorm2d):
            nn.init.constant_(module.weight, _NORM_START)
            nn.init.constant_(module.bias, _NORM_START)


def upsample(window: Tensor, scale: int) -> Tensor:
    """Bilinear, (n, C, rows, cols) to (n, C, rows*scale, cols*scale); aligned as that of the classical methods."""
    return F.interpolate(window, scale_factor=scale, mode="bilinear", align_corners=False)


def to_pattern(output: Tensor, *, training: bool) -> Tensor:
    """Patterns (n, H, W) in [mm] of a published network's last convolution, (n, 1, H, W).

    Cut at zero in use but not in training. The published ones are cut in both: with no bias and only positive features
    before it, the last convolution starts below zero everywhere for 3 of 16 seeds tried, and would then never learn.
    """
    pattern = output[:, 0].float() * MM_PER_UNIT
    return pattern if training else torch.relu(pattern)
