"""Checks of patterns by the shipped models, through the runtime: wrong patterns, false alarms, faults, run times.

What is judged here has set nothing: networks, checks and limits were fitted on other pads' presses.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.bundled import INT8_SUFFIX, TAXELS
from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import RuntimeOptions
from edge.perception.dead_taxel_fill import load_estimator
from edge.perception.pattern_check import MOST_DOUBT
from edge.perception.runtime import Runtime
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import ScanSeries
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.generation_config import SEED
from train.data.make_presses import make_presses
from train.data.real_grips import Grip, recorded_grips, recording_paths, recordings_folder
from train.data.world import World
from train.errors import CheckpointError
from train.experiments.support.check_times import time_rows
from train.experiments.support.contact_verdicts import CONTACTS, contacts_of, of_one_sensor_each, verdicts_on
from train.experiments.support.foreign_taps import tap_tables
from train.experiments.support.sensor_faults import FAULTS, FIELDS
from train.experiments.support.shipped import ALL, NOTHING, known_pads, load_shipped
from train.experiments.support.workbench import Workbench
from train.experiments.support.wrong_patterns import Judged, judged
from train.experiments.support.wrong_taps import firm
from train.families.catalogue import SHARES
from train.report import Report, Row

_EVEN: Final = dict.fromkeys(SHARES, 1.0)
CALIBRATED: Final = World(count=8000, per_pad=4, families=_EVEN, seed=7_700_002)
CALIBRATED_FAMILIES: Final = tuple(sorted(SHARES)[::2])
"""Families by which the limit of doubt is set for comparison."""
JUDGED: Final = replace(CALIBRATED, seed=7_700_103)
FALSE_ALARMS: Final = 0.02
TURNED: Final = World(count=210, taps=7, schedule="turns", families=dict.fromkeys(SHARES, 1.0), seed=2_000_002)
"""Sequences long enough to leave out every second tap, on pads of their own."""
_SCAN_NS: Final = 16_750_000
_TICKS: Final = 300
_QUICK: Final = 12
_MODELS: Final = ("stsr", "stsr-small", "mtsr2", "mtsr4", "mtsr7")


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `trust-checks`.

    Raises:
        CheckpointError: a shipped model has no checks.
    """
    model = load_shipped(bench.models)
    models = [ModelSession(bench.models / f"{name}{INT8_SUFFIX}.onnx") for name in _MODELS]
    paths = {one.name: bench.use(bench.models / f"{one.name}.onnx") for one in models}
    for one in models:
        if one.contract.read_trust() is None:
            raise CheckpointError(f"{one.name} has no checks: give it some with export.checks")
    wide = bench.wide_test()
    wide = wide.pick(np.arange(_QUICK)) if bench.quick else wide
    # A third of the sensors is enough for the faults, and half of the presses to compare models.
    sensors = of_one_sensor_each(wide.pick(wide.presses.pad % 3 == 0))
    report = Report("trust-checks", folder, __file__, bench.used, quick=bench.quick)
    fresh = freeze_presses(bench.presses("judged", JUDGED), SEED)
    verdicts = judged(model, fresh, known_pads(fresh, NOTHING))
    report.say(_METHOD.format(model=model.name, limit=_limit(bench, model), shipped=MOST_DOUBT))
    report.table(_by_family(verdicts, fresh), _FAMILIES)
    report.table(_by_model(models, fresh.pick(np.arange(0, len(fresh), 2))), _BY_MODEL, "models")
    if recording_paths(recordings_folder()):
        report.table(_grips(models), _GRIPS, "grips")
    report.table(_detected(model, sensors), _DETECTED, "faults")
    several = paths[f"mtsr4{INT8_SUFFIX}"]
    name, world = ("quick-turned", replace(TURNED, count=12)) if bench.quick else ("turned", TURNED)
    turned = of_one_sensor_each(freeze_presses(make_presses(world, bench.data_folder / f"{name}.npz"), SEED))
    for rows, caption, part in tap_tables(model, several, sensors, turned):
        report.table(rows, caption, part)
    windows = firm(sensors).presses.counts[:20]
    timed = [time_rows(path, windows, 2 if bench.quick else _TICKS) for path in (paths[model.name], several)]
    report.table([row for rows in timed for row in rows], _TIMES, "times")
    return report.write()


_METHOD: Final = (
    "Shipped models through `edge.perception.runtime`, scan by scan, with its options as shipped; nothing is known of "
    "a sensor unless a row states it. How far a pattern is off is its RMS error over the RMS of the truth. Contacts "
    "less than 30 % off that are not believed are false alarms, wanted at most 2 %; wanted of those more than 50 % off "
    "are 30 % not believed, of those more than 100 % off 80 %. On half of the families, starred, and on pads of their "
    "own a limit of {limit:.2f} of the expected error gives 2 % for `{model}`; shipped is {shipped}, chosen on all "
    "families of a third set. Nothing was chosen by the contacts of these tables."
)
_FAMILIES: Final = (
    "Fresh contacts by family, every press of a sensor of its own. `light`: a summed z of 750 to 1500 counts, in "
    "which a contact can end, but not begin; the other rows leave them out."
)
_BY_MODEL: Final = "Half of these contacts by model, one tap each, of all families."
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
_TIMES: Final = (
    "Run times on one thread: paced, one part at each tick of 100 Hz in turn, with cold caches, medians with their "
    "95 % intervals; `all checks` is a scan's difference to one without them, pair by pair."
)


def _limit(bench: Workbench, model: ModelSession) -> float:
    presses = bench.presses("calibrated", CALIBRATED)
    frozen = freeze_presses(presses.pick(np.isin(presses.family, CALIBRATED_FAMILIES)), SEED)
    found = judged(model, frozen, known_pads(frozen, NOTHING))
    return MOST_DOUBT * found.limit(~found.light, FALSE_ALARMS)


def _by_family(verdicts: Judged, presses: FrozenPresses) -> list[Row]:
    family = presses.presses.family[verdicts.index]
    rows: list[Row] = []
    for name in SHARES:
        here = (family == name) & ~verdicts.light
        rows.append({"contacts of": name + "*" * (name in CALIBRATED_FAMILIES)} | verdicts.cells(here))
    fitted = np.isin(family, CALIBRATED_FAMILIES)
    whole = {"others alone": ~fitted & ~verdicts.light, "all": ~verdicts.light, "light": verdicts.light}
    return rows + [{"contacts of": name} | verdicts.cells(here) for name, here in whole.items()]


def _by_model(models: Sequence[ModelSession], presses: FrozenPresses) -> list[Row]:
    rows: list[Row] = []
    for model in tracked(models, "models", "model"):
        for known in (NOTHING, ALL) if model is models[0] else (NOTHING,):
            one = judged(model, presses, known_pads(presses, known))
            rows.append({"model": model.name, "known": known} | one.cells(~one.light))
    return rows


def _grips(models: Sequence[ModelSession]) -> list[Row]:
    grips = recorded_grips(recordings_folder())
    rows: list[Row] = []
    for trial in tracked(sorted({grip.trial for grip in grips}), "playing", "trial"):
        row: Row = {"trial": trial}
        for model in models:
            flags = np.concatenate([real_flags(model, grip) for grip in grips if grip.trial == trial])
            row |= {"scans": len(flags), f"{model.name} %": round(100 * float(flags.mean()), 1)}
        rows.append(row)
    return rows


def real_flags(model: ModelSession, grip: Grip) -> NDArray[np.bool_]:
    """Return for each pressed scan of a recording whether its pattern was not believed, by any reason."""
    name = grip.free.sensor
    estimator = load_estimator(TAXELS, (USPA44.rows, USPA44.cols))
    options = RuntimeOptions(every_scan=True)
    runtime = Runtime(model, source="replay", estimator=estimator, baselines={name: grip.free}, options=options)
    series = ScanSeries(name, USPA44)
    results = [
        runtime.push(series.close(raw, number * _SCAN_NS)) for number, raw in enumerate(grip.counts.astype(np.int32))
    ]
    return np.array([one.trusted is False for one in results if one.pattern is not None], dtype=bool)


def _detected(model: ModelSession, sensors: FrozenPresses) -> list[Row]:
    contacts = contacts_of(sensors)
    readings = [sensors.presses.counts[mine, 0] for mine in contacts]
    own = [sensors.pad(int(mine[0]), gains=True) for mine in contacts]
    nothing: list[Pad | None] = [None] * len(contacts)
    others = [*own[1:], own[0]]
    given: dict[str, tuple[Sequence[NDArray[np.floating]], Sequence[Pad | None]]] = {
        "no fault": (readings, nothing),
        "no fault, its own file": (readings, own),
        "another pad's file": (readings, others),
    }
    for name, fault in FAULTS.items():
        wrong = [fault(np.random.default_rng([SEED, number]), one) for number, one in enumerate(readings)]
        given[name] = (wrong, nothing)
    for name, field in FIELDS.items():
        alone = [field(np.random.default_rng([SEED, number])) for number in range(len(readings))]
        given[f"{name}, the pad free"] = ([np.tile(one, (CONTACTS, 1, 1, 1)) for one in alone], nothing)
    judged = tracked(given.items(), "faults", "fault")
    return [{"fault": name} | verdicts_on(model, *one).cells() for name, one in judged]
