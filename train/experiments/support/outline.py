"""Outline of a map against that of the figure, and the naive average that a map is compared with."""

from collections.abc import Sequence
from typing import Final, NamedTuple, cast

import contourpy
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from edge.mapping.footprint import Grid, footprint
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses.pad_pose import PadPose

_STEP_MM: Final = 0.1
_INSIDE_MM: Final = 1.0
"""Distance from the end of what was covered within which the figure's outline is not asked for."""


class OutlineError(NamedTuple):
    """Distance between the outline of a map and that of the figure.

    Attributes:
        rms_mm: root of the mean square of both ways: from the map's outline to the figure's, and back.
        outside_mm: mean signed distance of the map's outline, positive outside the figure.
        covered: share of the figure's outline that the map covers.
    """

    rms_mm: float
    outside_mm: float
    covered: float


def outline_error(level: NDArray[np.floating], px_per_mm: float, figure: BaseGeometry) -> OutlineError:
    """Return the error of the line where a map (H, W) passes through .5; NaN where it covers nothing.

    A false island counts by its distance from the figure, and a part that is missing by that of its outline.
    """
    known = np.isfinite(level)
    places_mm = (np.arange(len(level)) - (len(level) - 1) / 2) / px_per_mm
    masked = np.ma.array(np.where(known, level, 0), mask=~known)
    lines = cast(list[NDArray[np.float64]], contourpy.contour_generator(places_mm, places_mm, masked).lines(0.5))
    drawn = shapely.MultiLineString([line for line in lines if len(line) > 1])
    edge = figure.boundary
    true_mm = _along(edge)
    row, col = (
        np.clip(np.rint(true_mm[:, axis] * px_per_mm + (len(level) - 1) / 2), 0, len(level) - 1) for axis in (1, 0)
    )
    asked = _eroded(known, round(_INSIDE_MM * px_per_mm))[row.astype(int), col.astype(int)]
    if drawn.is_empty or not asked.any():
        return OutlineError(float("inf"), 0.0, float(asked.mean()))
    points = shapely.points(_along(drawn))
    off_mm, missed_mm = shapely.distance(points, edge), shapely.distance(shapely.points(true_mm[asked]), drawn)
    outside_mm = off_mm * np.where(shapely.contains(figure, points), -1, 1)
    rms_mm = np.sqrt((np.mean(off_mm**2) + np.mean(missed_mm**2)) / 2)
    return OutlineError(float(rms_mm), float(outside_mm.mean()), float(asked.mean()))


def naive_map(
    patterns: Sequence[NDArray[np.float32] | None], poses: Sequence[PadPose], grid: Grid
) -> NDArray[np.float64]:
    """Return the plain mean of all patterns, each put at its pose, as a share whose .5 is half of the mean's top."""
    sums, counts = np.zeros(grid.pixels**2), np.zeros(grid.pixels**2)
    for pattern, pose in zip(patterns, poses, strict=True):
        if pattern is None:
            continue
        under = footprint(grid, pose, pattern.shape, USPA44.rows * USPA44.pitch_mm / len(pattern))
        if under is not None:
            sums[under.pixels] += under.read(pattern[..., None])[:, 0]
            counts[under.pixels] += 1
    mean = np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)
    top = np.nanmax(mean) if counts.any() else 1.0
    return (mean / top).reshape(grid.pixels, grid.pixels)


def _along(line: BaseGeometry) -> NDArray[np.float64]:
    """Return points (n, 2) every _STEP_MM along lines."""
    parts = [shapely.segmentize(part, _STEP_MM) for part in shapely.get_parts(line)]
    return np.concatenate([shapely.get_coordinates(part)[:-1] for part in parts])


def _eroded(mask: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """Return the pixels whose neighbourhood of `by` pixels each way is all set."""
    padded = np.pad(mask, by)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * by + 1, 2 * by + 1))
    return np.asarray(windows.all(axis=(2, 3)))
