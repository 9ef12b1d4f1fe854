"""Checks of patterns by the shipped models, through the runtime: wrong patterns, false alarms, faults, foreign taps.

What is judged here has set nothing: networks, checks and limits were fitted on other pads' presses.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.inference.bundled import INT8_SUFFIX
from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import ON_COUNTS
from edge.perception.runtime import Model
from edge.terminal.progress_bar import tracked
from firmware_bridge.scans.pad_constants import Pad
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.presses import SEED
from train.data.real_grips import recorded_grips, recording_paths, recordings_folder
from train.data.world import World
from train.errors import CheckpointError
from train.experiments.sensor.real import play
from train.experiments.sensor.sensor_faults import FAULTS, FIELDS
from train.experiments.sensor.shipped import (
    ALL,
    CONTACTS,
    NOTHING,
    PushedSensor,
    contacts_of,
    judged,
    known_pads,
    of_one_sensor_each,
    share,
    verdicts_on,
)
from train.experiments.support.workbench import Workbench
from train.families.catalogue import SHARES
from train.physics.gripped import MAX_INDENTATION_MM
from train.report import Report, Row, signed_interval

JUDGED: Final = World(count=8000, per_pad=4, families=dict.fromkeys(SHARES, 1.0), seed=7_700_103)
_MODELS: Final = ("stsr", "mtsr", "stsr-small")
_TAPS: Final = 4


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `trust-checks`.

    Raises:
        CheckpointError: a shipped model has no checks.
    """
    model = bench.model()
    names = _MODELS[:2] if bench.quick else _MODELS
    models = [bench.model(f"{name}{INT8_SUFFIX}") for name in names]
    for one in models:
        if one.contract.read_trust() is None:
            raise CheckpointError(f"{one.name} has no checks: export it with --trust")
    wide = bench.wide_test()
    wide = wide.pick(np.arange(12)) if bench.quick else wide
    # A third of the sensors is enough for the faults, and half of the presses to compare models.
    sensors = of_one_sensor_each(wide.pick(wide.presses.pad % 3 == 0))
    report = Report("trust-checks", folder, __file__, bench.used, quick=bench.quick)
    fresh = freeze_presses(bench.presses("judged", JUDGED), SEED)
    verdicts = judged(model, fresh, known_pads(fresh, NOTHING))
    report.say(_METHOD)
    family = fresh.presses.family[verdicts.index]
    which = {name: (family == name) & ~verdicts.light for name in SHARES}
    which |= {"all": ~verdicts.light, "light": verdicts.light}
    report.table([{"contacts of": name} | verdicts.cells(here) for name, here in which.items()], _FAMILIES)
    text = "Half of these contacts by model, one tap each, of all families."
    report.table(_by_model(models, fresh.pick(np.arange(0, len(fresh), 2))), text, "models")
    if recording_paths(recordings_folder()):
        report.table(_grips(models), _GRIPS, "grips")
    report.table(_detected(model, sensors), _DETECTED, "faults")
    for rows, caption, part in tap_tables(model, bench.models / f"{_MODELS[1]}{INT8_SUFFIX}.onnx", sensors):
        report.table(rows, caption, part)
    return report.write()


_METHOD: Final = (
    "Shipped models through `edge.perception.runtime`, scan by scan, with its options as shipped; nothing is known of "
    "a sensor unless a row states it. How far a pattern is off is its RMS error over the RMS of the truth. Contacts "
    "less than 30 % off that are not believed are false alarms, wanted at most 2 %; wanted of those more than 50 % off "
    "are 30 % not believed, of those more than 100 % off 80 %. Nothing was chosen by the contacts of these tables."
)
_FAMILIES: Final = (
    "Fresh contacts by family, every press of a sensor of its own. `light`: a summed z of 750 to 1500 counts, in "
    "which a contact can end, but not begin; the other rows leave them out."
)
_GRIPS: Final = (
    "Scans under load of real grips by trial, both fingers, with the rest level of the trial that ends free: not "
    "believed, in %, wanted at most 3."
)
_DETECTED: Final = (
    "Faults of a sensor, the same in all of its contacts, eleven a sensor, of the wide test set. Fields have 150 to"
    " 1500 counts on the reading where they are largest, and come after zeroing. `another pad's file`: constants "
    "and gains of another sensor, stated as certain. `sensor, after n`: sensors that n contacts have made "
    "suspected. 95 % intervals are by sensor; where all are alike, Clopper and Pearson's."
)


def _by_model(models: Sequence[ModelSession], presses: FrozenPresses) -> list[Row]:
    rows: list[Row] = []
    for model in tracked(models, "models", "model"):
        for known in (NOTHING, ALL) if model is models[0] else (NOTHING,):
            one = judged(model, presses, known_pads(presses, known))
            rows.append({"model": model.name, "known": known} | one.cells(~one.light))
    return rows


def _grips(models: Sequence[ModelSession]) -> list[Row]:
    grips, rows = recorded_grips(recordings_folder()), list[Row]()
    for trial in tracked(sorted({grip.trial for grip in grips}), "playing", "trial"):
        row: Row = {"trial": trial}
        for model in models:
            believed = np.concatenate([play(grip, model).believed for grip in grips if grip.trial == trial])
            row |= {"scans": len(believed), f"{model.name} %": round(100 * float((~believed).mean()), 1)}
        rows.append(row)
    return rows


def _detected(model: ModelSession, sensors: FrozenPresses) -> list[Row]:
    contacts = contacts_of(sensors)
    readings = [sensors.presses.counts[mine, 0] for mine in contacts]
    own = [sensors.pad(int(mine[0]), gains=True) for mine in contacts]
    nothing: list[Pad | None] = [None] * len(contacts)
    given: dict[str, tuple[Sequence[NDArray[np.floating]], Sequence[Pad | None]]] = {
        "no fault": (readings, nothing),
        "no fault, its own file": (readings, own),
        "another pad's file": (readings, [*own[1:], own[0]]),
    }
    for name, fault in FAULTS.items():
        wrong = [fault(np.random.default_rng([SEED, number]), one) for number, one in enumerate(readings)]
        given[name] = (wrong, nothing)
    for name, field in FIELDS.items():
        alone = [field(np.random.default_rng([SEED, number])) for number in range(len(readings))]
        given[f"{name}, the pad free"] = ([np.tile(one, (CONTACTS, 1, 1, 1)) for one in alone], nothing)
    judged = tracked(given.items(), "faults", "fault")
    return [{"fault": name} | verdicts_on(model, *one).cells() for name, one in judged]


_DEPTHS: Final = (0.85, 1.15)
_DROPPED: Final = (
    "Earlier taps of windows of four: share that the runtime finds not to belong, by tap, newest first, and windows of "
    "which it drops some, and all. In the row `right`, these are false alarms, wanted at most 1 %; in the others at "
    "least 95 % are wanted. The order reversed leaves the middle tap right."
)
_GUARDED: Final = (
    "PSNR in dB of the same windows, by the model of one tap, and by that of four without and with the guard. "
    "Wanted: with the guard, never more than 0.3 dB below one tap. Intervals are by sensor; guard and options are as "
    "shipped, and every tap is used."
)


class Guarded(NamedTuple):
    """Outcome for n windows: PSNR (n,) in [dB], taps used (n,), and which earlier ones do not belong, (n, K - 1)."""

    psnr_db: NDArray[np.float64]
    taps_used: NDArray[np.int64]
    foreign: NDArray[np.bool_]


def tap_tables(single: ModelSession, several: Path, sensors: FrozenPresses) -> Iterator[tuple[list[Row], str, str]]:
    """Yield the tables of dropped taps and of PSNR: rows, caption and name."""
    guarding, unguarded = (ModelSession(several, taps=_TAPS) for _ in range(2))
    unguarded.contract = replace(unguarded.contract, trust={})
    taps, name_of = guarding.contract.taps, guarding.name
    sensors = firm(sensors)
    pads = sensors.presses.pad
    dropped: list[Row] = []
    losses: list[Row] = []
    for name, (counts, truth) in tracked(cases(sensors).items(), "tapping", "case"):
        alone, off, on = (
            guarded(model, counts, truth, number)
            for model, number in ((single, 1), (unguarded, taps), (guarding, taps))
        )
        row: Row = {"earlier taps": name, "windows": len(counts)}
        by_tap: Row = {f"tap {number} %": share(on.foreign[:, number - 1], pads) for number in range(1, taps)}
        some, every = share(np.logical_or.reduce(on.foreign, axis=1), pads), share(on.taps_used == 1, pads)
        dropped.append(row | by_tap | {"some dropped %": some, "all dropped %": every})
        row[single.name] = round(float(alone.psnr_db.mean()), 2)
        for how, one in (("no guard", off), ("guard", on)):
            row[f"{name_of}, {how}"] = round(float(one.psnr_db.mean()), 2)
            row[f"{how}, over one tap"] = signed_interval(one.psnr_db - alone.psnr_db, pads)
        losses.append(row)
    yield dropped, _DROPPED, "taps"
    yield losses, _GUARDED, "psnr"


def firm(sensors: FrozenPresses) -> FrozenPresses:
    """Return the sequences whose taps all begin a contact, at the least depth of `cases` too."""
    z_counts = sensors.presses.counts[:, :, 2].sum(axis=(2, 3))
    return sensors.pick((_DEPTHS[0] * z_counts > ON_COUNTS * 1.05).all(axis=1))


def cases(sensors: FrozenPresses) -> dict[str, tuple[NDArray[np.floating], NDArray[np.float32]]]:
    """Return right windows (n, K, 3, rows, cols) and wrong ones, by name, with the truths of their newest taps."""
    counts, truth = sensors.presses.counts, sensors.patterns()
    newest, earlier = counts[:, :1], counts[:, 1:]
    rng = np.random.default_rng(17)
    depths = rng.uniform(*_DEPTHS, (*earlier.shape[:2], 1, 1, 1)).astype(np.float32)
    mirrored = counts[..., ::-1] * np.array([-1, 1, 1], dtype=np.float32)[:, None, None]
    other = next_of_pad(sensors.presses.pad)
    return {
        "right": (counts, truth),
        "another surface": (np.concatenate([newest, earlier[other]], axis=1), truth),
        "order reversed": (np.concatenate([newest, earlier[:, ::-1]], axis=1), truth),
        # The mirror image of a pad that turns one way is one that turns the other way.
        "turned the other way": (mirrored, truth[..., ::-1]),
        "not turned": (np.concatenate([newest, newest * depths], axis=1), truth),
    }


def next_of_pad(pads: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return for each press the next one of its pad, or of all where the pad has one alone, (n,)."""
    result = np.roll(np.arange(len(pads)), -1)
    for pad in np.unique(pads):
        mine = np.flatnonzero(pads == pad)
        if len(mine) > 1:
            result[mine] = np.roll(mine, -1)
    return result


def guarded(model: Model, windows: NDArray[np.floating], truth: NDArray[np.float32], taps: int) -> Guarded:
    """Push each window through a runtime of its own, the newest tap being inferred."""
    patterns, used, foreign = [], [], []
    for number, counts in enumerate(windows):
        result = PushedSensor(model, seed=number).tap(counts[:taps])
        patterns.append(np.asarray(result.pattern))  # there is one, since taps that begin no contact are left out
        used.append(result.taps_used)
        foreign.append([mismatch >= 0.5 for mismatch in result.tap_mismatch or ()])
    return Guarded(
        psnr_db(np.stack(patterns), truth, MAX_INDENTATION_MM), np.array(used), np.array(foreign, dtype=bool)
    )
