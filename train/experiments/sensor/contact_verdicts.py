"""Verdicts of the runtime on contacts: of sensors with a fault, and beside how far each pattern is off."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from edge.perception.contact_options import OFF_COUNTS, ON_COUNTS, RuntimeOptions
from edge.perception.runtime import Model
from firmware_bridge.scans.pad_constants import Pad
from train.data.frozen_presses import FrozenPresses
from train.experiments.sensor.pushed import PushedSensor
from train.report import Row, bootstrap_interval

AFTER: Final = (1, 3, 5, 10)
"""Contacts after which the running evidence is looked at."""
CONTACTS: Final = max(AFTER) + 1
"""Contacts of each sensor; the evidence of one is weighed when the next begins."""
_OWN: Final = ("stuck", "unfamiliar", "unexplained", "uncertain", "beyond", "pad")
"""Reasons that a scan gives by itself."""
RIGHT, WRONG, FAR_OFF = 0.3, 0.5, 1.0
"""RMS error of a pattern over the RMS of the truth: below the first it is right, above the others wrong and far off."""
_LIGHT: Final = RuntimeOptions(follow_drift=False, contact_on_counts=OFF_COUNTS)


@dataclass(frozen=True, slots=True)
class Verdicts:
    """Verdicts on m contacts of several sensors.

    Attributes:
        sensor: (m,) number of the sensor.
        reason: (m,) why the pattern is not to be believed, empty if it is.
        checked: (m,) False for contacts that are too light to tell.
        suspected: for each number of AFTER, whether each sensor with more contacts than that was suspected.
    """

    sensor: NDArray[np.int64]
    reason: NDArray[np.str_]
    checked: NDArray[np.bool_]
    suspected: dict[int, NDArray[np.bool_]]

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
            f"sensor, after {number} %": share(sensors) for number, sensors in self.suspected.items() if len(sensors)
        }


@dataclass(frozen=True, slots=True)
class Judged:
    """Contacts of n sensors, one each, which the runtime checked.

    Attributes:
        index: (n,) places among the presses.
        off: (n,) RMS error of the pattern over the RMS of the truth.
        believed: (n,).
        light: (n,) summed z between the counts that end a contact and those that begin one.
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
    """Return the verdicts on the contacts of each sensor, one scan each, in their order.

    Args:
        model: of the runtime.
        sensors: readings (n, 3, rows, cols) of each.
        pads: what the sensor file of each holds.
    """
    rows: list[tuple[int, str, bool]] = []
    suspected: dict[int, list[bool]] = {number: [] for number in AFTER}
    for number, (contacts, pad) in enumerate(zip(sensors, pads, strict=True)):
        sensor = PushedSensor(model, pad, seed=number)
        seen = 0
        for counts in contacts:
            result = sensor.touch(counts)
            if result.pattern is None:
                continue
            rows.append((number, result.untrusted_reason or "", result.trusted is not None))
            sensor.free()  # it brings the events of the contact, which follow from the evidence of those before
            if seen in suspected:
                suspected[seen].append(sensor.suspected)
            seen += 1
    return Verdicts(
        np.array([row[0] for row in rows], dtype=np.int64),
        np.array([row[1] for row in rows], dtype=np.str_),
        np.array([row[2] for row in rows], dtype=bool),
        {number: np.array(sensors) for number, sensors in suspected.items()},
    )


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
        truth = truths[number]
        off = float(np.sqrt(np.mean((result.pattern - truth) ** 2) / np.mean(truth**2)))
        rows.append((number, off, result.trusted, sum_z < ON_COUNTS))
    return Judged(*map(np.array, zip(*rows, strict=True)))
