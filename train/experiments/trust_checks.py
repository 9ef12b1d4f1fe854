"""Checks of patterns by the shipped models, through the runtime: wrong patterns, false alarms, faults of a sensor.

Faults are the same in all contacts of a sensor: fields near the pad, wrong places and axes, and wrong gains.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from edge.inference.bundled import INT8_SUFFIX
from edge.inference.onnx_session import ModelSession
from edge.perception.result import NOISE_COUNTS, Result
from edge.perception.run_options import OFF_COUNTS, ON_COUNTS, RuntimeOptions
from edge.perception.runtime import Model, Runtime
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.zeroing.baseline import Baseline
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.presses import SEED
from train.data.real_grips import play, recorded_grips, recording_paths, recordings_folder
from train.data.world import World
from train.errors import CheckpointError
from train.experiments.workbench import Workbench, known_pads
from train.families.catalogue import SHARES
from train.learning.checks import magnet_field
from train.networks.symmetric import symmetries
from train.report import Report, Row, bootstrap_interval

JUDGED: Final = World(count=8000, per_pad=4, families=dict.fromkeys(SHARES, 1.0), seed=7_700_103)
_MODELS: Final = ("stsr", "mtsr", "stsr-small")


def trust_checks(bench: Workbench, report: Report) -> None:
    """Count patterns not believed, rightly and wrongly; CheckpointError if a model has no checks."""
    model = bench.model()
    models = [bench.model(f"{name}{INT8_SUFFIX}") for name in (_MODELS[:2] if bench.quick else _MODELS)]
    for one in models:
        if one.contract.read_trust() is None:
            raise CheckpointError(f"{one.name} has no checks: export it with --trust")
    wide = bench.wide_test()
    wide = wide.pick(np.arange(12)) if bench.quick else wide
    fresh = freeze_presses(bench.presses("judged", JUDGED), SEED)
    verdicts = judged(model, fresh, known_pads(fresh, False))
    report.say(
        "Shipped models through `edge.perception.runtime`, scan by scan, with its options; nothing is known of a "
        "sensor unless a row states it. How far a pattern is off is its RMS error over the RMS of the truth. Contacts "
        "less than 30 % off that are not believed are false alarms, wanted at most 2 %; of those more than 50 % off 30 "
        "% are wanted not believed, of those more than 100 % off 80 %."
    )
    family = fresh.presses.family[verdicts.index]
    which = {name: (family == name) & ~verdicts.light for name in SHARES}
    which |= {"all": ~verdicts.light, "light": verdicts.light}
    rows: list[Row] = [{"contacts of": name} | verdicts.cells(here) for name, here in which.items()]
    report.table(
        rows,
        "Fresh contacts by family, every press of a sensor of its own. `light`: a summed z of 750 to 1500 counts, in "
        "which a contact can end, but not begin; the other rows leave them out.",
    )
    half = fresh.pick(np.arange(0, len(fresh), 2))  # which is enough to compare models
    report.table(_by_model(models, half), "Half of these contacts by model, one tap each, of all families.")
    if recording_paths(recordings_folder()):
        report.table(_grips(models), "Scans of real grips under load, both fingers: not believed, wanted at most 3 %.")
    report.table(
        _detected(model, wide.pick(wide.presses.pad % 3 == 0)),
        "Faults of a sensor, the same in all of its eleven contacts, of the wide test set. Fields have 150 to 1500 "
        "counts on the reading where they are largest, and come after zeroing. `another pad's file`: constants and "
        "gains of another sensor, stated as certain. `sensor, after 10`: sensors that ten contacts have made "
        "suspected. 95 % intervals are by sensor; where all are alike, Clopper and Pearson's.",
    )


def _by_model(models: Sequence[ModelSession], presses: FrozenPresses) -> list[Row]:
    rows: list[Row] = []
    for model in tracked(models, "models", "model"):
        for known in (False, True) if model is models[0] else (False,):
            one = judged(model, presses, known_pads(presses, known))
            rows.append({"model": model.name, "known": "pad and gains" if known else "nothing"} | one.cells(~one.light))
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


def _detected(model: ModelSession, wide: FrozenPresses) -> list[Row]:
    pads, first, place = np.unique(wide.presses.pad, return_index=True, return_inverse=True)
    of_one_sensor = (wide.gains[first][place] / wide.gains).astype(np.float32)  # in place of one for each press
    counts = wide.presses.counts[:, 0] * of_one_sensor
    firm = counts[:, 2].sum(axis=(1, 2)) >= ON_COUNTS
    contacts = [np.flatnonzero(firm & (wide.presses.pad == pad)) for pad in pads]
    readings = [counts[np.resize(mine, CONTACTS)] for mine in contacts if len(mine)]  # few firm ones are repeated
    own = [wide.pad(int(number), gains=True) for number, mine in zip(first, contacts, strict=True) if len(mine)]
    nothing: list[Pad | None] = [None] * len(readings)
    given: dict[str, tuple[Sequence[NDArray[np.floating]], Sequence[Pad | None]]] = {
        "no fault": (readings, nothing),
        "another pad's file": (readings, [*own[1:], own[0]]),
    }
    for name, fault in FAULTS.items():
        wrong = [fault(np.random.default_rng([SEED, number]), one) for number, one in enumerate(readings)]
        given[name] = (wrong, nothing)
    for name, field in FIELDS.items():
        alone = [field(np.random.default_rng([SEED, number])) for number in range(len(readings))]
        given[f"{name}, the pad free"] = ([np.tile(one, (CONTACTS, 1, 1, 1)) for one in alone], nothing)
    return [{"fault": name} | verdicts_on(model, *one) for name, one in tracked(given.items(), "faults", "fault")]


AFTER: Final = 10  # contacts after which a sensor may be suspected
CONTACTS: Final = AFTER + 1  # of each sensor; the evidence of one is weighed when the next begins
_OWN: Final = ("stuck", "unfamiliar", "unexplained", "uncertain", "beyond", "pad")  # reasons of a scan by itself
RIGHT, WRONG, FAR_OFF = 0.3, 0.5, 1.0  # RMS error over the RMS of the truth: right below, wrong and far off above


@dataclass(frozen=True, slots=True)
class Judged:
    """Contacts of n sensors, one each, which the runtime checked."""

    index: NDArray[np.int64]  # (n,) among the presses
    off: NDArray[np.float64]  # RMS error over the RMS of the truth
    believed: NDArray[np.bool_]
    light: NDArray[np.bool_]  # between the counts that end and begin a contact

    def cells(self, here: NDArray[np.bool_]) -> Row:
        """Return the shares of those `here` (n,) that are not believed as cells of a row."""
        right = ~self.believed[here & (self.off < RIGHT)]
        row: Row = {"contacts": int(here.sum())}
        row[f"of those < {RIGHT:.0%} off, not believed %"] = share(right) if len(right) else None
        for least in (WRONG, FAR_OFF):
            found = ~self.believed[here & (self.off > least)]
            row[f"> {least:.0%} off"] = len(found)
            row[f"> {least:.0%} off, not believed %"] = share(found) if len(found) else None
        return row


def share(hits: NDArray[np.bool_], groups: NDArray[np.integer] | None = None) -> str:
    """Return a share in percent with its 95 % interval by group, which is Clopper and Pearson's where all are alike."""
    groups = np.arange(len(hits)) if groups is None else groups
    mean = float(hits.mean())
    if 0 < mean < 1:
        low, high = bootstrap_interval(hits.astype(float), groups)
    else:
        count = len(np.unique(groups))
        low, high = (0.0, beta.ppf(0.975, 1, count)) if mean == 0 else (beta.ppf(0.025, count, 1), 1.0)
    return f"{100 * mean:.1f} ({100 * low:.1f}..{100 * high:.1f})"


def verdicts_on(model: Model, sensors: Sequence[NDArray[np.floating]], pads: Sequence[Pad | None]) -> Row:
    """Return the verdicts on each sensor's contacts (n, 3, rows, cols) in their order, with what its file holds.

    They are shares of the contacts, and of the sensors with more contacts than AFTER that were suspected by then.
    """
    rows, suspected = list[tuple[int, str]](), list[bool]()
    for number, (contacts, pad) in enumerate(zip(sensors, pads, strict=True)):
        pushed, seen = PushedSensor(model, pad, seed=number), 0
        for counts in contacts:
            result = pushed.touch(counts)
            if result.pattern is None:
                continue
            rows.append((number, result.untrusted_reason or ""))
            pushed.free()  # it brings the events of the contact, which follow from the evidence of those before
            if seen == AFTER:
                suspected.append(pushed.suspected)
            seen += 1
    if not rows:
        return {"contacts": 0}
    sensor, reason = map(np.array, zip(*rows, strict=True))
    row: Row = {"contacts": len(rows), "flagged %": share(np.isin(reason, _OWN), sensor)}
    row |= {f"{name} %": round(100 * float((reason == name).mean()), 1) for name in _OWN[1:]}
    return row | {f"sensor, after {AFTER} %": share(np.array(suspected)) if suspected else None}


def judged(model: Model, presses: FrozenPresses, pads: Sequence[Pad | None]) -> Judged:
    """Return the verdicts on the newest taps of presses, each of a sensor of its own, with what its file holds."""
    truths, light = presses.patterns(), RuntimeOptions(follow_drift=False, contact_on_counts=OFF_COUNTS)
    rows: list[tuple[int, float, bool, bool]] = []
    for number, (counts, pad) in enumerate(zip(presses.presses.counts[:, 0], pads, strict=True)):
        sum_z = float(counts[2].sum())
        if sum_z < OFF_COUNTS:
            continue
        result = PushedSensor(model, pad, seed=number, options=light).touch(counts)
        if result.pattern is None or result.trusted is None:
            continue
        off = float(np.sqrt(np.mean((result.pattern - truths[number]) ** 2) / np.mean(truths[number] ** 2)))
        rows.append((number, off, result.trusted, sum_z < ON_COUNTS))
    return Judged(*map(np.array, zip(*rows, strict=True)))


Counts = NDArray[np.float32]  # readings of one sensor, (n, 3, rows, cols), zeroed
Fault = Callable[[np.random.Generator, Counts], Counts]  # readings of one sensor as a fault changes them
Field = Callable[[np.random.Generator], Counts]  # what something near the pad adds to each reading, (3, rows, cols)

_MAGNET_MM, _CHIP_MM, _PAD_TOP_MM = 2.5, 0.5, 4.5
_MOVES: Final = (
    *("turned by 90 degrees", "turned by 180 degrees", "turned by 270 degrees"),
    *("mirrored", "mirrored and turned by 90", "mirrored and turned by 180", "mirrored and turned by 270"),
)


def steel_field(rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw the counts (3, rows, cols) that a steel plate above the pad adds: images of the pad's own magnets.

    The image of an upright magnet in a plate is upright too, as far above the plate as the magnet is below. The plate
    is wider than the pad, leans by up to eleven degrees, and its largest count is drawn, as a far magnet's is.
    """
    x_mm, y_mm = USPA44.taxel_centres_mm().T
    slope = rng.uniform(-0.2, 0.2, 2)
    lean_mm = slope[0] * x_mm + slope[1] * y_mm
    gap_mm = rng.uniform(1.0, 8.0) + lean_mm - lean_mm.min()
    image_mm = 2 * (_PAD_TOP_MM + gap_mm) - _MAGNET_MM
    below_mm = np.broadcast_to(_CHIP_MM - image_mm, (16, 16))
    away = np.stack([x_mm[:, None] - x_mm, y_mm[:, None] - y_mm, below_mm])  # (3, chips, images)
    square = (away**2).sum(axis=0)
    field = 3 * away * away[2] / square**2.5
    field[2] -= square**-1.5
    total = field.sum(axis=2).reshape(USPA44.scan_shape)
    return (total / np.abs(total).max() * rng.uniform(150.0, 1500.0)).astype(np.float32)


def _added(field: Field) -> Fault:
    return lambda rng, counts: counts + field(rng)


def _moved(number: int) -> Fault:
    return lambda rng, counts: np.ascontiguousarray(symmetries("p4m")[number](counts), dtype=np.float32)


def _places(order: Callable[[np.random.Generator], NDArray[np.integer]]) -> Fault:
    """Return the fault by which taxels are at other places, the same for all axes."""
    return lambda rng, counts: counts.reshape(*counts.shape[:2], -1)[:, :, order(rng)].reshape(counts.shape)


def _neighbours(rng: np.random.Generator) -> NDArray[np.integer]:
    order = np.arange(USPA44.taxel_count)
    row, col = rng.integers(USPA44.rows), rng.integers(USPA44.cols - 1)
    taxel = row * USPA44.cols + col
    order[[taxel, taxel + 1]] = taxel + 1, taxel
    return order


def _axes(order: tuple[int, int, int], signs: tuple[int, int, int] = (1, 1, 1)) -> Fault:
    return lambda rng, counts: counts[:, order] * np.array(signs, dtype=np.float32)[:, None, None]


def _gains(rng: np.random.Generator, counts: Counts) -> Counts:
    return counts * (1 + 0.25 * rng.standard_normal(counts.shape[1:])).astype(np.float32)


_GRID: Final = np.arange(USPA44.taxel_count).reshape(USPA44.rows, USPA44.cols)
FIELDS: Final[dict[str, Field]] = {
    "a magnet near the pad": lambda rng: magnet_field(rng, 1)[0],
    "a steel plate near the pad": steel_field,
}
FAULTS: Final[dict[str, Fault]] = {
    **{name: _added(field) for name, field in FIELDS.items()},
    **{f"places {name}": _moved(number) for number, name in enumerate(_MOVES, 1)},
    "rows exchanged in pairs": _places(lambda rng: _GRID[[1, 0, 3, 2]].ravel()),
    "columns exchanged in pairs": _places(lambda rng: _GRID[:, [1, 0, 3, 2]].ravel()),
    "places shuffled": _places(lambda rng: rng.permutation(USPA44.taxel_count)),
    "two neighbours exchanged": _places(_neighbours),
    "x and y exchanged": _axes((1, 0, 2)),
    "x and z exchanged": _axes((2, 1, 0)),
    "y and z exchanged": _axes((0, 2, 1)),
    "x turned": _axes((0, 1, 2), (-1, 1, 1)),
    "y turned": _axes((0, 1, 2), (1, -1, 1)),
    "x and y turned": _axes((0, 1, 2), (-1, -1, 1)),
    "gains off by a quarter": _gains,
}


SHIPPED: Final = RuntimeOptions(follow_drift=False)
"""Options of the shipped runtime, but for the rest level, which follows a pad that is free for longer than here."""
_REST: Final = np.array((16_000, 16_400, 38_600), dtype=np.int32)[:, None, None] * np.ones((1, 4, 4), dtype=np.int32)
_SENSOR: Final = "4"


class PushedSensor:
    """Sensor whose scans go through a runtime of its own; `suspected` if the last scan's events leave it so."""

    def __init__(self, model: Model, pad: Pad | None = None, seed: int = 0, options: RuntimeOptions = SHIPPED) -> None:
        baseline = Baseline.of(_SENSOR, _REST.astype(np.float32), created_unix_s=0.0, scans=100, origin="start-up")
        self._runtime = Runtime(model, source="replay", baselines={_SENSOR: baseline}, pad=pad, options=options)
        self._series = ScanSeries(_SENSOR, USPA44)
        self._rng = np.random.default_rng([seed, 11])
        self._time_ns = 0
        self.suspected = False

    def free(self) -> None:
        """Push the noise of a free pad."""
        for _ in range(2):
            self.push(NOISE_COUNTS * self._rng.standard_normal(USPA44.scan_shape, dtype=np.float32))

    def push(self, counts: NDArray[np.floating]) -> Result:
        """Return the result of the next scan, of zeroed counts (3, rows, cols)."""
        self._time_ns += 10_000_000
        raw = np.clip(_REST + np.rint(counts).astype(np.int32), 1, 65_534)
        result = self._runtime.push(self._series.close(raw, self._time_ns))
        for event in result.events:
            self.suspected = event.kind == "suspected" or (self.suspected and event.kind != "cleared")
        return result

    def touch(self, counts: NDArray[np.floating]) -> Result:
        """Return the result of one scan of a contact on a pad that was free before."""
        self.free()
        return self.push(counts)
