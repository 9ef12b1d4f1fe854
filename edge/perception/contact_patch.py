"""The patch of a pattern that is in contact: its pixels, area and centroid."""

import numpy as np
from numpy.typing import NDArray


def touched(pattern: NDArray[np.floating], level: float) -> NDArray[np.bool_]:
    """Return the pixels that reach `level` of the pattern's maximum, (..., H, W) bool; none if that is not positive."""
    peak = pattern.max(axis=(-2, -1), keepdims=True)
    return (pattern >= level * peak) & (peak > 0)


def touched_patch(
    pattern: NDArray[np.float32], touching: NDArray[np.bool_], pixel_pitch_mm: float
) -> tuple[float, tuple[float, float] | None]:
    """Return area in [mm2] and pattern-weighted centroid of the touched pixels of a pattern (H, W), above zero there.

    The centroid is x, y in [mm] from the pattern's centre, x to the right and y down; None if no pixel is touched.
    """
    rows, cols = np.nonzero(touching)
    if rows.size == 0:
        return 0.0, None
    weights = pattern[rows, cols].astype(np.float64)
    weights /= weights.sum()
    height, width = pattern.shape
    x_mm = (float(weights @ cols) - (width - 1) / 2) * pixel_pitch_mm
    y_mm = (float(weights @ rows) - (height - 1) / 2) * pixel_pitch_mm
    return rows.size * pixel_pitch_mm**2, (x_mm, y_mm)
