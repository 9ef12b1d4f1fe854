"""Intervals of a pattern's pixels, the expected error of all of it, and the expected gain of another tap.

Deviations are calibrated so that `interval_factor` of them holds 90 % of the pixels in every region. Errors around a
contact have longer tails than those in it, so other levels have a factor of their own in each region. A pattern's doubt
is the RMS of its deviations over the RMS of the pattern itself; a table in the model's contract tells what it means.
"""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, Final, TypeGuard

import numpy as np
from numpy.typing import NDArray

REGIONS: Final = ("inside", "edge", "near", "far")  # the edge has pixels on both sides of the outline
NEAR_MM: Final = 2.0  # from the contact


def near_pixels(scale: int, pitch_mm: float) -> int:
    """Return how many pixels NEAR_MM are."""
    return max(round(NEAR_MM / pitch_mm * scale), 1)


def regions(patterns: NDArray[np.floating], contact_level: float, near: int) -> NDArray[np.int8]:
    """Return each pixel's region as an index of REGIONS, (n, H, W); `near` pixels from the contact are near it."""
    touched = patterns > np.float32(contact_level) * patterns.max(axis=(1, 2), keepdims=True)
    inside, edge = ~_grown(~touched, 1), _grown(touched, 1)
    return np.select([inside, edge, _grown(touched, near)], [0, 1, 2], 3).astype(np.int8)


def half_widths_mm(
    levels: dict[str, list[float]],
    percent: str,
    deviations: NDArray[np.floating],
    region: NDArray[np.integer],
) -> NDArray[np.floating]:
    """Return half widths (n, H, W) of the intervals of so many percent, a key of the contract's `interval_levels`."""
    return deviations * np.asarray(levels[percent], dtype=np.float32)[region]


def _grown(masks: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """Return masks (n, H, W) grown by so many pixels along both axes and all diagonals."""
    grown = masks
    for axis in (1, 2):
        wider = grown.copy()
        for step in range(1, by + 1):
            before, after = [slice(None)] * 3, [slice(None)] * 3
            before[axis], after[axis] = slice(step, None), slice(None, -step)
            wider[tuple(before)] |= grown[tuple(after)]
            wider[tuple(after)] |= grown[tuple(before)]
        grown = wider
    return grown


LARGEST: Final = float(np.finfo(np.float32).max)  # in a contract; a whole number can have more digits than any float
WORTH_A_TAP: Final = 0.02  # share of the error that another tap must be expected to take away to be worth it: 0.2 dB

# Number of taps -> doubt, error and gain, lists of one length, on taps not trained on: at that doubt, the RMS error as
# a share of the pattern's RMS, and the share of it that another tap takes away; no gain for the largest number of taps.
Table = Mapping[str, Mapping[str, list[float]]]


def doubt(pattern: NDArray[np.float32], deviation: NDArray[np.float32]) -> tuple[float, float]:
    """Return the doubt of a pattern (H, W), and its RMS in its unit; infinite and 0 for a pattern of zeros."""
    size = math.sqrt(float(np.vdot(pattern, pattern)) / pattern.size)
    spread = math.sqrt(float(np.vdot(deviation, deviation)) / deviation.size)
    return (spread / size, size) if size > 0 else (math.inf, 0.0)


def expect(table: Table, taps: int, about: float, size: float) -> tuple[float, bool | None] | None:
    """Return the expected RMS error of a pattern of so many taps, of a doubt and an RMS, and if another is worth it.

    Beyond the last doubt of the table the error grows with the doubt. None for a number of taps that the table has not,
    and for a pattern of zeros.
    """
    row = table.get(str(taps))
    if row is None or size == 0:
        return None
    levels = row["doubt"]
    error = float(np.interp(about, levels, row["error"])) * max(1.0, about / levels[-1])
    another = bool(np.interp(about, levels, row["gain"]) >= WORTH_A_TAP) if row["gain"] else None
    return error * size, another


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
