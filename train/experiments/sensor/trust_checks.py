"""Checks of patterns by the shipped models, through the runtime: wrong patterns, false alarms, faults, foreign taps.

What is judged here has set nothing: networks, checks and limits were fitted on other pads' presses.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.bundled import INT8_SUFFIX
from edge.inference.onnx_session import ModelSession
from edge.terminal.progress_bar import tracked
from firmware_bridge.scans.pad_constants import Pad
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.generation_config import SEED
from train.data.real_grips import recorded_grips, recording_paths, recordings_folder
from train.data.world import World
from train.errors import CheckpointError
from train.experiments.sensor.contact_verdicts import CONTACTS, contacts_of, judged, of_one_sensor_each, verdicts_on
from train.experiments.sensor.real import play
from train.experiments.sensor.sensor_faults import FAULTS, FIELDS
from train.experiments.sensor.shipped import ALL, NOTHING, known_pads
from train.experiments.sensor.wrong_taps import tap_tables
from train.experiments.support.workbench import Workbench
from train.families.catalogue import SHARES
from train.report import Report, Row

JUDGED: Final = World(count=8000, per_pad=4, families=dict.fromkeys(SHARES, 1.0), seed=7_700_103)
_MODELS: Final = ("stsr", "stsr-small", "mtsr2", "mtsr4", "mtsr7")
_SEVERAL: Final = "mtsr4"


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `trust-checks`.

    Raises:
        CheckpointError: a shipped model has no checks.
    """
    model = bench.model()
    names = (_MODELS[0], _SEVERAL) if bench.quick else _MODELS
    models = [bench.model(f"{name}{INT8_SUFFIX}") for name in names]
    for one in models:
        if one.contract.read_trust() is None:
            raise CheckpointError(f"{one.name} has no checks: give it some with export.checks")
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
    for rows, caption, part in tap_tables(model, bench.models / f"{_SEVERAL}{INT8_SUFFIX}.onnx", sensors):
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
