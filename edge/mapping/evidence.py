"""Evidence of one pattern about the object under it: what was touched, how high it is, and how sure each pixel is."""

from math import radians
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.poses.pad_pose import PadPose

CONTACT_LEVEL: Final = 0.5
"""Share of a pattern's top from which a pixel counts as touched: where a blurred edge of a flat part truly lies."""
FLOOR_MM: Final = 0.02
"""Standard deviation of a pixel below which no model is taken at its word, in [mm]."""
UNKNOWN_MM: Final = 0.05
"""Standard deviation of a pixel where the model gives none, in [mm]."""
BLUR: Final = 0.15
"""Standard deviation of a pattern's share of its top by which an edge is blurred, even in a sure pattern."""
MOST_ODDS: Final = 4.0
"""Largest log odds of one pattern's pixel: one pattern in fifty is wrong there however sure it is."""
LEAST_TOP_MM: Final = 0.05
"""Top below which a pattern may be all drift: a free pad that has warmed by a few kelvin makes .02 mm, in [mm]."""
_TOP_PIXELS: Final = 8
_LOGISTIC: Final = 1.702
"""Log odds of a normal distribution per standard deviation, within .01 in probability."""


class Evidence(NamedTuple):
    """Evidence of one pattern, in the pad's axes, and the height of its top above what it does not touch, in [mm].

    Layers are (H, W, 4): weight of what was covered, log odds of a touch, information about the height in [1/mm^2], and
    that information times the pattern.
    """

    layers: NDArray[np.float32]
    top_mm: float


def weigh(
    pattern: NDArray[np.float32], deviation: NDArray[np.float32] | None, pose: PadPose, pixel_mm: float, level: float
) -> Evidence | None:
    """Return the evidence of a pattern, None if it is flat: touched is where its share of the top exceeds `level`."""
    height, width = pattern.shape
    top_mm = float(np.partition(pattern, -_TOP_PIXELS, axis=None)[-_TOP_PIXELS:].mean())
    if not top_mm >= LEAST_TOP_MM:
        return None
    variance = np.full_like(pattern, UNKNOWN_MM**2) if deviation is None else deviation * deviation
    variance += _moved(pattern, pose, pixel_mm)
    variance += np.float32(FLOOR_MM**2)
    spread = np.sqrt(variance + np.float32((BLUR * top_mm) ** 2))
    odds = (pattern - np.float32(level * top_mm)) * np.float32(_LOGISTIC)
    odds /= spread
    np.clip(odds, -MOST_ODDS, MOST_ODDS, out=odds)
    layers = np.empty((height, width, 4), dtype=np.float32)
    layers[..., 0] = 1
    layers[..., 1] = odds
    np.divide(odds > 0, variance, out=layers[..., 2])
    np.multiply(layers[..., 2], pattern, out=layers[..., 3])
    return Evidence(layers, top_mm)


def _moved(pattern: NDArray[np.float32], pose: PadPose, pixel_mm: float) -> NDArray[np.float32]:
    """Return the variance of each pixel that follows from the pose's error: it matters where the pattern is steep."""
    slope = np.zeros_like(pattern)
    across = (pattern[:, 2:] - pattern[:, :-2]) / np.float32(2 * pixel_mm)
    down = (pattern[2:] - pattern[:-2]) / np.float32(2 * pixel_mm)
    slope[:, 1:-1] += across * across
    slope[1:-1] += down * down
    height, width = pattern.shape
    x2 = ((np.arange(width, dtype=np.float32) - (width - 1) / 2) * pixel_mm) ** 2
    y2 = ((np.arange(height, dtype=np.float32) - (height - 1) / 2) * pixel_mm) ** 2
    turned = np.float32(radians(pose.error_deg) ** 2 / 2)
    return slope * (np.float32(pose.error_mm**2) + turned * (x2[None, :] + y2[:, None]))
