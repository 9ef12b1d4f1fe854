"""Checks of patterns by the shipped models, through the runtime: false alarms, faults detected, and their run time.

The frozen wide test set has set nothing here: networks, checks and limits were fitted on other pads' presses.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.bundled import INT8_SUFFIX, TAXELS
from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import ON_COUNTS, RuntimeOptions
from edge.perception.dead_taxel_fill import load_estimator
from edge.perception.runtime import Runtime
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import ScanSeries
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.generation_config import SEED, random_figures
from train.data.make_presses import make_presses
from train.data.real_grips import Grip, recorded_grips, recording_paths, recordings_folder
from train.data.world import World
from train.errors import CheckpointError
from train.experiments.support.check_times import time_rows
from train.experiments.support.contact_verdicts import (
    AFTER,
    CONTACTS,
    Verdicts,
    contacts_of,
    ever_suspected,
    of_one_sensor_each,
    share,
    verdicts_on,
)
from train.experiments.support.foreign_taps import tap_tables
from train.experiments.support.held_taxel import held_rows
from train.experiments.support.nominal import TEST_FIGURES, TEST_SEED, at_full_press
from train.experiments.support.pushed import PushedSensor
from train.experiments.support.sensor_faults import FAULTS, FIELDS
from train.experiments.support.shipped import ALL, NOTHING, known_pads, load_shipped
from train.experiments.support.stripes import striped_presses
from train.experiments.support.workbench import Workbench
from train.experiments.support.wrong_taps import firm
from train.families.catalogue import SHARES
from train.report import Report, Row, with_interval

TURNED: Final = World(count=630, taps=7, families=dict.fromkeys(SHARES, 1.0), seed=2_000_002)
"""Sequences long enough to leave out every second tap, on pads of their own."""
_MOST_ALARMS: Final = 1.0
_MOST_OF_GRIPS: Final = 2.0
_LEAST_FOUND: Final = 95.0
"""Shares that are wanted, in [%]."""
_GRIPS: Final = "real grips"
_SCAN_NS: Final = 16_750_000
_STRENGTHS: Final = (150.0, 400.0, 800.0, 1500.0)
_FIELDS_OF_A_STRENGTH: Final = 300
_STRIPES: Final = (60, 12)
_TICKS: Final = 300
_LONG: Final = 200
_QUICK: Final = 12


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `trust-checks`.

    Raises:
        CheckpointError: a shipped model has no checks.
    """
    model = load_shipped(bench.models)
    several = ModelSession(bench.models / f"mtsr4{INT8_SUFFIX}.onnx")
    paths = [bench.use(bench.models / f"{one.name}.onnx") for one in (model, several)]
    for one in (model, several):
        if one.contract.read_trust() is None:
            raise CheckpointError(f"{one.name} has no checks: export it with --trust")
    wide = bench.wide_test()
    wide = wide.pick(np.arange(_QUICK)) if bench.quick else wide
    sensors = of_one_sensor_each(wide)
    report = Report("trust-checks", folder, __file__, bench.used, quick=bench.quick)
    report.say(_METHOD.format(model=model.name, several=several.name, on=round(ON_COUNTS)))
    false = _false_alarms(bench, model, wide)
    report.table(false, "False alarms: contacts that make their readings, wanted at most 1 %.", "false-alarms")
    found = _detected(model, sensors)
    report.table(found, _DETECTED)
    readings = [sensors.presses.counts[mine, 0] for mine in contacts_of(sensors)]
    ever = ever_suspected(model, readings, 2 if bench.quick else _LONG)
    report.say(
        f"Of {len(ever)} sensors without a fault, {share(ever)} % are suspected at some time of {_LONG} contacts, "
        "drawn from the same few presses of theirs, so that a shape that reads oddly comes again and again."
    )
    report.table(_by_strength(model, sensors, 2 if bench.quick else _FIELDS_OF_A_STRENGTH), _BY_STRENGTH, "fields")
    report.table(held_rows(model, firm(sensors)), _HELD, "held")
    report.table(_stripes(bench, model), _STRIPED, "stripes")
    name, world = ("quick-turned", replace(TURNED, count=12)) if bench.quick else ("turned", TURNED)
    turned = of_one_sensor_each(freeze_presses(make_presses(world, bench.data_folder / f"{name}.npz"), SEED))
    foreign: list[Row] = []
    for rows, caption, part in tap_tables(model, paths[1], sensors, turned):
        report.table(rows, caption, part)
        foreign += [row for row in rows if not str(row["earlier taps"]).startswith("right")]
    windows = firm(sensors).presses.counts[:20]
    report.table(
        [row for path in paths for row in time_rows(path, windows, 2 if bench.quick else _TICKS)], _TIMES, "times"
    )
    report.say(_missed(false, found, foreign))
    _plot(report, found)
    return report.write()


_METHOD: Final = (
    "`{model}` and `{several}` through `edge.perception.runtime`, scan by scan, with its options as shipped. A contact "
    "begins at {on} counts of summed z; lighter presses of the wide test set make none, and count nowhere. A pattern "
    "is flagged if its own scan speaks against it: `unfamiliar`, no contact reads like that, or `unexplained`, it does "
    "not explain its readings. Sensors: the wide test set's readings with the gains of one sensor for each pad, in "
    "contacts of one scan, eleven a sensor, some repeated where few are firm. `sensor, after n`: sensors that n "
    "contacts have made suspected, whatever the next one reads. Nothing is known of a sensor unless a row names a "
    "file. 95 % intervals are by sensor; where all are alike, Clopper and Pearson's."
)
_DETECTED: Final = (
    "Faults of a sensor, the same in all of its contacts; wanted at least 95 %. Fields have 150 to 1500 counts on the "
    "reading where they are largest, and come after zeroing. `another pad's file`: constants and gains of another "
    "sensor, stated as certain. `no fault` is the share of false alarms, sensor by sensor."
)
_BY_STRENGTH: Final = (
    "Fields by their largest count: on a press, each on a sensor of its own; and on a free pad, where a field makes a "
    "contact only if it adds up to one: the others are ignored, and rightly so."
)
_HELD: Final = (
    "One taxel in contact repeats its last reading from some scan on: share of the sensors of which a pattern was "
    "flagged as `stuck` within so many scans. Held still: readings change by noise alone, so that the last pattern "
    "stays in use; moved: the force grows by a hundredth from scan to scan."
)
_STRIPED: Final = (
    "Stripes of one period, bars half a period wide, each press on a sensor of its own. What their layer does not let "
    "through no check of readings can miss: a smooth pattern explains them as well. The deviation alone shows it: "
    "pixels within the 90 % interval, and the error that the record states over the true one, are shown as well."
)
_TIMES: Final = (
    "Run times on one thread: paced, one part at each tick of 100 Hz in turn, with cold caches, medians with their "
    "95 % intervals; `all checks` is a scan's difference to one without them, pair by pair."
)


def _false_alarms(bench: Workbench, model: ModelSession, wide: FrozenPresses) -> list[Row]:
    """Return shares of flagged contacts by family, of unseen figures on the nominal pad, and of real grips."""
    begun = wide.pick(wide.presses.counts[:, 0, 2].sum(axis=(1, 2)) >= ON_COUNTS)
    verdicts = {known: _one_by_one(model, begun, known_pads(begun, known)) for known in (NOTHING, ALL)}
    rows: list[Row] = []
    for family in (*SHARES, "all"):
        here = (begun.presses.family == family) | (family == "all")
        if here.any():
            row: Row = {"contacts of": family, "contacts": int(here.sum())}
            for known, one in verdicts.items():
                row[f"{known} known %"] = share(one.flagged[here], begun.presses.pad[here])
            rows.append(row)
    figures = random_figures(TEST_FIGURES, TEST_FIGURES, TEST_SEED)
    for name, surfaces in (("glyphs", figures[:TEST_FIGURES]), ("polygons", figures[TEST_FIGURES:])):
        frozen = at_full_press(bench.frozen("test", surfaces))
        one = verdicts_on(model, [counts[None] for counts in frozen.windows(1)[:, 0]], [None] * len(frozen))
        rows.append(_alarms(f"unseen {name}, nominal pad", one.flagged, np.arange(len(one.flagged))))
    if recording_paths(recordings_folder()):
        grips = recorded_grips(recordings_folder())
        flagged = [real_flags(model, grip) for grip in tracked(grips, "playing", "recording")]
        groups = np.repeat(np.arange(len(flagged)), [len(one) for one in flagged])
        rows.append(_alarms(_GRIPS, np.concatenate(flagged), groups))
    return rows


def _alarms(name: str, flagged: NDArray[np.bool_], groups: NDArray[np.integer]) -> Row:
    return {"contacts of": name, "contacts": len(flagged), f"{NOTHING} known %": share(flagged, groups)}


def _one_by_one(model: ModelSession, presses: FrozenPresses, pads: Sequence[Pad | None]) -> Verdicts:
    return verdicts_on(model, [counts[None] for counts in presses.presses.counts[:, 0]], pads)


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


def _by_strength(model: ModelSession, sensors: FrozenPresses, count: int) -> list[Row]:
    """Return what is flagged of fields of several strengths, on presses and on free pads."""
    begun = firm(sensors).presses.counts[:, 0]
    rows: list[Row] = []
    for name, field in FIELDS.items():
        for low, high in pairwise(_STRENGTHS):
            rng = np.random.default_rng([SEED, round(low)])
            fields = np.stack([field(rng) for _ in range(count)])
            fields *= rng.uniform(low, high, (len(fields), 1, 1, 1)) / np.abs(fields).max(axis=(1, 2, 3), keepdims=True)
            pressed = begun[rng.integers(len(begun), size=len(fields))] + fields
            row: Row = {"field": name, "largest count": f"{low:.0f} to {high:.0f}", "fields": len(fields)}
            for where, counts in (("on a press", pressed), ("pad free", fields)):
                flagged = verdicts_on(model, [one[None] for one in counts], [None] * len(counts)).flagged
                row[f"{where}, contacts"] = len(flagged)
                row[f"{where}, flagged %"] = share(flagged) if len(flagged) else None
            rows.append(row)
    return rows


def _stripes(bench: Workbench, model: ModelSession) -> list[Row]:
    rows: list[Row] = []
    for period_mm, presses in striped_presses(*((2, 4) if bench.quick else _STRIPES)).items():
        sensors = of_one_sensor_each(presses)
        contacts = contacts_of(sensors)
        readings = [sensors.presses.counts[mine, 0] for mine in contacts]
        cells = verdicts_on(model, readings, [None] * len(contacts)).cells()
        rows.append({"period mm": period_mm} | cells | _told(model, presses))
    return rows


def _told(model: ModelSession, presses: FrozenPresses) -> Row:
    """Return the error of presses' patterns and the error that their deviations state, as cells of a row."""
    pushed = [PushedSensor(model, seed=at).touch(counts) for at, counts in enumerate(presses.presses.counts[:, 0])]
    begun = np.array([one.pattern is not None for one in pushed])
    truth, factor = presses.patterns()[begun], model.contract.interval_factor or np.nan
    made = [one for one in pushed if one.pattern is not None and one.deviation is not None]
    error = np.abs(np.stack([np.asarray(one.pattern) for one in made]) - truth)
    inside = error <= factor * np.stack([np.asarray(one.deviation) for one in made])
    rmse = np.sqrt((error**2).mean(axis=(1, 2)))
    stated = np.array([one.expected_rmse_mm or np.nan for one in made])
    return {
        "in the interval %": with_interval(100 * inside.mean(axis=(1, 2)), presses.presses.pad[begun], 1),
        "RMSE mm": round(float(rmse.mean()), 3),
        "stated over true RMSE": round(float(stated.mean() / rmse.mean()), 2),
    }


def _missed(false: Sequence[Row], found: Sequence[Row], foreign: Sequence[Row]) -> str:
    """Return the sentence that names what falls short of what is wanted."""
    last = f"sensor, after {max(AFTER)} %"
    alarms = [str(row["contacts of"]) for row in false if _first(row, f"{NOTHING} known %") > _wanted(row)]
    wrong = [row for row in found if not str(row["fault"]).startswith("no fault")]
    scans = [str(row["fault"]) for row in wrong if _first(row, "flagged %") < _LEAST_FOUND]
    contacts = [str(row["fault"]) for row in wrong if max(_first(row, "flagged %"), _first(row, last)) < _LEAST_FOUND]
    column = "all dropped %"
    taps = [str(row["earlier taps"]) for row in foreign if column in row and _first(row, column) < _LEAST_FOUND]
    return (
        f"Falls short. More false alarms than wanted: {', '.join(alarms) or 'nowhere'}. Flagged in fewer than "
        f"{_LEAST_FOUND:.0f} % of scans: {', '.join(scans) or 'nothing'}. Nor suspected after {max(AFTER)} contacts in "
        f"as many sensors: {', '.join(contacts) or 'nothing'}. Foreign taps not all dropped in as many windows: "
        f"{', '.join(taps) or 'nothing'}. Stripes: see their table."
    )


def _wanted(row: Row) -> float:
    return _MOST_OF_GRIPS if row["contacts of"] == _GRIPS else _MOST_ALARMS


def _first(row: Row, column: str) -> float:
    return float(str(row.get(column) or 0).split()[0])


def _plot(report: Report, found: Sequence[Row]) -> None:
    columns = ["flagged %", *(f"sensor, after {number} %" for number in AFTER[1:])]
    with report.figure(size=(9, 8)) as figure:
        axes = figure.subplots()
        for number, column in enumerate(columns):
            places = np.arange(len(found)) + 0.2 * (number - 1.5)
            axes.barh(places, [_first(row, column) for row in found], 0.2, label=column.removesuffix(" %"))
        axes.set(yticks=range(len(found)), xlabel="share of scans, or of sensors [%]")
        axes.set_yticklabels([str(row["fault"]) for row in found], fontsize=8)
        axes.axvline(_LEAST_FOUND, linestyle=":", color="grey")
        axes.invert_yaxis()
        axes.legend(fontsize=8)
