"""The compact network: a trunk at twice the taxel grid, grown to the pattern by pixel shuffle.

Against the seed's network (Wu and Liu 2024, Fig. 8) it keeps the two branches, pattern from all taps and force from
the newest one, and leaves out the work at full resolution and batch normalisation, which cost 8 dB after
1000 steps here (docs/log.md). It adds how far each pixel may be off.
"""

from math import expm1, log, sqrt
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from train.networks.blocks import PatternNet, Residual
from train.objectives import relative_error, truth_size

_QUIET_UNITS: Final = 0.02
"""Added to a tap's amplitude before it divides the tap, in network units: noise and absent taps stay small."""

_LEAST_DEVIATION: Final = 1e-4
"""Of a tap of amplitude 1, in [mm]: .05 % of what such a tap presses in."""

_FIRST_DOUBT: Final = log(expm1(0.02))
"""Added before the softplus: before training a tap of amplitude 1 is believed to about 0.02 mm."""

_LEAST_SHARE: Final = 1e-3
"""Added to deviations in the loss, as a share of the truth's RMS: a pixel that is right by chance decides nothing."""


class CompactNet(PatternNet):
    """Window of K taps to a pattern, and to the standard deviation of each of its pixels.

    A tap enters the pattern branch divided by its own amplitude, and the newest tap's amplitude multiplies the
    result: a flat contact's pattern is linear in its force, so the trunk has to learn shapes alone, and no force is out
    of its range. An absent tap is all zeros and stays so.

    The deviation is read off the features from which the pattern is made, and teaches them nothing: the pattern comes
    out as if there were no deviation.

    Args:
        taps: K.
        scale: pattern pixels per taxel pitch, even.
        channels: of the trunk.
        blocks: residual blocks of the trunk.

    Attributes:
        deviation_scale: factor on the deviation, found after training by `train.calibration.calibrate`.

    Raises:
        ValueError: no taps, or an odd scale.
    """

    deviation_scale: Tensor

    def __init__(self, taps: int, scale: int, channels: int = 64, blocks: int = 6) -> None:
        super().__init__()
        if taps < 1:
            raise ValueError(f"{taps} taps asked for, expected at least 1")
        if scale < 2 or scale % 2:
            raise ValueError(f"scale is {scale}, expected an even number: the trunk works at twice the taxel grid")
        self.taps, self.scale = taps, scale
        self._width = (channels, blocks)
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
        self.trunk = nn.Sequential(*(Residual(channels) for _ in range(blocks)))
        self.force = nn.Sequential(
            nn.Conv2d(3, force_channels, 3, padding=1),
            nn.ReLU(),
            Residual(force_channels),
            nn.Conv2d(force_channels, 4 * force_channels, 1),
            nn.PixelShuffle(2),
        )
        self.leave = nn.Sequential(
            nn.Conv2d(channels + force_channels, 2 * channels, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(2 * channels, grow * grow, 3, padding=1),
            nn.PixelShuffle(grow),
        )
        self.doubt = nn.Sequential(
            nn.Conv2d(channels + force_channels, 3 * channels // 4, 1),
            nn.ReLU(),
            nn.Conv2d(3 * channels // 4, grow * grow, 3, padding=1),
            nn.PixelShuffle(grow),
        )
        self.register_buffer("deviation_scale", torch.tensor(1.0))

    def forward(self, window: Tensor) -> tuple[Tensor, Tensor]:
        """Patterns and their deviations, both (n, H, W) in [mm], of windows (n, 3K, rows, cols) in network units.

        Patterns are cut at zero in use but not in training: a sub-pixel that is cut everywhere would never learn again.
        Deviations are above zero always.
        """
        count, _, rows, cols = window.shape
        taps = window.view(count, self.taps, 3, rows, cols)
        amplitude = taps.square().mean(dim=(2, 3, 4), keepdim=True).sqrt() + _QUIET_UNITS
        shapes = (taps / amplitude).view(count, 3 * self.taps, rows, cols)
        newest = amplitude[:, 0, 0]
        with torch.autocast(window.device.type, enabled=False):
            entered = self.enter(shapes)  # what a turned tap reads otherwise is a few parts in a thousand
        features = torch.cat([self.trunk(self.merge(entered)), self.force(shapes[:, :3])], dim=1)
        pattern = self.leave(features)[:, 0].float() * newest
        # Not an exponential: on a window unlike all others it would know no bounds.
        doubt = F.softplus(self.doubt(features.detach())[:, 0].float() + _FIRST_DOUBT)
        deviation = (doubt + _LEAST_DEVIATION) * newest * self.deviation_scale
        return (pattern if self.training else torch.relu(pattern)), deviation

    def with_fewer_taps(self, taps: int) -> "CompactNet":
        """The same function of the newest `taps` taps, the others absent; its own weights.

        Raises:
            ValueError: more taps asked for than there are, or none.
        """
        if not 1 <= taps <= self.taps:
            raise ValueError(f"{taps} taps asked for, expected 1 to {self.taps}")
        state = {name: value.clone() for name, value in self.state_dict().items()}
        state["enter.weight"] = state["enter.weight"][:, : 3 * taps]
        smaller = CompactNet(taps, self.scale, *self._width)
        smaller.load_state_dict(state)
        return smaller

    def with_more_taps(self, taps: int) -> "CompactNet":
        """The same function of the newest taps, deaf to the further ones until it is trained; its own weights.

        Raises:
            ValueError: fewer taps asked for than there are.
        """
        if taps < self.taps:
            raise ValueError(f"{taps} taps asked for, expected {self.taps} or more")
        state = {name: value.clone() for name, value in self.state_dict().items()}
        known = state["enter.weight"]
        state["enter.weight"] = F.pad(known, (0, 0, 0, 0, 0, 3 * (taps - self.taps)))
        larger = CompactNet(taps, self.scale, *self._width)
        larger.load_state_dict(state)
        return larger


class HeteroscedasticError:
    """Objective of a network that gives a pattern and its deviation: see `heteroscedastic_loss`."""

    def __init__(self, beta: float = 1.0) -> None:
        self._beta = beta

    def loss(self, net: nn.Module, window: Tensor, truth: Tensor) -> Tensor:
        """Relative error of the patterns, and how badly the deviations tell it."""
        pattern, deviation = net(window)
        return heteroscedastic_loss(pattern, deviation, truth, self._beta)

    def after_step(self) -> None:
        """Nothing of its own to train."""

    def state_dict(self) -> dict[str, Any]:
        """Nothing learnt."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing to load."""


def heteroscedastic_loss(pattern: Tensor, deviation: Tensor, truth: Tensor, beta: float = 1.0) -> Tensor:
    """Relative error of the patterns, and how badly the deviations tell it; all (n, H, W) in [mm].

    The deviation is judged by a Laplace likelihood, since the pattern descends a mean absolute error: with the error e
    and b = deviation / sqrt(2), both as shares of the truth's RMS, (log b + e / b) times a fixed b^beta. That is least
    where b is the mean error, whatever beta is. With 0, the likelihood alone, its slope over log b knows no bounds, and
    most is asked of pixels that are right already; with 1 the slope is b - e, of the error's own size, and pixels in
    the contact come out covered as well as those beside it (docs/log.md). The error is taken as given, so doubt never
    buys a worse pattern.

    Source: Seitzer et al. 2022, Eq. 5, for a Laplace density.
    """
    size = truth_size(truth)
    error = (pattern.detach() - truth).abs() / size
    spread = deviation / sqrt(2) / size + _LEAST_SHARE
    misjudged = spread.detach().pow(beta) * (spread.log() + error / spread)
    return relative_error(pattern, truth) + misjudged.mean()
