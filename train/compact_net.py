"""The compact network: a trunk at twice the taxel grid, grown to the pattern by pixel shuffle.

Against the seed's network (Wu and Liu 2024, Fig. 8) it keeps the two branches, pattern from all taps and force from
the newest one, and leaves out the work at full resolution and batch normalisation, which cost 8 dB here
(docs/log.md).
"""

from typing import Final

import torch
from torch import Tensor, nn

_QUIET_UNITS: Final = 0.02
"""Added to a tap's amplitude before it divides the tap, in network units: noise and absent taps stay small."""


class CompactNet(nn.Module):
    """Window of K taps to pattern.

    A tap enters the pattern branch divided by its own amplitude, and the newest tap's amplitude multiplies the
    result: a flat contact's pattern is linear in its force, so the trunk has to learn shapes alone, and no force is out
    of its range. An absent tap is all zeros and stays so.

    Args:
        taps: K.
        scale: pattern pixels per taxel pitch, even.
        channels: of the trunk.
        blocks: residual blocks of the trunk.
    """

    def __init__(self, taps: int, scale: int, channels: int = 64, blocks: int = 6) -> None:
        super().__init__()
        if scale % 2:
            raise ValueError(f"scale is {scale}, expected an even number: the trunk works at twice the taxel grid")
        self.taps = taps
        self._settings = (scale, channels, blocks)
        merged, force_channels, grow = channels * 3 // 2, channels // 2, scale // 2
        # Two 3 x 3 convolutions see nearly all of 4 x 4 taxels: where taps are brought together, turned as they are.
        self.enter = nn.Conv2d(3 * taps, merged, 3, padding=1)
        self.merge = nn.Sequential(
            nn.ReLU(),
            nn.Conv2d(merged, merged, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(merged, 4 * channels, 1),
            nn.PixelShuffle(2),
            nn.ReLU(),
        )
        self.trunk = nn.Sequential(*(_Residual(channels) for _ in range(blocks)))
        self.force = nn.Sequential(
            nn.Conv2d(3, force_channels, 3, padding=1),
            nn.ReLU(),
            _Residual(force_channels),
            nn.Conv2d(force_channels, 4 * force_channels, 1),
            nn.PixelShuffle(2),
        )
        self.leave = nn.Sequential(
            nn.Conv2d(channels + force_channels, 2 * channels, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(2 * channels, grow * grow, 3, padding=1),
            nn.PixelShuffle(grow),
        )

    def forward(self, window: Tensor) -> Tensor:
        """Patterns (n, H, W) in the output unit, of windows (n, 3K, rows, cols) in network units, newest tap first.

        Patterns are cut at zero in use but not in training: a sub-pixel that is cut everywhere would never learn again.
        """
        count, _, rows, cols = window.shape
        taps = window.view(count, self.taps, 3, rows, cols)
        amplitude = taps.square().mean(dim=(2, 3, 4), keepdim=True).sqrt() + _QUIET_UNITS
        shapes = (taps / amplitude).view(count, 3 * self.taps, rows, cols)
        pattern = self.trunk(self.merge(self.enter(shapes)))
        force = self.force(shapes[:, :3])
        pattern = self.leave(torch.cat([pattern, force], dim=1))[:, 0] * amplitude[:, 0, 0]
        return pattern if self.training else torch.relu(pattern)

    def with_fewer_taps(self, taps: int) -> "CompactNet":
        """The same function of the newest `taps` taps, the others absent; its own weights."""
        if not 1 <= taps <= self.taps:
            raise ValueError(f"{taps} taps asked for, expected 1 to {self.taps}")
        state = {name: value.clone() for name, value in self.state_dict().items()}
        state["enter.weight"] = state["enter.weight"][:, : 3 * taps]
        smaller = CompactNet(taps, *self._settings)
        smaller.load_state_dict(state)
        return smaller


class _Residual(nn.Module):
    """Two 3 x 3 convolutions beside a straight path."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU(), nn.Conv2d(channels, channels, 3, padding=1)
        )

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x + self.body(x))
