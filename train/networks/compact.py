"""Compact network of one tap: a trunk at twice the taxel grid, enlarged to the pattern by pixel shuffle.

Compared with the paper's network (Wu and Liu 2024, Fig. 8) it keeps the two branches, of the pattern and of the force,
and leaves out the layers at full resolution and batch normalisation, which cost 8 dB after 1000 steps here. It adds the
uncertainty of each pixel, the traction on the pad, and the pad's constants as an input; and it is exactly symmetric
under quarter turns.

A deviation alone has one bias in the contact and another around it, and one for a contact that covers the pad and
another for a wire. The correction of intervals, a part of the graph, multiplies it by one of four factors, by the
pixel's region; a small network computes the four from a summary of the window.
"""

from math import expm1, log, sqrt
from typing import Final, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from edge.inference.intervals import near_pixels
from firmware_bridge.pad_geometry import USPA44
from train.data.press_batches import Batch
from train.networks.blocks import Objective, PatternNet, Residual, relative_rms_errors, truth_size
from train.networks.symmetric import Group, SymmetricConv2d, fields, scalars, vectors

_HIDDEN: Final = 32
_MOST_INPUT: Final = 4.0  # standard deviations over the training presses: beyond them nothing is extrapolated
LOG_RANGE: Final = (-1.5, 2.5)  # of a factor: a window unlike all others widens its intervals twelvefold at most
_MASKS: Final = 3
# Masks that hold a region, in the order of REGIONS, and 1 for all pixels.
_OF_REGIONS: Final = torch.tensor([[1.0, 1, 0, 1], [1, 1, 1, 1], [1, 0, 1, 1], [0, 0, 1, 1]])


class IntervalCorrection(nn.Module):
    """Factors on the deviations of a compact network, by region.

    A factor's logarithm is the sum of what three overlapping masks add, and of what all pixels have: the four
    regions in the fewest steps of a graph. Of the `features`, so many consecutive ones as there are `symmetries` are
    permuted by these, which do not change their mean; `about` is the number of the pad's inputs and the amplitude.
    """

    contact_level: Tensor  # share of a pattern's maximum from which a pixel counts as touched
    centre: Tensor  # mean of each input over the training presses
    spread: Tensor  # standard deviation of each

    def __init__(self, scale: int, features: int, symmetries: int, about: int, taps: int) -> None:
        super().__init__()
        self.near = near_pixels(scale, USPA44.pitch_mm)  # pixels outside the contact that are near it
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
        """Return the masks (n, 3, H, W), and the inputs of the factors, (n, inputs); arguments are parts of `Seen`.

        The pattern is cut at zero, and of a tap of amplitude 1, as the deviation.
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


QUIET_UNITS: Final = 0.02  # added to a tap's amplitude before the division by it: noise and absent taps stay small
_MOST_LOGIT: Final = 8.0  # of what the deviation is the softplus of: no tap of amplitude 1 has a deviation of 8 mm


class CompactNet(PatternNet):
    """Network from a tap to a pattern, the standard deviation of each pixel, and the traction on the pad.

    A tap enters the pattern branch divided by its own amplitude, which multiplies the result: a flat contact's pattern
    is nearly linear in its force, so the trunk has to learn shapes only, and no force is out of its range. The
    amplitude itself enters as a bounded number, for the nonlinear part. `known` numbers state constants of the pad.
    ValueError if the scale is odd, or channels do not divide.
    """

    deviation_scale: Tensor  # factor on the deviation, see train.learning.interval_fit.calibrate

    def __init__(
        self, scale: int, channels: int, blocks: int, known: int = 0, group: Group = "p4", intervals: bool = False
    ) -> None:
        super().__init__()
        if scale < 2 or scale % 2:
            raise ValueError(f"scale is {scale}, expected an even number: the trunk works at twice the taxel grid")
        self.taps, self.scale, self.known = 1, scale, known
        self.group: Group = group
        self._width = (channels, blocks)
        grow = scale // 2
        wide, merged, left = (fields(group, size) for size in (channels, channels * 3 // 2, 2 * channels))
        narrow = fields(group, channels // 2)
        about, pixel = scalars(group, known + 1), scalars(group, 1).shuffled(grow)
        self.enter = SymmetricConv2d(vectors(group) + about, merged, 3)
        self.merge = nn.Sequential(
            nn.ReLU(),
            SymmetricConv2d(merged, merged, 3),
            nn.ReLU(),
            SymmetricConv2d(merged, wide.shuffled(2), 1),
            nn.PixelShuffle(2),
        )
        # The mean over the pad and its constants scale and shift every channel at the trunk's entrance.
        self.context = nn.Sequential(
            SymmetricConv2d(merged + about, merged, 1), nn.ReLU(), SymmetricConv2d(merged, wide * 2, 1)
        )
        for part in self.context[2].parameters():
            nn.init.zeros_(part)
        self.trunk = nn.Sequential(*(Residual(lambda: SymmetricConv2d(wide, wide, 3)) for _ in range(blocks)))
        self.force = nn.Sequential(
            SymmetricConv2d(vectors(group) + about, narrow, 3),
            nn.ReLU(),
            Residual(lambda: SymmetricConv2d(narrow, narrow, 3)),
            SymmetricConv2d(narrow, narrow.shuffled(2), 1),
            nn.PixelShuffle(2),
        )
        seen = wide + narrow
        self.leave = nn.Sequential(
            SymmetricConv2d(seen, left, 3), nn.ReLU(), SymmetricConv2d(left, pixel, 3), nn.PixelShuffle(grow)
        )
        self.uncertainty = nn.Sequential(
            SymmetricConv2d(seen, narrow, 1), nn.ReLU(), SymmetricConv2d(narrow, pixel, 3), nn.PixelShuffle(grow)
        )
        self.traction = SymmetricConv2d(seen, vectors(group), 3)
        self.register_buffer("deviation_scale", torch.tensor(1.0))
        self.intervals: IntervalCorrection | None = None
        if intervals:
            self.add_intervals()

    def add_intervals(self) -> IntervalCorrection:
        """Add a correction of the deviations that changes nothing yet, and return it; an earlier one is replaced."""
        features, symmetries = self._width[0] * 3 // 2, len(scalars(self.group, 1).index)
        correction = IntervalCorrection(self.scale, features, symmetries, self.known + 1, self.taps)
        self.intervals = correction.to(self.deviation_scale.device)
        return correction

    def forward(self, window: Tensor, pad: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return patterns and their deviations, both (n, H, W) in [mm], and tractions (n, 3, h, w) in [kPa].

        Windows are (n, 3, rows, cols) in network units, constants of the pads (n, known), None for none.
        """
        return self.finished(self.see(window, pad))

    def finished(self, seen: "Seen") -> tuple[Tensor, Tensor, Tensor]:
        """Return the outputs at the newest tap's amplitude; in evaluation cut at zero, and corrected by region."""
        # In training a sub-pixel that is cut everywhere would never learn again.
        if self.training:
            return seen.pattern * seen.newest, seen.deviation * seen.newest, seen.traction
        pattern, deviation = torch.relu(seen.pattern), seen.deviation
        if self.intervals is not None:
            deviation = deviation * self.intervals(seen.features, pattern, deviation, seen.about, seen.later)
        return pattern * seen.newest, deviation * seen.newest, seen.traction

    def see(self, window: Tensor, pad: Tensor | None = None) -> "Seen":
        """Return the outputs before any correction, and what they were made of; arguments as `forward`."""
        amplitude = tap_amplitude(window[:, None])[:, 0]
        entered = self.enter_pad(window / amplitude, self.about(amplitude[:, 0], pad))
        state = self.trunk(torch.relu(entered.merged * (1 + entered.scale) + entered.shift))
        return self.leave_pad(state, entered, amplitude[:, 0], entered.about[:, :0])

    def about(self, newest: Tensor, pad: Tensor | None) -> Tensor:
        """Return (n, known + 1): what is known of the pad, and a bounded number of an amplitude (n, 1, 1)."""
        size = (newest / (newest + 1))[:, :, 0]
        if pad is None or not self.known:
            return F.pad(size, (self.known, 0))
        return torch.cat([pad, size], dim=1)

    def enter_pad(self, shape: Tensor, about: Tensor) -> "Entered":
        """Return what enters the trunk, of readings of the newest tap with amplitude 1, (n, 3, rows, cols)."""
        given = torch.cat([shape, about[:, :, None, None].expand(-1, -1, *shape.shape[2:])], dim=1)
        entered, felt = self.enter(given), self.force(given)
        everywhere = torch.cat([torch.relu(entered).mean(dim=(2, 3), keepdim=True), about[:, :, None, None]], dim=1)
        scale, shift = self.context(everywhere).chunk(2, dim=1)
        return Entered(self.merge(entered), scale, shift, felt, about)

    def leave_pad(self, state: Tensor, entered: "Entered", newest: Tensor, later: Tensor) -> "Seen":
        """Return the outputs of the trunk's last state, for amplitudes `newest` (n, 1, 1) and earlier taps `later`."""
        features = torch.cat([state, entered.felt], dim=1)
        pattern = self.leave(features)[:, 0]
        traction = self.traction(features) * (newest * 30.0)[:, None]  # in [kPa], of an output of 1
        # Not an exponential, which would be unbounded on a window unlike all others. It begins at about 0.02 mm.
        logits = self.uncertainty(features.detach())[:, 0].to(newest.dtype) + log(expm1(0.02))
        uncertainty = F.softplus(logits) if self.training else _softplus(logits)
        # At least 0.05 % of the indentation of such a tap.
        deviation = (uncertainty + 1e-4) * self.deviation_scale
        return Seen(features, newest, entered.about, later, pattern, deviation, traction)

    def take_over(self, start: PatternNet) -> None:
        """Copy another network's function of the newest tap; ValueError if kind, width or inputs of the pad are others.

        From fewer symmetries to more, the asymmetric part is lost. At another scale the output layers stay new.
        """
        if not isinstance(start, CompactNet):
            raise ValueError("expected a compact network")
        if (start._width, start.known) != (self._width, self.known):
            raise ValueError(
                f"its width and inputs of the pad are {start._width} and {start.known}, expected {self._width} and "
                f"{self.known}"
            )
        theirs = dict(start.named_modules())
        for name, ours in self.named_modules():
            source = theirs.get(name)
            if isinstance(ours, SymmetricConv2d) and isinstance(source, SymmetricConv2d):
                weight = source.weight.detach()
                if weight.shape == ours.weight.shape:
                    ours.assign(weight, source.bias.detach())
        self.deviation_scale.copy_(start.deviation_scale)


def _softplus(values: Tensor) -> Tensor:
    """Return the softplus of values up to _MOST_LOGIT in steps for which onnxruntime takes a third of the time."""
    return torch.log(1 + torch.exp(values.clamp_max(_MOST_LOGIT)))


def tap_amplitude(taps: Tensor) -> Tensor:
    """Return the amplitudes of taps (n, K, 3, rows, cols), (n, K, 1, 1, 1), above zero even of absent ones."""
    return taps.square().mean(dim=(2, 3, 4), keepdim=True).sqrt() + QUIET_UNITS


class Entered(NamedTuple):
    """Features at the trunk's entrance."""

    merged: Tensor  # (n, channels, h, w)
    scale: Tensor  # (n, channels, 1, 1), by which they are multiplied, less 1
    shift: Tensor  # (n, channels, 1, 1), which is added to them
    felt: Tensor  # (n, channels / 2, h, w), of the newest tap alone
    about: Tensor  # (n, known + 1), the pad's inputs and the bounded amplitude


class Seen(NamedTuple):
    """Outputs of a compact network for n windows, and what they were made of."""

    features: Tensor  # (n, channels, h, w)
    newest: Tensor  # (n, 1, 1), amplitude of the newest tap
    about: Tensor  # (n, known + 1), the pad's inputs and the bounded amplitude
    later: Tensor  # (n, K - 1), as many times 1 as there are earlier taps, else 0
    pattern: Tensor  # (n, H, W), not cut at zero, over the amplitude, in [mm]
    deviation: Tensor  # (n, H, W), not corrected, over the amplitude, in [mm]
    traction: Tensor  # (n, 3, h, w) in [kPa]


_WORSE_BY_TAPS: Final = 0.4  # weight of the logarithm by which a pattern is worse than by the newest tap alone


class HeteroscedasticError(Objective):
    """Objective of a network that predicts a pattern and its deviation: see `heteroscedastic_loss`."""

    def loss(self, net: nn.Module, batch: Batch) -> Tensor:
        """Return the relative errors of patterns and tractions, and the likelihood loss of the deviations."""
        posed = () if batch.poses is None else (batch.poses,)
        pattern, deviation, traction = net(batch.window, batch.pad, *posed)
        loss = heteroscedastic_loss(pattern, deviation, batch.pattern)
        if batch.poses is not None and batch.poses.shape[1] > 1:
            # What earlier taps make worse counts once more: so a network learns when to lean on the newest one.
            with torch.no_grad():
                alone = net(batch.window[:, :3], batch.pad, batch.poses[:, :1])[0]
            share = relative_rms_errors(pattern, batch.pattern) / relative_rms_errors(alone, batch.pattern)
            loss = loss + _WORSE_BY_TAPS * torch.relu(share.log()).mean()
        if batch.traction is not None:
            simulated = batch.traction.isfinite().all(dim=(1, 2, 3))  # of a real sensor's taps it is not
            traction, truth = traction[simulated], batch.traction[simulated]
            size = truth.square().mean(dim=(1, 2, 3), keepdim=True).sqrt().clamp_min(0.05)
            loss = loss + 0.2 * ((traction - truth).abs() / size).mean()
        return loss


def heteroscedastic_loss(pattern: Tensor, deviation: Tensor, truth: Tensor) -> Tensor:
    """Return the relative error of the patterns plus the loss of the deviations; all inputs (n, H, W) in [mm].

    The deviation is trained by a Laplace likelihood: with the error e and b = deviation / sqrt(2), both as shares of
    the truth's RMS, (log b + e / b) times a fixed b. Its slope over log b is b - e, so pixels in the contact are
    covered as well as those around it. The error is a constant in this term, so doubt never allows a worse pattern.

    Source: Seitzer et al. 2022, Eq. 5 with beta 1, for a Laplace density.
    """
    size = truth_size(truth)
    error = (pattern.detach() - truth).abs() / size
    spread = deviation / sqrt(2) / size + 1e-3  # so that no pixel with a tiny error dominates
    uncertainty_error = spread.detach() * (spread.log() + error / spread)
    return relative_rms_errors(pattern, truth).mean() + uncertainty_error.mean()
