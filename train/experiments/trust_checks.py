"""Checks of patterns by the shipped models, through the runtime: wrong patterns, false alarms, faults, foreign taps.

What is judged here has set nothing: networks, checks and limits were fitted on other pads' presses.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from edge.evaluation.metrics import psnr_db
from edge.inference.bundled import INT8_SUFFIX
from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import OFF_COUNTS, ON_COUNTS, RuntimeOptions
from edge.perception.runtime import Model
from edge.terminal.progress_bar import tracked
from firmware_bridge.scans.pad_constants import Pad
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.presses import SEED
from train.data.real_grips import play, recorded_grips, recording_paths, recordings_folder
from train.data.world import World
from train.errors import CheckpointError
from train.experiments.sensor_faults import FAULTS, FIELDS, PushedSensor
from train.experiments.workbench import Workbench, known_pads
from train.families.family_shares import SHARES
from train.physics.gripped import MAX_INDENTATION_MM
from train.report import Report, Row, bootstrap_interval, with_interval

JUDGED: Final = World(count=8000, per_pad=4, families=dict.fromkeys(SHARES, 1.0), seed=7_700_103)
_MODELS: Final = ("stsr", "mtsr", "stsr-small")


def trust_checks(bench: Workbench, report: Report) -> None:
    """Count patterns not believed and taps dropped, rightly and wrongly; CheckpointError if a model has no checks."""
    model = bench.model()
    models = [bench.model(f"{name}{INT8_SUFFIX}") for name in (_MODELS[:2] if bench.quick else _MODELS)]
    for one in models:
        if one.contract.read_trust() is None:
            raise CheckpointError(f"{one.name} has no checks: export it with --trust")
    wide = bench.wide_test()
    wide = wide.pick(np.arange(12)) if bench.quick else wide
    # A third of the sensors is enough for the faults, and half of the presses to compare models.
    sensors = of_one_sensor_each(wide.pick(wide.presses.pad % 3 == 0))
    fresh = freeze_presses(bench.presses("judged", JUDGED), SEED)
    verdicts = judged(model, fresh, known_pads(fresh, False))
    report.say(_METHOD)
    family = fresh.presses.family[verdicts.index]
    which = {name: (family == name) & ~verdicts.light for name in SHARES}
    which |= {"all": ~verdicts.light, "light": verdicts.light}
    report.table([{"contacts of": name} | verdicts.cells(here) for name, here in which.items()], _FAMILIES)
    half = fresh.pick(np.arange(0, len(fresh), 2))
    report.table(_by_model(models, half), "Half of these contacts by model, one tap each, of all families.")
    if recording_paths(recordings_folder()):
        report.table(_grips(models), _GRIPS)
    report.table(_detected(model, sensors), _DETECTED)
    report.table(_taps(model, bench.models / f"{_MODELS[1]}{INT8_SUFFIX}.onnx", firm(sensors)), _GUARDED)


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
    return [{"fault": name} | verdicts_on(model, *one) for name, one in tracked(given.items(), "faults", "fault")]


AFTER: Final = (1, 3, 5, 10)  # contacts after which the running evidence is looked at
CONTACTS: Final = max(AFTER) + 1  # contacts of each sensor; the evidence of one is weighed when the next begins
_OWN: Final = ("stuck", "unfamiliar", "unexplained", "uncertain", "beyond", "pad")
"""Reasons that a scan gives by itself."""
RIGHT, WRONG, FAR_OFF = 0.3, 0.5, 1.0
"""RMS error over the RMS of the truth: below the first a pattern is right, above the others wrong and far off."""


@dataclass(frozen=True, slots=True)
class Judged:
    """Contacts of n sensors, one each, which the runtime checked, at an index (n,) among the presses.

    `off` is the RMS error over the RMS of the truth; `light` are those between the counts that end and begin a contact.
    """

    index: NDArray[np.int64]
    off: NDArray[np.float64]
    believed: NDArray[np.bool_]
    light: NDArray[np.bool_]

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


def of_one_sensor_each(wide: FrozenPresses) -> FrozenPresses:
    """Return the presses with the gains of one sensor for each pad, in place of those of a sensor for each press."""
    _, first, place = np.unique(wide.presses.pad, return_index=True, return_inverse=True)
    gains = wide.gains[first][place]
    return FrozenPresses(replace(wide.presses, counts=wide.presses.counts * (gains / wide.gains)[:, None]), gains)


def contacts_of(sensors: FrozenPresses) -> list[NDArray[np.int64]]:
    """Return the presses that make the contacts of each sensor; one with few firm presses repeats them."""
    firm = sensors.presses.counts[:, 0, 2].sum(axis=(1, 2)) >= ON_COUNTS
    pads = sensors.presses.pad
    mine = [np.flatnonzero(firm & (pads == pad)) for pad in np.unique(pads)]
    return [np.resize(presses, CONTACTS) for presses in mine if len(presses)]


def verdicts_on(model: Model, sensors: Sequence[NDArray[np.floating]], pads: Sequence[Pad | None]) -> Row:
    """Return the verdicts on each sensor's contacts (n, 3, rows, cols) in their order, with what its file holds.

    They are shares of the contacts, of which too light ones are not checked, and of the sensors with more contacts than
    each number of AFTER that were suspected by then, as cells of a row.
    """
    rows: list[tuple[int, str, bool]] = []
    suspected: dict[int, list[bool]] = {number: [] for number in AFTER}
    for number, (contacts, pad) in enumerate(zip(sensors, pads, strict=True)):
        pushed, seen = PushedSensor(model, pad, seed=number), 0
        for counts in contacts:
            result = pushed.touch(counts)
            if result.pattern is None:
                continue
            rows.append((number, result.untrusted_reason or "", result.trusted is not None))
            pushed.free()  # it brings the events of the contact, which follow from the evidence of those before
            if seen in suspected:
                suspected[seen].append(pushed.suspected)
            seen += 1
    if not rows:
        return {"contacts": 0}
    sensor, reason, checked = map(np.array, zip(*rows, strict=True))
    flagged = share(np.isin(reason, _OWN), sensor)
    row: Row = {"contacts": len(rows), "too light": int((~checked).sum()), "flagged %": flagged}
    row |= {f"{name} %": round(100 * float((reason == name).mean()), 1) for name in _OWN[1:]}
    return row | {f"sensor, after {number} %": share(np.array(some)) for number, some in suspected.items() if some}


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


_DEPTHS: Final = (0.85, 1.15)
_GUARDED: Final = (
    "Windows of four taps: share of each earlier one that the runtime finds not to belong, newest first; of windows of "
    "which it drops some, and all. In the row `right` these are false alarms, wanted at most 1 %; in the others at "
    "least 95 % are wanted. The order reversed leaves the middle tap right. Then the PSNR in dB by the model of one "
    "tap, and by that of four without and with the guard. Wanted: with it, never more than 0.3 dB below one tap. "
    "Intervals are by sensor; guard and options are as shipped, and every tap is used."
)


def _taps(single: ModelSession, several: Path, sensors: FrozenPresses) -> list[Row]:
    guarding, unguarded = (ModelSession(several, taps=4) for _ in range(2))
    unguarded.contract = replace(unguarded.contract, trust={})
    taps, name = guarding.contract.taps, guarding.name
    pads, rows = sensors.presses.pad, list[Row]()
    for case, (counts, truth) in tracked(cases(sensors).items(), "tapping", "case"):
        alone_db, _, _ = guarded(single, counts, truth, 1)
        off_db, _, _ = guarded(unguarded, counts, truth, taps)
        on_db, used, foreign = guarded(guarding, counts, truth, taps)
        row: Row = {"earlier taps": case, "windows": len(counts)}
        row |= {f"tap {number} %": share(foreign[:, number - 1], pads) for number in range(1, taps)}
        row["some dropped %"] = share(np.logical_or.reduce(foreign, axis=1), pads)
        row |= {"all dropped %": share(used == 1, pads), single.name: round(float(alone_db.mean()), 2)}
        for how, found_db in (("no guard", off_db), ("guard", on_db)):
            row[f"{name}, {how}"] = round(float(found_db.mean()), 2)
            row[f"{how}, over one tap"] = with_interval(found_db - alone_db, pads, sign="+")
        rows.append(row)
    return rows


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


def guarded(
    model: Model, windows: NDArray[np.floating], truth: NDArray[np.float32], taps: int
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Push each window through a runtime of its own, the newest tap being inferred.

    Returns the PSNR (n,) in [dB], the taps used (n,), and which earlier ones do not belong, (n, K - 1).
    """
    patterns, used, foreign = [], [], []
    for number, counts in enumerate(windows):
        result = PushedSensor(model, seed=number).tap(counts[:taps])
        patterns.append(np.asarray(result.pattern))  # there is one, since taps that begin no contact are left out
        used.append(result.taps_used)
        foreign.append([mismatch >= 0.5 for mismatch in result.tap_mismatch or ()])
    return psnr_db(np.stack(patterns), truth, MAX_INDENTATION_MM), np.array(used), np.array(foreign, dtype=bool)
