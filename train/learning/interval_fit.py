"""Calibration of deviations, and fit of a network's interval correction.

A deviation becomes an interval as that of a Laplace density, which the networks are trained with; the factor is an
empirical quantile, so that LEVEL is correct for any density of the errors.

Weights of a correction are fitted on training presses: the factors that cover a share LEVEL of the errors sampled in
each region minimise the pinball loss of their logarithm, so every pixel counts the same whatever its size.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import log, sqrt
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from edge.evaluation import metrics
from edge.inference.intervals import REGIONS, regions
from edge.terminal.progress_bar import tracked
from train.data.frozen_presses import freeze_presses
from train.data.press_batches import OneSensor, PosedBatches, PressBatches, network_input, stated_poses
from train.data.presses import SEED, PressSet
from train.networks.compact import CompactNet, IntervalCorrection
from train.physics.sensor_noise import Nuisances

LEVEL: Final = 0.9
LEVELS: Final = (0.5, 0.8, 0.9, 0.95)
_SEED: Final = 0  # of the fit of a correction
_SAMPLES: Final = 24  # pixels of each region of a window
_RATE: Final = 5e-3
_LEAST_RATIO: Final = 1e-3

# Function from windows in network units, pads and poses to patterns and deviations, in [mm].
Run = Callable[
    [NDArray[np.float32], NDArray[np.float32] | None, NDArray[np.float32] | None], Sequence[NDArray[np.float32]]
]


def half_width_mm(deviation_mm: ArrayLike) -> NDArray[np.floating]:
    """Return half the width of the interval that holds a share LEVEL of a Laplace density, in [mm]."""
    return np.asarray(deviation_mm) * (-log(1 - LEVEL) / sqrt(2))


def interval_coverage(truth: ArrayLike, pattern: ArrayLike, deviation: ArrayLike) -> float:
    """Return the share of pixels whose truth lies within their interval; arrays of one shape, in [mm]."""
    return float(metrics.interval_coverage(pattern, truth, half_width_mm(deviation)).mean())


def calibrate(truth: ArrayLike, pattern: ArrayLike, deviation: ArrayLike) -> float:
    """Return the factor on the deviations with which their intervals cover a share LEVEL of these pixels."""
    widths = half_width_mm(deviation)
    if not np.all(widths > 0):
        raise ValueError("a deviation is not above zero: nothing can be scaled to cover its error")
    return float(np.quantile(np.abs(np.asarray(truth) - np.asarray(pattern)) / widths, LEVEL, method="higher"))


@dataclass(frozen=True, slots=True)
class Readings:
    """Windows of all taps of a network, with what is known of their pads and the truth."""

    windows: NDArray[np.float32]  # (n, K, 3, rows, cols) in zeroed counts
    pads: NDArray[np.float32] | None  # (n, width), inputs of the pads; None if nothing is known
    truth: NDArray[np.float32]  # (n, H, W) in [mm]
    poses: NDArray[np.float32] | None = None  # (n, K, 5), as a robot states them; None for the schedule

    def with_taps(self, given: int) -> NDArray[np.float32]:
        """Return the windows in network units with the newest `given` taps, the others zero: (n, 3K, rows, cols)."""
        windows = self.windows.copy()
        windows[:, given:] = 0
        return network_input(windows).numpy()


def readings_of_presses(
    presses: PressSet, taps: int, times: int = 3, *, sensor: OneSensor | None = None
) -> list[Readings]:
    """Return presses as sensors of their own, or `sensor`, read them, with nothing and with all known of each."""
    readings = []
    for number in range(times):
        frozen = freeze_presses(presses, SEED + number, Nuisances() if sensor is None else sensor.nuisances)
        poses = None
        if taps > 1:
            poses = stated_poses(np.random.default_rng(SEED + number), presses.with_taps(taps).poses)
        for known in (False, True):
            windows = frozen.windows(taps, gains_known=known and sensor is None)
            pads = frozen.pads(known=known)
            if sensor is not None:
                pads[:] = known * np.array(sensor.row)
            readings.append(Readings(windows, pads, frozen.patterns(), poses))
    return readings


def fit_correction(net: CompactNet, presses: PressSet, contact_level: float, steps: int = 2000) -> None:
    """Add a correction to a trained network in evaluation mode, fitted on presses, some of them with all its taps."""
    torch.manual_seed(_SEED)
    correction = net.add_intervals()
    correction.contact_level.fill_(contact_level)
    summary, later, ratios = _samples(net, correction, presses)
    spread = summary.std(dim=0)
    correction.centre.copy_(summary.mean(dim=0))
    correction.spread.copy_(torch.where(spread > 1e-3, spread, torch.ones_like(spread)))
    there = ~ratios.isnan()
    ratios = ratios.nan_to_num()
    optimiser = torch.optim.AdamW(correction.parameters(), _RATE, weight_decay=0.1)
    course = torch.optim.lr_scheduler.OneCycleLR(optimiser, _RATE, total_steps=steps)
    for _ in range(steps):
        picked = torch.randint(len(summary), (min(512, len(summary)),))
        beyond = ratios[picked] - correction.log_factors(summary[picked], later[picked])[:, :, None]
        loss = (torch.maximum(LEVEL * beyond, (LEVEL - 1) * beyond) * there[picked]).sum() / there[picked].sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        course.step()
    correction.requires_grad_(requires_grad=False)


def conform(net: CompactNet, run: Run, readings: Sequence[Readings]) -> dict[str, list[float]]:
    """Shift a network's correction, per region and number of taps, until it covers LEVEL of the readings' pixels.

    Returned are, for each of LEVELS in percent, the deviations that make half of its interval in each region.
    """
    if (correction := net.intervals) is None:
        raise ValueError("the network has no correction of intervals: fit one first")
    unit = float(half_width_mm(1.0))
    pooled: list[list[NDArray[np.floating]]] = [[] for _ in REGIONS]
    for given in tracked(range(1, net.taps + 1), "intervals", "taps"):
        ratios = _ratios(correction, run, given, readings)
        wanted = [float(np.quantile(region, LEVEL, method="higher")) if region.size else 1.0 for region in ratios]
        shift = torch.tensor(wanted).clamp_min(_LEAST_RATIO).log()
        correction.shift(given, shift)
        for parts, region, by in zip(pooled, ratios, shift.exp().tolist(), strict=True):
            parts.append(region / by)
    scaled = [np.concatenate(parts) for parts in pooled]
    return {
        f"{100 * level:g}": [
            # Half of the pixels far from a contact may be exact zeros, as the truth is.
            float(f"{unit * max(np.quantile(region, level), _LEAST_RATIO):.4g}") if region.size else unit
            for region in scaled
        ]
        for level in LEVELS
    }


def _ratios(
    correction: IntervalCorrection, run: Run, given: int, readings: Sequence[Readings]
) -> list[NDArray[np.floating]]:
    """Return errors over half widths in each region, with the newest `given` taps."""
    parts: list[list[NDArray[np.floating]]] = [[] for _ in REGIONS]
    for reading in readings:
        pattern, deviation = run(reading.with_taps(given), reading.pads, reading.poses)[:2]
        ratio = np.abs(pattern - reading.truth) / half_width_mm(deviation)
        region = regions(pattern, float(correction.contact_level), correction.near)
        for number, part in enumerate(parts):
            part.append(ratio[region == number])
    return [np.concatenate(part) for part in parts]


def _samples(net: CompactNet, correction: IntervalCorrection, presses: PressSet) -> tuple[Tensor, Tensor, Tensor]:
    """Return inputs of the factors (n, ...), taps (n, K - 1), and logarithms of errors over half widths (n, 4, m)."""
    rng = np.random.default_rng(_SEED)
    whole = presses.with_taps(net.taps)
    usable = np.flatnonzero(whole.counts[:, -1].any(axis=(1, 2, 3)) & (presses.taps >= net.taps))
    names = whole.family[usable]
    # Rare families weigh as much as frequent ones.
    kept = [rng.permutation(usable[names == name])[:1000] for name in np.unique(names)]
    chosen = whole.pick(rng.permutation(np.concatenate(kept))) if kept else whole
    at_once = min(512, len(chosen))
    batches = PosedBatches if net.takes_poses else PressBatches
    draw = batches(chosen, (1 / net.taps,) * net.taps, at_once, _SEED)
    unit = float(half_width_mm(1.0))
    samples: list[tuple[Any, ...]] = []
    # Two sensors read each press.
    for number in tracked(range(max(2 * len(chosen) // at_once, 1)), "intervals", "batch"):
        batch = draw(number)
        with torch.inference_mode():
            posed = () if batch.poses is None else (batch.poses,)
            seen = net.see(batch.window, batch.pad, *posed)
            pattern = torch.relu(seen.pattern)
            _, summary = correction.summary(seen.features, pattern, seen.deviation, seen.about, seen.later)
            error = (pattern - batch.pattern / seen.newest).abs() + 1e-6
            region = regions(pattern.numpy(), float(correction.contact_level), correction.near)
            samples.append((summary, seen.later, _drawn(torch.log(error / (seen.deviation * unit)), region)))
    # A copy, because tensors of inference take no gradient.
    inputs, later, ratios = (torch.cat(parts).clone() for parts in zip(*samples, strict=True))
    return inputs, later, ratios


def _drawn(values: Tensor, region: NDArray[np.integer]) -> Tensor:
    """Return values of _SAMPLES pixels of each region, (n, 4, m); not a number where a region has fewer."""
    order = torch.rand(values.shape).flatten(1)
    drawn = []
    for number in range(len(REGIONS)):
        rank, place = torch.where(torch.from_numpy(region == number).flatten(1), order, 2.0).topk(
            _SAMPLES, largest=False
        )
        drawn.append(torch.where(rank < 1.5, values.flatten(1).gather(1, place), torch.nan))
    return torch.stack(drawn, dim=1)
