"""Evidence of one pattern about the object under it: its pixels of the map, what was touched, how high, how surely."""

from math import cos, radians, sin
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.poses import PadPose

SIZE_MM: Final = 60.0
PX_PER_MM: Final = 4.0
MOST_PX: Final = 2000  # most pixels along a map's side: its layers take 100 MB


class Grid(NamedTuple):
    """Pixels along a map's side, pixels per [mm], and the place of its centre in the object's plane, in [mm]."""

    pixels: int
    px_per_mm: float
    centre_mm: tuple[float, float]


class Footprint(NamedTuple):
    """Pixels (n,) of a map under a pad, row-major, and the row and column of each in the pattern, with fractions."""

    pixels: NDArray[np.intp]
    rows: NDArray[np.floating]
    cols: NDArray[np.floating]

    def read(self, layers: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return values (n, k) between the pixels of a pattern's layers (H, W, k); beyond the outermost, theirs."""
        height, width, depth = layers.shape
        rows, cols = np.clip(self.rows, 0, height - 1), np.clip(self.cols, 0, width - 1)
        row = np.minimum(rows.astype(np.intp), height - 2)
        col = np.minimum(cols.astype(np.intp), width - 2)
        down, right = (rows - row).astype(np.float32)[:, None], (cols - col).astype(np.float32)[:, None]
        flat, corner = layers.reshape(-1, depth), row * width + col
        upper = _between(flat, corner, right)
        lower = _between(flat, corner + width, right)
        lower -= upper
        lower *= down
        lower += upper
        return lower


def _between(flat: NDArray[np.float32], left: NDArray[np.intp], share: NDArray[np.float32]) -> NDArray[np.float32]:
    here = flat.take(left, axis=0)
    there = flat.take(left + 1, axis=0)
    there -= here
    there *= share
    there += here
    return there


def footprint(grid: Grid, pose: PadPose, shape: tuple[int, ...], pixel_mm: float) -> Footprint | None:
    """Return the pixels of a map under a pad whose patterns are (H, W), `pixel_mm` apart; None if there are none."""
    height, width = shape
    cosine, sine = cos(radians(pose.turn_deg)), sin(radians(pose.turn_deg))
    # Only the map's rows and columns that the pad reaches are looked at, however large the map is.
    along = _reached(grid, pose.x_mm - grid.centre_mm[0], (abs(cosine) * width + abs(sine) * height) * pixel_mm / 2)
    down = _reached(grid, pose.y_mm - grid.centre_mm[1], (abs(sine) * width + abs(cosine) * height) * pixel_mm / 2)
    if along is None or down is None:
        return None
    (first_col, x_mm), (first_row, y_mm) = along, down
    x_px, y_px = x_mm / np.float32(pixel_mm), y_mm / np.float32(pixel_mm)
    cols = np.float32(cosine) * x_px[None, :] + np.float32(sine) * y_px[:, None]
    rows = np.float32(cosine) * y_px[:, None] - np.float32(sine) * x_px[None, :]
    inside = np.flatnonzero((np.abs(cols) <= width / 2) & (np.abs(rows) <= height / 2))
    if not len(inside):
        return None
    row, col = np.divmod(inside, len(x_mm))
    return Footprint(
        (row + first_row) * grid.pixels + (col + first_col),
        rows.ravel()[inside] + np.float32((height - 1) / 2),
        cols.ravel()[inside] + np.float32((width - 1) / 2),
    )


def _reached(grid: Grid, centre_mm: float, reach_mm: float) -> tuple[int, NDArray[np.float32]] | None:
    """Return the first of the map's lines within reach, and the distance of each from a centre, in [mm]."""
    at = centre_mm * grid.px_per_mm + (grid.pixels - 1) / 2
    reach = reach_mm * grid.px_per_mm
    if not -reach <= at <= grid.pixels + reach:  # before it is made an integer: a pose may be a kilometre away
        return None
    first, last = max(0, int(np.ceil(at - reach))), min(grid.pixels - 1, int(np.floor(at + reach)))
    if first > last:
        return None
    return first, ((np.arange(first, last + 1) - at) / grid.px_per_mm).astype(np.float32)


CONTACT_LEVEL: Final = 0.5
"""Share of a pattern's top from which a pixel counts as touched: where a blurred edge of a flat part truly lies."""


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
    top_mm = float(np.partition(pattern, -8, axis=None)[-8:].mean())
    if not top_mm >= 0.05:  # [mm]; it may be all drift: a free pad that has warmed by a few kelvin makes 0.02 mm
        return None
    variance = np.full_like(pattern, 0.05**2) if deviation is None else deviation * deviation
    variance += _moved(pattern, pose, pixel_mm)
    variance += np.float32(0.02**2)  # however sure a model is of a pixel
    spread = np.sqrt(variance + np.float32((0.15 * top_mm) ** 2))  # an edge is blurred even in a sure pattern
    # 1.702: log odds of a normal distribution per standard deviation, within 0.01 in probability.
    odds = (pattern - np.float32(level * top_mm)) * np.float32(1.702)
    odds /= spread
    np.clip(odds, -4, 4, out=odds)  # one pattern in fifty is wrong there however sure it is
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
