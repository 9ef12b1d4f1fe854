"""STSR and MTSR-K as published, the networks to compare with.

Source: Wu and Liu 2024, Section V and Fig. 8; channels and biases follow from the parameter counts of the authors'
code.
"""

from typing import Final

import torch
from torch import Tensor, nn

from train.networks.blocks import (
    MultiScaleResidual,
    PatternNet,
    Residual,
    initialise,
    normed_conv,
    to_pattern,
    upsample,
)

CHANNELS: Final = 64
BLOCKS: Final = 6
MAX_TAPS: Final = 7


class SeedNet(PatternNet):
    """Network from a window of K taps to a pattern: STSR with one tap, MTSR-K with more.

    All layers work at the pattern's size. Taps are interpolated, each passes its stem, and they are merged; the newest
    tap also passes a branch without batch normalisation, which would remove the force.

    Args:
        taps: K, 1 to 7.
        scale: pattern pixels per taxel pitch.

    Raises:
        ValueError: taps or scale out of range.
    """

    def __init__(self, taps: int, scale: int) -> None:
        super().__init__()
        if not 1 <= taps <= MAX_TAPS:
            raise ValueError(f"{taps} taps asked for, expected 1 to {MAX_TAPS}")
        if scale < 1:
            raise ValueError(f"scale is {scale}, expected at least 1")
        self.taps, self.scale = taps, scale
        self.stems = nn.ModuleList(
            nn.Sequential(normed_conv(3, CHANNELS, 3), normed_conv(CHANNELS, CHANNELS, 3)) for _ in range(taps)
        )
        self.merge = normed_conv(taps * CHANNELS, CHANNELS, 3)
        self.trunk = nn.Sequential(*(MultiScaleResidual(CHANNELS) for _ in range(BLOCKS)))
        self.force = nn.Sequential(nn.Conv2d(3, CHANNELS, 3, padding=1, bias=False), nn.ReLU(), Residual(CHANNELS))
        self.leave = nn.Sequential(
            nn.Conv2d(2 * CHANNELS, 2 * CHANNELS, 3, padding=1, bias=False),
            nn.ReLU(),
            nn.Conv2d(2 * CHANNELS, 1, 3, padding=1, bias=False),
        )
        initialise(self)

    def forward(self, window: Tensor) -> Tensor:
        """Return patterns (n, H, W) in [mm] of windows (n, 3K, rows, cols) in network units, newest tap first."""
        taps = upsample(window, self.scale).split(3, dim=1)
        shapes = [stem(tap) for stem, tap in zip(self.stems, taps, strict=True)]
        pattern = self.trunk(self.merge(torch.cat(shapes, dim=1)))
        force = self.force(taps[0])
        return to_pattern(self.leave(torch.cat([force, pattern], dim=1)), training=self.training)

    @classmethod
    def from_stsr(cls, stsr: "SeedNet", taps: int) -> "SeedNet":
        """Return an MTSR-K that computes the same as an STSR until it is trained.

        Every stem starts as the STSR's. In the merging layer the earlier taps have zero weights: these weights learn
        from the first step on, the stems before them from the second.

        Raises:
            ValueError: `stsr` takes more than one tap, or `taps` is out of range.
        """
        if stsr.taps != 1:
            raise ValueError(f"the network to start from takes {stsr.taps} taps, expected an STSR")
        net = cls(taps, stsr.scale)
        state = {name: value.clone() for name, value in stsr.state_dict().items()}
        stem = {name: value for name, value in state.items() if name.startswith("stems.0.")}
        for tap in range(1, taps):
            state |= {name.replace("stems.0.", f"stems.{tap}."): value.clone() for name, value in stem.items()}
        newest = state["merge.0.weight"]
        state["merge.0.weight"] = torch.cat([newest, *[torch.zeros_like(newest)] * (taps - 1)], dim=1)
        net.load_state_dict(state)
        return net
