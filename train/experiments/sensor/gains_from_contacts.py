"""Identification of sensors from their own contacts: simulated ones with given constants, then real recordings.

Simulated sensors each have a pad, gains and all other nuisances of Nuisances; the mixture was fitted to presses of
other pads. The gains of real sensors are not available; those from three trials predict a hidden taxel of the fourth.
"""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import AXES, USPA44
from train.data.make_presses import make_presses
from train.data.presses import PressSet
from train.data.real_grips import (
    ScanSet,
    linear_from_others,
    neighbours_mean,
    recorded_sets,
    recording_paths,
    recordings_folder,
    z_of,
)
from train.data.world import World
from train.experiments.sensor.families import TRAINING
from train.experiments.support.workbench import Workbench
from train.identify import distinct, mixture_beside
from train.learning.contact_mixture import CHANNELS, ContactMixture, Z, normalise
from train.learning.gain_estimate import Estimate, estimate
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import INPUTS, constants, draw_pad
from train.physics.sensor_noise import Nuisances, read_windows
from train.report import Report, Row

SENSORS: Final = World(count=4800, per_pad=200, seed=9015)
"""Sensors on other pads than those of seed 9014, by which the estimate's confidence was set."""
_FLAT_GRIPS: Final = 3
_EVEN_MPA: Final = 0.02


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `gains-from-contacts`.

    Raises:
        DatasetError: presses cannot be made or read.
    """
    presses, world = bench.data_folder / "gripped.npz", SENSORS
    if bench.quick:
        presses, world = bench.data_folder / "quick-identify.npz", replace(SENSORS, count=36, per_pad=12)
    make_presses(World(count=240, per_pad=120) if bench.quick else TRAINING, presses)
    mixture = mixture_beside(presses)
    name = "quick-sensors.npz" if bench.quick else "sensors.npz"
    sensors = make_presses(world, bench.data_folder / name)
    report = Report("gains-from-contacts", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        "A place's gain is that of its chip's axis, N(1, .075), times what its magnet's seat and moment do to z under "
        "an even load. Errors are of log-gains: in truth z's mean is 0, in the estimate each axis'. Intervals: 90 %. "
        "Constants are over half their range, in which the prior's RMS error is .58; a constant is determined if its "
        "deviation is below .7 of the prior's, and otherwise keeps its prior."
    )
    for caption, flat in ((f"{world.per_pad} mixed contacts", False), (f"{_FLAT_GRIPS} flat grips", True)):
        _simulated(report, sensors, world, mixture, caption, flat=flat)
    if recording_paths(recordings_folder()):
        _recorded(report, mixture)
    else:
        report.say("No recordings were there, so this is of simulated sensors alone.")
    return report.write()


def read_by_sensor(
    presses: PressSet, world: World, number: int
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float32]]:
    """Return one sensor's readings (n, 3, rows, cols), true log-gains (channels,) and scaled constants (p,)."""
    pad = draw_pad(np.random.default_rng([world.seed, number]))
    chip = Nuisances().gain_spread * np.random.default_rng([world.seed, 1, number]).standard_normal(USPA44.scan_shape)
    gains = 1 + chip.clip(-2 * Nuisances().gain_spread, 2 * Nuisances().gain_spread)
    clean = presses.counts[:, 0] * gains.astype(np.float32)
    read = read_windows(clean[None, :, None], 1.0, Nuisances().without("gain_spread"), [world.seed, number])[0]
    even = np.full((1, 1, *[GrippedPad(pad).size] * 2), _EVEN_MPA, dtype=np.float32)
    real, perfect = (GrippedPad(one).skin.frames(even)[0, 0, AXES.index("z")] for one in (pad, replace(pad, seed=None)))
    true = np.log(gains.reshape(len(AXES), -1)) + np.log(real / perfect).ravel()
    return read, (true - true[AXES.index("z")].mean()).ravel(), constants(pad)


def _simulated(
    report: Report, sensors: PressSet, world: World, mixture: ContactMixture, caption: str, *, flat: bool
) -> None:
    found: list[Estimate] = []
    gains, pads = [], []
    for number in tracked(range(world.chunks), caption, "sensor"):
        mine = sensors.pick(sensors.pad == np.unique(sensors.pad)[number])
        read, true, constant = read_by_sensor(mine, world, number)
        if flat:
            read = read[normalise(read)[1] & (mine.family == "flat")][:_FLAT_GRIPS]
        if len(read):
            found.append(estimate(read, mixture))
            gains.append(true)
            pads.append(constant)
    if not found:
        report.say(f"No sensor has {caption}.")
        return
    truth, pad = np.array(gains), np.array(pads)
    error = np.array([one.log_gains for one in found]) - truth
    half = np.array([one.half_width for one in found])
    rows: list[Row] = [
        {
            "axis": axis,
            "RMS before": round(_rms(truth[:, part]), 4),
            "RMS after": round(_rms(error[:, part]), 4),
            "in the interval %": round(100 * float((np.abs(error[:, part]) <= half[:, part]).mean())),
        }
        for axis, part in (("x", slice(0, 16)), ("y", slice(16, 32)), ("z", Z), ("all", slice(0, CHANNELS)))
    ]
    report.show(rows, f"Gains, {caption}, {len(found)} sensors.")
    middle = np.array([one.constants for one in found])
    determined = np.array([one.determined for one in found])
    off = np.abs(middle - pad)
    inside = off <= half[:, CHANNELS:]
    report.show(
        [
            {
                "constant": name,
                "correlation": round(float(np.corrcoef(middle[:, at], pad[:, at])[0, 1]), 2),
                "RMS error": round(_rms(off[:, at]), 2),
                "determined %": round(100 * float(determined[:, at].mean())),
                "determined ones in the interval %": round(100 * float(inside[determined[:, at], at].mean()))
                if determined[:, at].any()
                else None,
            }
            for at, name in enumerate(INPUTS)
        ],
        f"Constants, {caption}.",
    )


def hidden_z_error(scans: ScanSet, found: Estimate, mixture: ContactMixture) -> NDArray[np.floating]:
    """Return the error (n, taxels), in counts, of each taxel's z predicted from the other fifteen and the gains."""
    gains = np.exp(found.log_gains)
    even = scans.counts.reshape(len(scans.counts), -1) / gains
    guess = neighbours_mean(even[:, Z])
    error = np.empty_like(guess)
    for taxel in range(USPA44.taxel_count):
        filled = even[:, Z].copy()
        filled[:, taxel] = guess[:, taxel]
        scale = np.sqrt((filled**2).mean(axis=1))
        expected = mixture.hidden_z(even / scale[:, None], found.constants, taxel) * scale
        error[:, taxel] = expected * gains[Z][taxel] - z_of(scans.counts)[:, taxel]
    return error


def _recorded(report: Report, mixture: ContactMixture) -> None:
    sets = recorded_sets(recordings_folder())
    rows: list[Row] = []
    squares: dict[str, list[NDArray[np.floating]]] = {}
    for scans in sets:
        others = [one for one in sets if one.sensor == scans.sensor and one.trial != scans.trial]
        if not others:
            continue
        found = estimate(distinct(np.concatenate([one.counts for one in others])), mixture)
        even = replace(found, log_gains=np.zeros(CHANNELS))
        gains = np.exp(found.log_gains[Z])
        z = z_of(scans.counts)
        errors = {
            "bilinear": neighbours_mean(z) - z,
            "bilinear, gains": neighbours_mean(z / gains) * gains - z,
            "mixture": hidden_z_error(scans, even, mixture),
            "mixture, gains": hidden_z_error(scans, found, mixture),
            "linear map of the other trials": linear_from_others(
                np.concatenate([z_of(one.counts) for one in others]), z
            )
            - z,
        }
        for name, error in errors.items():
            squares.setdefault(name, []).append(error**2)
        row: Row = {"sensor": scans.sensor, "trial": scans.trial, "contacts of the others": found.contacts}
        rows.append(row | {name: round(_rms(error)) for name, error in errors.items()})
    whole: Row = {name: round(float(np.sqrt(np.concatenate(parts).mean()))) for name, parts in squares.items()}
    rows.append({"sensor": "all"} | whole)
    report.table(rows, "Recordings: RMS error of a hidden taxel's z in counts, gains from the sensor's other trials.")


def _rms(values: NDArray[np.floating]) -> float:
    return float(np.sqrt((values**2).mean()))
