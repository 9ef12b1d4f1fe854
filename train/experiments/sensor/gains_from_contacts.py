"""Gains of sensors from contacts, as a running sensor learns them, and from flat grips, as the doctor asks for them.

Simulated sensors each have a pad, gains and all other nuisances of Nuisances, on pads that neither the distribution of
contacts nor the table of grips was made of. The gains of real sensors are not available; those from three trials
predict a hidden taxel of the fourth.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, cast

import joblib
import numpy as np
from numpy.typing import NDArray

from edge.doctor.flat_grip_gains import load_table
from edge.inference.bundled import CONTACTS, FLAT_GRIPS
from edge.perception.gain_following import CONTRADICTED, CONTRADICTED_CONTACTS
from edge.perception.gain_learning import ContactModel, GainLearner, load_contact_model
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import AXES
from firmware_bridge.scans.pad_constants import LEVEL_90, Pad
from train.data.grip_ramps import LEVELS, read_grips
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
from train.data.simulated_sensors import contacts_of, sensor_of, true_log_gains
from train.data.world import World
from train.experiments.support.workbench import Workbench
from train.identify import distinct
from train.learning.contact_mixture import CHANNELS, CONSTANTS, Z, scaled_constants
from train.learning.flat_grips import grips_of_pad, log_gains
from train.learning.gain_estimate import learned
from train.report import Report, Row

SENSORS: Final = World(count=4800, per_pad=200, seed=9015)
COUNTS: Final = (25, 50, 100, 200)
_HOUR: Final = 3600
"""Adverse contacts of an hour, one a second."""
_PASSES: Final = 5
_STARTS: Final = (1, 4, 16)
_HARD: Final = (0.3, 1.0)
_NOISE_COUNTS: Final = 2.0
_PARTS: Final = (("x", slice(0, 16)), ("y", slice(16, 32)), ("z", Z), ("all", slice(0, CHANNELS)))


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `gains-from-contacts`.

    Raises:
        DatasetError: presses cannot be made or read.
    """
    world = replace(SENSORS, count=36, per_pad=12) if bench.quick else SENSORS
    presses = make_presses(world, bench.data_folder / ("quick-sensors.npz" if bench.quick else "sensors.npz"))
    model = load_contact_model(CONTACTS)
    numbers = range(world.chunks)
    true = np.array([true_log_gains(*sensor_of(world, number)) for number in numbers])
    contacts = [contacts_of(presses, world, number) for number in numbers]
    report = Report("gains-from-contacts", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        "A place's gain is that of its chip's axis, N(1, .075), times what its magnet's seat and moment do to z under "
        "an even load. Errors are RMS of log-gains, of which z's mean is 0 in truth. The means of x and of y over z, "
        "which spread by .019, cannot be separated from the pad's in-plane share by contacts, nor by pushes of unknown "
        'force: "means out" is the error without them. Certainty is the last number of a network\'s pad input. '
        "Intervals: 90 %."
    )
    report.show(_by_contacts(contacts, true, model), f"Gains from mixed contacts, each once, {len(true)} sensors.")
    report.show(_constants(world, contacts, model), "Constants from all contacts, three times over.")
    report.show(_from_grips(world), f"Gains from three flat grips with tilt, {world.chunks} sensors.")
    report.show(
        _adverse(presses, contacts, true, model),
        "An hour of adverse contacts, one a second, on a sensor that has learned nothing yet.",
    )
    by_hand = [_by_hand(world, number) for number in numbers]
    report.show(
        _files(contacts, by_hand, model),
        f"Measured gains in the sensor file, its own and another sensor's, over {_PASSES} passes of its contacts; they "
        f"are contradicted where the disagreement exceeds {CONTRADICTED:g}.",
    )
    report.show(_restarts(contacts, true, by_hand, model), "A sensor that is started again after every 80 contacts.")
    if recording_paths(recordings_folder()):
        _recorded(report, model)
    else:
        report.say("No recordings were there, so this is of simulated sensors alone.")
    return report.write()


def _row(off: NDArray[np.floating], pads: Sequence[Pad]) -> Row:
    """Return the errors (n, channels) of log-gains as a row, with how sure their pads are."""
    planes = off.reshape(len(off), len(AXES), -1)
    centred = planes - planes.mean(axis=2, keepdims=True)
    half = np.array([pad.gain_half_widths for pad in pads])
    return {
        **{name: round(_rms(off[:, part]), 4) for name, part in _PARTS},
        "means out": round(_rms(centred), 4),
        "in the interval %": round(100 * float((np.abs(off) <= half).mean())),
        "certainty": round(float(np.mean([pad.gains_certainty for pad in pads])), 2),
    }


def _by_contacts(
    contacts: Sequence[NDArray[np.floating]], true: NDArray[np.floating], model: ContactModel
) -> list[Row]:
    rows: list[Row] = [{"contacts": 0} | _row(-true, [GainLearner(model).pad()] * len(true))]
    found: dict[int, list[Pad]] = {count: [] for count in COUNTS}
    for mine in tracked(contacts, "mixed contacts", "sensor"):
        learner, taught = GainLearner(model), 0
        for count in COUNTS:  # light presses were left out of the set, so that few sensors have all of the last ones
            for contact in mine[taught:count]:
                learner.learn(contact)
            taught = count
            learner.solve()
            found[count].append(learner.pad())
    return rows + [{"contacts": count} | _row(_logs(pads) - true, pads) for count, pads in found.items()]


def _from_grips(world: World) -> list[Row]:
    table = load_table(FLAT_GRIPS)
    solving = (joblib.delayed(grips_of_pad)(world.seed, number) for number in range(world.chunks))
    solved = cast(list[tuple[NDArray[np.float32], NDArray[np.float64]]], joblib.Parallel(n_jobs=-1)(solving))
    rows: list[Row] = []
    for caption, scans in (("grown and pushed", None), ("not pushed", LEVELS)):
        off, pads = [], []
        for number, (clean, seats) in enumerate(solved):
            chips = sensor_of(world, number)[1]
            pad = table.gains(list(read_grips(clean, chips, [world.seed, number])[:, :scans]))
            if pad is not None:
                pads.append(pad)
                off.append(_logs([pad])[0] - log_gains(chips, seats).ravel())
        rows.append({"grips": caption} | _row(np.array(off), pads))
    return rows


def _by_hand(world: World, number: int) -> Pad | None:
    """Return what the doctor measures of a sensor by three flat grips."""
    clean, _ = grips_of_pad(world.seed, number)
    return load_table(FLAT_GRIPS).gains(list(read_grips(clean, sensor_of(world, number)[1], [world.seed, number])))


def _files(contacts: Sequence[NDArray[np.floating]], by_hand: Sequence[Pad | None], model: ContactModel) -> list[Row]:
    rows: list[Row] = []
    for caption, shift in (("its own", 0), ("another sensor's", len(contacts) // 3)):
        most, until = [], []
        for number, mine in enumerate(tracked(contacts, caption, "sensor")):
            learner, largest, first = GainLearner(model, by_hand[(number + shift) % len(contacts)]), 0.0, np.inf
            for contact in np.concatenate([mine] * _PASSES):
                if learner.learn(contact) and learner.contacts >= CONTRADICTED_CONTACTS:
                    largest = max(largest, learner.disagreement)
                    first = min(first, learner.contacts if largest > CONTRADICTED else np.inf)
            most.append(largest)
            until.append(first)
        found = np.sort(until)
        rows.append(
            {
                "gains": caption,
                "sensors": len(contacts),
                "contradicted": int(np.isfinite(found).sum()),
                "contacts until then, median": _whole(found[len(found) // 2]),
                "most": _whole(found[-1]),
                "disagreement, least of the largest": round(min(most), 2),
                "largest": round(max(most), 2),
            }
        )
    return rows


def _whole(count: float) -> int | None:
    return int(count) if np.isfinite(count) else None


def _restarts(
    contacts: Sequence[NDArray[np.floating]],
    true: NDArray[np.floating],
    by_hand: Sequence[Pad | None],
    model: ContactModel,
) -> list[Row]:
    rows: list[Row] = []
    for caption, measured in (("nothing", [None] * len(contacts)), ("flat grips", by_hand)):
        used = list(measured)
        rng = np.random.default_rng(0)
        for start in range(1, _STARTS[-1] + 1):
            for number, mine in enumerate(contacts):
                learner = GainLearner(model, measured[number])
                for contact in mine[rng.permutation(len(mine))[:80]]:
                    learner.learn(contact)
                before = used[number]
                if before is None or learner.pad().gains_certainty >= before.gains_certainty:
                    used[number] = learner.pad()
            if start in _STARTS:
                pads = [one for one in used if one is not None]
                rows.append({"measured": caption, "starts": start} | _row(_logs(pads) - true[: len(pads)], pads))
    return rows


def _constants(world: World, contacts: Sequence[NDArray[np.floating]], model: ContactModel) -> list[Row]:
    learners = [learned(mine, model) for mine in tracked(contacts, "constants", "sensor")]
    true = np.array([scaled_constants(sensor_of(world, number)[0]) for number in range(world.chunks)])
    found = np.array([one.constants for one in learners])
    half = LEVEL_90 * np.array([one.constant_deviations for one in learners])
    told = np.array([one.determined for one in learners])
    rows: list[Row] = []
    for at, name in enumerate(CONSTANTS[:-1]):
        off, sure = np.abs(found[:, at] - true[:, at]), told[:, at]
        rows.append(
            {
                "constant": name,
                "correlation": round(float(np.corrcoef(found[:, at], true[:, at])[0, 1]), 2),
                "RMS error over half its range": round(_rms(off), 2),
                "prior": round(float(1 / np.sqrt(3)), 2),
                "determined %": round(100 * float(sure.mean())),
                "of these in the interval %": round(100 * float((off <= half[:, at])[sure].mean()))
                if sure.any()
                else None,
            }
        )
    return rows


def _adverse(
    presses: PressSet,
    contacts: Sequence[NDArray[np.floating]],
    true: NDArray[np.floating],
    model: ContactModel,
) -> list[Row]:
    pads = np.unique(presses.pad)
    found: dict[str, list[tuple[Pad, int]]] = {"the same edge": [], "one taxel": [], "every edge": []}
    for number, mine in enumerate(tracked(contacts, "adverse contacts", "sensor")):
        family = presses.family[presses.pad == pads[number]]
        z = mine[:, AXES.index("z")].reshape(len(mine), -1)
        edges = mine[np.isin(family, ("edge", "block", "step"))]
        edges = edges if len(edges) else mine[:1]
        alone = mine[[(z.max(axis=1) / np.maximum(z.mean(axis=1), 1)).argmax()]]
        for name, repeated in zip(found, (edges[:1], alone, edges), strict=True):
            learner = _an_hour(repeated, model, number)
            found[name].append((learner.pad(), learner.contacts))
    before: Row = {"contacts": "none", "distinct": 0} | _row(-true, [GainLearner(model).pad()] * len(true))
    after: list[Row] = [
        {"contacts": name, "distinct": round(float(np.mean([count for _, count in made])), 1)}
        | _row(_logs([pad for pad, _ in made]) - true, [pad for pad, _ in made])
        for name, made in found.items()
    ]
    return [before, *after]


def _an_hour(repeated: NDArray[np.floating], model: ContactModel, seed: int) -> GainLearner:
    """Return what a sensor learns from the same contacts again and again, of other strengths and with new noise."""
    rng = np.random.default_rng(seed)
    learner = GainLearner(model)
    for second in range(_HOUR):
        one = repeated[second % len(repeated)] * rng.uniform(*_HARD)
        learner.learn(one + rng.normal(0, _NOISE_COUNTS, one.shape))
    learner.solve()
    return learner


def _logs(pads: Sequence[Pad]) -> NDArray[np.float64]:
    return np.log([pad.gains or () for pad in pads])


def _recorded(report: Report, model: ContactModel) -> None:
    sets = recorded_sets(recordings_folder())
    rows: list[Row] = []
    squares: dict[str, list[NDArray[np.floating]]] = {}
    for scans in sets:
        others = [one for one in sets if one.sensor == scans.sensor and one.trial != scans.trial]
        if not others:
            continue
        learner = learned(distinct(np.concatenate([one.counts for one in others])), model)
        errors = hidden_errors(scans, others, learner)
        for name, error in errors.items():
            squares.setdefault(name, []).append(error**2)
        row: Row = {"sensor": scans.sensor, "trial": scans.trial, "contacts of the others": learner.contacts}
        row |= {name: round(_rms(error)) for name, error in errors.items()}
        rows.append(row | {"better %": round(100 * (1 - _rms(errors["with gains"]) / _rms(errors["without"])))})
    whole: Row = {name: round(float(np.sqrt(np.concatenate(parts).mean()))) for name, parts in squares.items()}
    rows.append({"sensor": "all"} | whole)
    report.table(
        rows,
        "Recordings: RMS error of a hidden taxel's z from the mean of its neighbours, in counts, without gains and "
        "with those from the sensor's other trials, and by a linear map that was fitted to these trials.",
    )


def hidden_errors(scans: ScanSet, others: Sequence[ScanSet], learner: GainLearner) -> dict[str, NDArray[np.floating]]:
    """Return the errors (n, taxels) of each taxel's z predicted from the others, in counts, by method."""
    gains, z = learner.gains[Z], z_of(scans.counts)
    fitted = linear_from_others(np.concatenate([z_of(one.counts) for one in others]), z)
    return {
        "without": neighbours_mean(z) - z,
        "with gains": neighbours_mean(z / gains) * gains - z,
        "linear map": fitted - z,
    }


def _rms(values: NDArray[np.floating]) -> float:
    return float(np.sqrt((values**2).mean()))
