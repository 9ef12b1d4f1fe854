"""Correction of a network's deviations, so that their intervals hold in every region of a pattern.

A deviation alone has one bias in the contact and another around it, and one for a contact that covers the pad and
another for a wire. The correction multiplies it by one of four factors, by the pixel's region; a small network
computes the four from a summary of the window. It is part of the graph, so everything reads corrected deviations.
"""

from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from edge.inference.intervals import near_pixels
from firmware_bridge.pad_geometry import USPA44

_HIDDEN: Final = 32
_MOST_INPUT: Final = 4.0
"""Bound of an input in standard deviations over the training presses, so that nothing unlike them is extrapolated."""
LOG_RANGE: Final = (-1.5, 2.5)
"""Bounds of a factor's logarithm: a window unlike all others widens its intervals twelvefold at most."""
_MASKS: Final = 3
_OF_REGIONS: Final = torch.tensor([[1.0, 1, 0, 1], [1, 1, 1, 1], [1, 0, 1, 1], [0, 0, 1, 1]])
"""Masks that hold a region, in the order of REGIONS, and 1 for all pixels."""


class IntervalCorrection(nn.Module):
    """Factors on the deviations of a compact network, by region.

    A factor's logarithm is the sum of what three overlapping masks add, and of what all pixels have: the four
    regions in the fewest steps of a graph. Of the `features`, so many consecutive ones as there are `symmetries` are
    permuted by these, which do not change their mean; `about` is the number of the pad's inputs and the amplitude.

    Attributes:
        near: pixels outside the contact that are near it.
        contact_level: share of a pattern's maximum from which a pixel counts as touched.
        centre: mean of each input over the training presses; `spread` is the standard deviation.
    """

    contact_level: Tensor
    centre: Tensor
    spread: Tensor

    def __init__(self, scale: int, features: int, symmetries: int, about: int, taps: int) -> None:
        super().__init__()
        self.near = near_pixels(scale, USPA44.pitch_mm)
        self._symmetries = symmetries
        inputs = features // symmetries + about + _MASKS + 2 + taps - 1
        self.register_buffer("contact_level", torch.tensor(0.5))
        self.register_buffer("centre", torch.zeros(inputs))
        self.register_buffer("spread", torch.ones(inputs))
        self.enter = nn.Linear(inputs, _HIDDEN)
        # The number of taps enters again here, for a shift of each number's own.
        self.leave = nn.Linear(_HIDDEN + taps - 1, _MASKS + 1)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def forward(self, features: Tensor, pattern: Tensor, deviation: Tensor, about: Tensor, later: Tensor) -> Tensor:
        """Return the factors on the deviations, (n, H, W) above zero; arguments as `summary`."""
        masks, summary = self.summary(features, pattern, deviation, about, later)
        steps, base = self.steps(summary, later).split([_MASKS, 1], dim=1)
        log_factor = (steps[:, None] @ masks.flatten(2)).view_as(deviation) + base[:, :, None]
        return torch.exp(log_factor.clamp(*LOG_RANGE))

    def masks(self, pattern: Tensor, peak: Tensor) -> Tensor:
        """Return (n, 3, H, W): pixels near the contact or in it, at its edge or inside, and those not inside."""
        touched = (pattern > self.contact_level * peak).to(pattern.dtype)[:, None]
        near = F.max_pool2d(touched, 2 * self.near + 1, 1, self.near)
        return torch.cat([near, F.max_pool2d(touched, 3, 1, 1), F.max_pool2d(1 - touched, 3, 1, 1)], dim=1)

    def summary(
        self, features: Tensor, pattern: Tensor, deviation: Tensor, about: Tensor, later: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the masks (n, 3, H, W), and the inputs of the factors, (n, inputs).

        Args:
            features: (n, channels, h, w).
            pattern: (n, H, W), cut at zero, of a tap of amplitude 1.
            deviation: (n, H, W) to be corrected, of a tap of amplitude 1.
            about: (n, ...), the pad's inputs and the bounded amplitude.
            later: (n, K - 1), 1 for each earlier tap that is there, else 0.
        """
        peak = pattern.amax(dim=(1, 2), keepdim=True)
        masks = self.masks(pattern, peak)
        count, channels = features.shape[:2]  # not len(), which a traced graph would hold as a constant
        means = features.reshape(count, channels // self._symmetries, -1).mean(dim=2)
        spread = deviation.mean(dim=(1, 2))[:, None]
        return masks, torch.cat([means, about, masks.mean(dim=(2, 3)), peak[:, :, 0], spread, later], dim=1)

    def steps(self, summary: Tensor, later: Tensor) -> Tensor:
        """Return what each mask adds to the logarithm of the factors, then what all pixels have, (n, 4)."""
        inputs = ((summary - self.centre) / self.spread).clamp(-_MOST_INPUT, _MOST_INPUT)
        hidden = torch.relu(self.enter(inputs))
        return self.leave(torch.cat([hidden, later], dim=1))

    def log_factors(self, summary: Tensor, later: Tensor) -> Tensor:
        """Return the logarithms of the factors in the order of REGIONS, (n, 4), not bounded."""
        return self.steps(summary, later) @ _OF_REGIONS.T

    @torch.no_grad()
    def shift(self, taps: int, log_shift: Tensor) -> None:
        """Add to the logarithms of the factors in the order of REGIONS, (4,), of windows with exactly `taps` taps."""
        steps = torch.linalg.solve(_OF_REGIONS, log_shift)
        if taps == 1:
            self.leave.bias += steps
        else:
            self.leave.weight[:, _HIDDEN + taps - 2] += steps
        if taps < self.leave.in_features - _HIDDEN + 1:
            self.leave.weight[:, _HIDDEN + taps - 1] -= steps
