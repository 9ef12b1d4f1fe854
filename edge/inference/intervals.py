"""Intervals of a pattern's pixels: regions of a pattern, and half widths at several levels.

Deviations are calibrated so that `interval_factor` of them holds 90 % of the pixels in every region. Errors around a
contact have longer tails than those in it, so other levels have a factor of their own in each region.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

REGIONS: Final = ("inside", "edge", "near", "far")
"""Regions of a pattern: inside the contact, the pixels on both sides of its outline, up to NEAR_MM outside, the
rest."""
NEAR_MM: Final = 2.0
LARGEST_FACTOR: Final = 1e6


def near_pixels(scale: int, pitch_mm: float) -> int:
    """Return how many pixels NEAR_MM are."""
    return max(round(NEAR_MM / pitch_mm * scale), 1)


def regions(patterns: NDArray[np.floating], contact_level: float, near: int) -> NDArray[np.int8]:
    """Return each pixel's region as an index of REGIONS, (n, H, W), of patterns (n, H, W).

    A pixel from `contact_level` of its pattern's maximum is touched; `near` pixels from the contact are near it.
    """
    touched = patterns > np.float32(contact_level) * patterns.max(axis=(1, 2), keepdims=True)
    inside, edge = ~_grown(~touched, 1), _grown(touched, 1)
    return np.select([inside, edge, _grown(touched, near)], [0, 1, 2], 3).astype(np.int8)


def half_widths_mm(
    levels: dict[str, list[float]],
    percent: str,
    deviations: NDArray[np.floating],
    region: NDArray[np.integer],
) -> NDArray[np.floating]:
    """Return half widths (n, H, W) in [mm] of the intervals that hold so many percent of the pixels in each region.

    `levels` are the contract's `interval_levels`, of which `percent` is a key; deviations are (n, H, W) in [mm].
    """
    return deviations * np.asarray(levels[percent], dtype=np.float32)[region]


def is_interval_levels(value: Any) -> bool:
    """Return whether a value read from a file maps percentages to a factor for each region; it may be empty."""
    return isinstance(value, dict) and all(_is_percent(key) and _is_factors(row) for key, row in value.items())


def _is_percent(key: str) -> bool:
    try:
        return 0 < float(key) < 100
    except ValueError:
        return False


def _is_factors(row: Any) -> bool:
    if not isinstance(row, list) or len(row) != len(REGIONS):
        return False
    return all(type(one) in (int, float) and 0 < one <= LARGEST_FACTOR for one in row)


def _grown(masks: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """Return masks (n, H, W) grown by so many pixels along both axes and all diagonals."""
    grown = masks
    for axis in (1, 2):
        one = grown.copy()
        for step in range(1, by + 1):
            before, after = [slice(None)] * 3, [slice(None)] * 3
            before[axis], after[axis] = slice(step, None), slice(None, -step)
            one[tuple(before)] |= grown[tuple(after)]
            one[tuple(after)] |= grown[tuple(before)]
        grown = one
    return grown
