"""Lower bound on the error from K taps of a surface that is given, compared with the networks' error.

The Cramer-Rao bound with priors (van Trees): readings are linearised about each test tap in all unknowns, the surface's
place, every tap's own pose error and force, and the nuisances. Its inverse information, carried over to the pattern, is
the least mean squared error. If a network gains nothing from more taps, either the taps have no more information or the
network does not use it; the bound separates the two.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import AXES
from train.experiments.support.trainings import compact, mixed, trained
from train.experiments.support.workbench import Workbench
from train.freeze import SCALE, TEST_FORCE_N
from train.learning.checkpoint import infer
from train.physics.resample import resample
from train.physics.sensor_noise import Nuisances
from train.physics.simulated_sensor import FINE_SCALE, FRAMES, MAX_INDENTATION_MM, SimulatedSensor
from train.report import Report, Row, with_interval
from train.surfaces.named_surfaces import SURFACES
from train.surfaces.poses import ANGLE_STEP_DEG, TEST_POSITION, as_poses, paper_targets, turned_back

TAPS: Final = (1, 2, 4, 7)
ANGLES_DEG: Final = (ANGLE_STEP_DEG, 30.0)
_NUDGE: Final = (0.15, 0.15, 1.5)
"""Steps of the finite differences in x, y and angle, in [mm, mm, deg]."""
_PLACE_SD: Final = (2.0, 2.0, 100.0)
"""Prior deviation of the surface's place, wide enough to be nearly uninformative, in [mm, mm, deg]."""
_FORCE_SD: Final = (0.5, 0.1)
"""Prior deviation as a share of the force: of the newest tap, still rising, and of the others, at their ends."""
_RAGGED: Final = 0.0025
"""Deviation of simulated readings from a smooth function of the place, as a share of their RMS, from contact cells."""
_CUT_NORMAL_SD: Final = 0.96
"""Standard deviation of a normal draw cut at two standard deviations, as nuisances are drawn."""


@dataclass(frozen=True, slots=True)
class Nudged:
    """Clean readings of n targets' K taps, and the newest taps' patterns, at their place and shifted about it.

    Attributes:
        counts: (n, K, 7, 48): as it is, x up and down, y up and down, angle up and down.
        patterns: (n, 7, pixels), in [mm].
    """

    counts: NDArray[np.float64]
    patterns: NDArray[np.float64]

    def slopes(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives by x, y [1/mm] and angle [1/deg]: (..., 7, m) to (..., 3, m)."""
        return (values[..., 1::2, :] - values[..., 2::2, :]) / (2 * np.array(_NUDGE)[:, None])


def nudged(surfaces: tuple[str, ...], taps: int, angle_step_deg: float) -> Nudged:
    """Tap the test targets of some surfaces, and shifted by one step to each side in x, y and angle."""
    offsets = np.zeros((7, 3))
    for axis, step in enumerate(_NUDGE):
        offsets[2 * axis + 1, axis], offsets[2 * axis + 2, axis] = step, -step
    targets = paper_targets([TEST_POSITION], surfaces)
    sensor = SimulatedSensor()
    counts, patterns = [], []
    for name, newest in zip(targets.surfaces, turned_back(targets, taps, angle_step_deg), strict=True):
        poses = newest[:, None] + offsets
        with_pattern = np.arange(7 * taps) < 7
        found = sensor.tap([name] * 7 * taps, as_poses(poses), TEST_FORCE_N, with_pattern)
        counts.append(found.counts[:, -1].reshape(taps, 7, -1))
        patterns.append(resample(found.patterns[:, -1], FINE_SCALE, SCALE).reshape(7, -1))
    return Nudged(np.array(counts, dtype=np.float64), np.array(patterns, dtype=np.float64))


def least_mse(taps: Nudged, given: int, nuisances: Nuisances) -> NDArray[np.float64]:
    """Return the least mean squared error of each target's pattern, (n,) in [mm^2], from its newest `given` taps."""
    errors = []
    for counts, patterns in zip(taps.counts[:, :given], taps.patterns, strict=True):
        parts = list(_unknowns(counts, taps.slopes(counts), nuisances))
        change = np.concatenate([part.reshape(len(part), -1) for part, _ in parts])
        prior_sd = np.concatenate([np.full(len(part), sd) for part, sd in parts])
        ragged_var = _RAGGED**2 * np.square(counts[:, 0]).mean()
        noise_var = nuisances.noise_counts**2 + ragged_var + 1 / 12  # readings are whole counts
        # Scaled by the prior deviations, so that the unknowns' very different sizes do not spoil the inverse.
        scaled = change * prior_sd[:, None]
        information = scaled @ scaled.T / noise_var + np.eye(len(scaled))
        # The pattern depends on the place, the newest tap's pose error and its force alone, which come first.
        slopes = taps.slopes(patterns)
        carried = np.concatenate([slopes, slopes, patterns[:1]]) * prior_sd[:7, None]
        covariance = np.linalg.inv(information)[:7, :7]
        errors.append(np.einsum("ip,ij,jp->p", carried, covariance, carried).mean())
    return np.array(errors)


def _unknowns(
    counts: NDArray[np.float64], slopes: NDArray[np.float64], nuisances: Nuisances
) -> Iterator[tuple[NDArray[np.float64], float]]:
    """Yield the change of the readings by each unknown, (m, K, 48), with the unknown's standard deviation."""
    taps = len(counts)
    clean = counts[:, 0]
    turned = np.moveaxis(slopes, 1, 0)

    def of_tap(change: NDArray[np.float64], tap: int) -> NDArray[np.float64]:
        alone = np.zeros_like(change)
        alone[:, tap] = change[:, tap]
        return alone

    for axis, sd in enumerate(_PLACE_SD):
        yield turned[axis : axis + 1], sd
    pose_sd = (nuisances.pose_error_mm, nuisances.pose_error_mm, nuisances.pose_error_deg)
    for tap in range(taps):
        for axis, sd in enumerate(pose_sd):
            yield of_tap(turned[axis : axis + 1], tap), sd * _CUT_NORMAL_SD
        yield of_tap(clean[None], tap), _FORCE_SD[tap > 0]
    readings = clean.shape[1]
    taxels = readings // len(AXES)
    every = np.eye(readings)[:, None]
    yield every * clean, nuisances.gain_spread * _CUT_NORMAL_SD
    axes = np.repeat(np.eye(len(AXES)), taxels, axis=1)[:, None] * np.ones((taps, 1))
    for axis, share in enumerate((1 / 8, 1 / 8, 1.0)):
        yield axes[axis : axis + 1], nuisances.thermal_drift_counts * share * _CUT_NORMAL_SD
    yield np.repeat(every[-taxels:], taps, axis=1), nuisances.thermal_drift_counts * 0.25
    # Taken to turn with the pad: true for taps a few degrees apart, and slightly too high a bound for others.
    yield axes, nuisances.earth_field_counts * np.sqrt(2 / 3)


def run(bench: Workbench, folder: Path) -> Path:
    """Compute the bound, add the networks, and write table and plot."""
    given = TAPS[:2] if bench.quick else TAPS
    surfaces = SURFACES[:2] if bench.quick else SURFACES
    rows: list[Row] = []
    curves: dict[str, list[float]] = {}
    plain = Nuisances()
    for angle_deg in ANGLES_DEG[:1] if bench.quick else ANGLES_DEG:
        taps = nudged(surfaces, given[-1], angle_deg)
        for label, nuisances in (("all", plain), ("no gain spread", plain.without("gain_spread"))):
            name = f"bound at {angle_deg:g} deg, nuisances: {label}"
            for count in tracked(given, name, "number of taps"):
                psnr = 10 * np.log10(MAX_INDENTATION_MM**2 / least_mse(taps, count, nuisances))
                rows.append(
                    {"what": name, "taps": count, "PSNR dB": with_interval(psnr, np.arange(len(psnr))), "MMAC": None}
                )
                curves.setdefault(name, []).append(float(psnr.mean()))
    test, validation, data = bench.frozen("test", surfaces), bench.frozen("validation"), mixed(bench)
    ends = np.flatnonzero(np.diff(test.tap, append=-1) != 0)
    truth = test.patterns()[ends]
    for count in given:
        net, _ = trained(bench, compact("stsr" if count == 1 else f"mtsr{count}"), data, validation)
        psnr = psnr_db(infer(net, test.windows(count)[ends])[0], truth, test.full_scale_mm)
        rows.append({"what": "compact networks", "taps": count, "PSNR dB": with_interval(psnr, np.arange(len(psnr)))})
        curves.setdefault("compact networks", []).append(float(psnr.mean()))
    report = Report("bound", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"The 18 surfaces, known but for their place, at the end of each test tap (frame {FRAMES} of {FRAMES}, "
        f"{TEST_FORCE_N:g} N). Cross-talk and hysteresis are left out of the bound, so it is a little too good. A "
        "chip's gain is the same in all taps: where the pad is turned between them, the quotient of two readings "
        "depends on the place and not on the gain, which one tap cannot separate."
    )
    report.table(rows, "Least error that taps allow, and error of the networks.")
    with report.figure() as figure:
        axes = figure.subplots()
        for name, values in curves.items():
            axes.plot(given, values, "o-" if name.startswith("compact") else "x--", label=name)
        axes.set(xlabel="taps", ylabel="PSNR at the end of a tap [dB]", xticks=given)
        axes.legend(fontsize=8)
    return report.write()
