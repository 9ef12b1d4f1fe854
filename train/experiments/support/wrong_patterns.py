"""Verdicts of the runtime on contacts, beside how far each pattern is off, and the rows of tables that they make."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.expected_error import doubt
from edge.perception.contact_options import OFF_COUNTS, ON_COUNTS, RuntimeOptions
from edge.perception.pattern_check import most_doubt
from edge.perception.runtime import Model
from firmware_bridge.scans.pad_constants import Pad
from train.data.frozen_presses import FrozenPresses
from train.experiments.support.contact_verdicts import share
from train.experiments.support.pushed import PushedSensor
from train.report import Row

RIGHT, WRONG, FAR_OFF = 0.3, 0.5, 1.0
"""RMS error of a pattern over the RMS of the truth: below the first it is right, above the others wrong and far off."""
_LIGHT: Final = RuntimeOptions(follow_drift=False, contact_on_counts=OFF_COUNTS)


@dataclass(frozen=True, slots=True)
class Judged:
    """Contacts of n sensors, one each, which the runtime checked.

    Attributes:
        index: (n,) places among the presses.
        off: (n,) RMS error of the pattern over the RMS of the truth.
        believed: (n,).
        reason: (n,) why not.
        doubt: (n,) the model's own expectation of `off`, over its limit.
        light: (n,) summed z between the counts that end a contact and those that begin one.
    """

    index: NDArray[np.int64]
    off: NDArray[np.float64]
    believed: NDArray[np.bool_]
    reason: NDArray[np.str_]
    doubt: NDArray[np.float64]
    light: NDArray[np.bool_]

    def cells(self, here: NDArray[np.bool_]) -> Row:
        """Return the shares of those `here` (n,) that are not believed as cells of a row."""
        row: Row = {"contacts": int(here.sum())}
        kinds = {
            f"of those < {RIGHT:.0%} off, not believed %": self.off < RIGHT,
            f"> {WRONG:.0%} off": self.off > WRONG,
            f"> {FAR_OFF:.0%} off": self.off > FAR_OFF,
        }
        for name, kind in kinds.items():
            found = ~self.believed[here & kind]
            if not name.endswith("%"):
                row[name] = len(found)
                name = f"{name}, not believed %"
            row[name] = share(found) if len(found) else None
        return row

    def limit(self, here: NDArray[np.bool_], false_alarms: float) -> float:
        """Return the factor on the limit of doubt at which a share of the right ones `here` is not believed."""
        others = ~self.believed & (self.reason != "uncertain")
        return float(np.quantile(np.where(others, np.inf, self.doubt)[here & (self.off < RIGHT)], 1 - false_alarms))


def judged(model: Model, presses: FrozenPresses, pads: Sequence[Pad | None]) -> Judged:
    """Return the verdicts on the newest taps of presses, each of a sensor of its own, with what its file holds."""
    truths = presses.patterns()
    rows: list[tuple[int, float, bool, str, float, bool]] = []
    for number, (counts, pad) in enumerate(zip(presses.presses.counts[:, 0], pads, strict=True)):
        sum_z = float(counts[2].sum())
        if sum_z < OFF_COUNTS:
            continue
        result = PushedSensor(model, pad, seed=number, options=_LIGHT).touch(counts)
        if result.pattern is None or result.deviation is None or result.trusted is None:
            continue
        truth = truths[number]
        off = float(np.sqrt(np.mean((result.pattern - truth) ** 2) / np.mean(truth**2)))
        over = doubt(result.pattern, result.deviation)[0] / most_doubt(float(counts[2].max()))
        rows.append((number, off, result.trusted, result.untrusted_reason or "", over, sum_z < ON_COUNTS))
    return Judged(*map(np.array, zip(*rows, strict=True)))
