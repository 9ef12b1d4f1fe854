"""Expected error of a pattern, and the expected gain of another tap.

A pattern's doubt is the RMS of its deviations over the RMS of the pattern itself, one number. A table in the model's
contract gives its meaning on taps not trained on, by the number of taps in the window: the error that patterns of that
doubt had, and the share of it that one more tap took away.
"""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, Final, NamedTuple, TypeGuard

import numpy as np
from numpy.typing import NDArray

LARGEST: Final = float(np.finfo(np.float32).max)
"""Largest number in a contract: patterns are float32. A whole number can have more digits than any float."""
WORTH_A_TAP: Final = 0.02
"""Share of the error that another tap must be expected to take away to be worth it: .2 dB."""

Table = Mapping[str, Mapping[str, list[float]]]
"""Number of taps -> doubt, error and gain, lists of one length: at that doubt, the RMS error as a share of the
pattern's RMS, and the share of the error that another tap takes away; no gain for the largest number of taps."""


class Expected(NamedTuple):
    """Expected error of a pattern.

    Attributes:
        rmse: RMS error over all its pixels, in its unit.
        gain: share of it that another tap would take away; None if the network takes no further tap.
    """

    rmse: float
    gain: float | None

    @property
    def another_tap(self) -> bool | None:
        """True if another tap is expected to be worth it; None if the network takes no further tap."""
        return None if self.gain is None else self.gain >= WORTH_A_TAP


def doubt(pattern: NDArray[np.float32], deviation: NDArray[np.float32]) -> tuple[float, float]:
    """Return the doubt of a pattern (H, W), and its RMS in its unit; infinite and 0 for a pattern of zeros."""
    size = math.sqrt(float(np.vdot(pattern, pattern)) / pattern.size)
    spread = math.sqrt(float(np.vdot(deviation, deviation)) / deviation.size)
    return (spread / size, size) if size > 0 else (math.inf, 0.0)


def expect(table: Table, taps: int, pattern: NDArray[np.float32], deviation: NDArray[np.float32]) -> Expected | None:
    """Return the expected error of a pattern (H, W) made from so many taps; None if the table has none.

    Between two doubts it is interpolated; beyond the last the error grows with the doubt. A pattern of zeros has none.
    """
    about, size = doubt(pattern, deviation)
    row = table.get(str(taps))
    if row is None or size == 0:
        return None
    levels = row["doubt"]
    error = float(np.interp(about, levels, row["error"])) * max(1.0, about / levels[-1])
    gain = float(np.interp(about, levels, row["gain"])) if row["gain"] else None
    return Expected(error * size, gain)


def is_confidence(value: Any, taps: int) -> bool:
    """Return whether a value read from a file is such a table for a model of so many taps, or empty."""
    if not isinstance(value, dict):
        return False
    return all(key in map(str, range(1, taps + 1)) and _is_row(row) for key, row in value.items())


def _is_row(row: Any) -> bool:
    if not isinstance(row, dict) or set(row) != {"doubt", "error", "gain"}:
        return False
    if not all(isinstance(values, list) and all(is_number(v) for v in values) for values in row.values()):
        return False
    levels, count = row["doubt"], len(row["doubt"])
    rising = count > 0 and levels[0] > 0 and all(a < b for a, b in pairwise(levels))
    return rising and len(row["error"]) == count and len(row["gain"]) in (0, count)


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value read from a file is a finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= LARGEST
