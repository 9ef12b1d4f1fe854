"""Shipped models on readings, by the session of the runtime and by the whole of it, with its verdicts on contacts."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import OFF_COUNTS, ON_COUNTS, RuntimeOptions
from edge.perception.result import Result
from edge.perception.runtime import Model, Runtime
from edge.perception.sensor import NOISE_COUNTS
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.zeroing.baseline import Baseline
from train.data.frozen_presses import FrozenPresses
from train.report import Row, bootstrap_interval

NOTHING, ALL = "nothing", "pad and gains"
"""Levels of knowledge about a sensor: nothing, or all constants of its pad with the taxels' gains."""
SHORT: Final = {NOTHING: "model", ALL: "model, all known"}
"""Names of the levels in tables."""


class Inferred(NamedTuple):
    """Patterns and deviations (n, H, W) in [mm], zeros if the model gives none, and the median run time in [us]."""

    patterns: NDArray[np.float32]
    deviations: NDArray[np.float32]
    run_time_us: float


def known_pads(frozen: FrozenPresses, known: str) -> list[Pad | None]:
    """Return what a level of knowledge provides of each press's sensor."""
    return [frozen.pad(index, gains=True) if known == ALL else None for index in range(len(frozen))]


def infer(
    model: ModelSession,
    windows: NDArray[np.float32],
    pads: Sequence[Pad | None],
    poses: NDArray[np.float32] | None = None,
) -> Inferred:
    """Run a model as the runtime does, on each window of as many taps as it takes, (n, taps, 3, rows, cols) as read.

    `pads` are the constants that are known of each sensor; poses are (n, taps, 5), None for the paper's schedule.
    """
    contract = model.contract
    patterns, deviations, times_s = [], [], []
    for number, (window, pad) in enumerate(zip(windows, pads, strict=True)):
        gains = None
        if contract.takes_gains and pad is not None and pad.gains is not None:
            gains = np.asarray(pad.gains, dtype=np.float32).reshape(window.shape[1:])
        row = contract.pad_row(pad)
        started_s = time.perf_counter()
        pattern = model.run(contract.scale_window(window, gains), row, None if poses is None else poses[number])
        times_s.append(time.perf_counter() - started_s)
        patterns.append(pattern.copy())
        deviations.append(np.zeros_like(pattern) if model.deviation is None else model.deviation.copy())
    return Inferred(np.stack(patterns), np.stack(deviations), 1e6 * float(np.median(times_s)))


def infer_presses(model: ModelSession, frozen: FrozenPresses, known: str) -> Inferred:
    """Run a model on frozen presses with what a level of knowledge provides."""
    return infer(model, frozen.windows(model.contract.taps), known_pads(frozen, known))


SHIPPED: Final = RuntimeOptions(follow_drift=False)
"""Options of the shipped runtime, but for the rest level, which follows a pad that is free for longer than here."""
_REST: Final = np.array((16_000, 16_400, 38_600), dtype=np.int32)[:, None, None] * np.ones((1, 4, 4), dtype=np.int32)
_SENSOR: Final = "4"
_PERIOD_NS: Final = 10_000_000
_FREE_SCANS: Final = 2
_TAP_SCANS: Final = 2
"""Scans of an earlier tap: one alone may be a flipped bit, and is not remembered."""


class PushedSensor:
    """Sensor whose scans go through a runtime of its own; `suspected` if the last scan's events leave it so."""

    def __init__(self, model: Model, pad: Pad | None = None, seed: int = 0, options: RuntimeOptions = SHIPPED) -> None:
        baseline = Baseline.of(_SENSOR, _REST.astype(np.float32), created_unix_s=0.0, scans=100, origin="start-up")
        self._runtime = Runtime(model, source="replay", baselines={_SENSOR: baseline}, pad=pad, options=options)
        self._series = ScanSeries(_SENSOR, USPA44)
        self._rng = np.random.default_rng([seed, 11])
        self._time_ns = 0
        self.suspected = False

    def noise(self) -> NDArray[np.float32]:
        """Draw the noise of a scan, (3, rows, cols) in counts."""
        return NOISE_COUNTS * self._rng.standard_normal(USPA44.scan_shape, dtype=np.float32)

    def push(self, counts: NDArray[np.floating], *, infer: bool = True) -> Result:
        """Return the result of the next scan, of zeroed counts (3, rows, cols)."""
        self._time_ns += _PERIOD_NS
        raw = np.clip(_REST + np.rint(counts).astype(np.int32), 1, 65_534)
        result = self._runtime.push(self._series.close(raw, self._time_ns), infer=infer)
        for event in result.events:
            self.suspected = event.kind == "suspected" or (self.suspected and event.kind != "cleared")
        return result

    def free(self) -> Result:
        """Return the last result of a free pad."""
        return [self.push(self.noise()) for _ in range(_FREE_SCANS)][-1]

    def touch(self, counts: NDArray[np.floating]) -> Result:
        """Return the result of one scan of a contact on a pad that was free before."""
        self.free()
        return self.push(counts)

    def tap(self, window: Sequence[NDArray[np.floating]] | NDArray[np.floating]) -> Result:
        """Return the result of the newest of several taps (K, 3, rows, cols), after those that are not inferred."""
        for earlier in reversed(window[1:]):
            self.free()
            for _ in range(_TAP_SCANS):
                self.push(earlier + self.noise(), infer=False)
        return self.touch(window[0])


AFTER: Final = (1, 3, 5, 10)
"""Contacts after which the running evidence is looked at."""
CONTACTS: Final = max(AFTER) + 1
"""Contacts of each sensor; the evidence of one is weighed when the next begins."""
_OWN: Final = ("stuck", "unfamiliar", "unexplained", "uncertain", "beyond", "pad")
"""Reasons that a scan gives by itself."""
RIGHT, WRONG, FAR_OFF = 0.3, 0.5, 1.0
"""RMS error over the RMS of the truth: below the first a pattern is right, above the others wrong and far off."""
_LIGHT: Final = RuntimeOptions(follow_drift=False, contact_on_counts=OFF_COUNTS)


@dataclass(frozen=True, slots=True)
class Verdicts:
    """Verdicts on m contacts of several sensors: the reason is empty where believed, too light ones are not checked.

    `suspected` tells for each number of AFTER whether each sensor with more contacts than that was suspected.
    """

    sensor: NDArray[np.int64]
    reason: NDArray[np.str_]
    checked: NDArray[np.bool_]
    suspected: dict[int, list[bool]]

    @property
    def flagged(self) -> NDArray[np.bool_]:
        """Contacts (m,) that a scan speaks against by itself."""
        return np.isin(self.reason, _OWN)

    def cells(self) -> Row:
        """Return shares of the contacts, and of suspected sensors, as cells of a row."""
        row: Row = {"contacts": len(self.sensor)}
        if not len(self.sensor):
            return row
        row |= {"too light": int((~self.checked).sum()), "flagged %": share(self.flagged, self.sensor)}
        row |= {f"{reason} %": round(100 * float((self.reason == reason).mean()), 1) for reason in _OWN[1:]}
        return row | {
            f"sensor, after {number} %": share(np.array(sensors))
            for number, sensors in self.suspected.items()
            if sensors
        }


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


def verdicts_on(model: Model, sensors: Sequence[NDArray[np.floating]], pads: Sequence[Pad | None]) -> Verdicts:
    """Return the verdicts on each sensor's contacts (n, 3, rows, cols) in their order, with what its file holds."""
    rows: list[tuple[int, str, bool]] = []
    suspected: dict[int, list[bool]] = {number: [] for number in AFTER}
    for number, (contacts, pad) in enumerate(zip(sensors, pads, strict=True)):
        sensor, seen = PushedSensor(model, pad, seed=number), 0
        for counts in contacts:
            result = sensor.touch(counts)
            if result.pattern is None:
                continue
            rows.append((number, result.untrusted_reason or "", result.trusted is not None))
            sensor.free()  # it brings the events of the contact, which follow from the evidence of those before
            if seen in suspected:
                suspected[seen].append(sensor.suspected)
            seen += 1
    number, reason, checked = zip(*rows, strict=True) if rows else ((), (), ())
    return Verdicts(np.array(number, dtype=int), np.array(reason, dtype=str), np.array(checked, dtype=bool), suspected)


def judged(model: Model, presses: FrozenPresses, pads: Sequence[Pad | None]) -> Judged:
    """Return the verdicts on the newest taps of presses, each of a sensor of its own, with what its file holds."""
    truths = presses.patterns()
    rows: list[tuple[int, float, bool, bool]] = []
    for number, (counts, pad) in enumerate(zip(presses.presses.counts[:, 0], pads, strict=True)):
        sum_z = float(counts[2].sum())
        if sum_z < OFF_COUNTS:
            continue
        result = PushedSensor(model, pad, seed=number, options=_LIGHT).touch(counts)
        if result.pattern is None or result.trusted is None:
            continue
        off = float(np.sqrt(np.mean((result.pattern - truths[number]) ** 2) / np.mean(truths[number] ** 2)))
        rows.append((number, off, result.trusted, sum_z < ON_COUNTS))
    return Judged(*map(np.array, zip(*rows, strict=True)))
