"""Depth images: depth of a surface under the pad below the point that the pad touches first, exact at each pixel."""

from math import cos, radians, sin
from typing import Final, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

NOTHING_MM: Final = 1e3  # depth where there is no surface at all: out of any press's reach
_UNFELT_MM: Final = 0.05  # height above the cells' centres from which a point between them is finer than a cell
_ROUNDING_PX: Final = 1e-9  # tolerance in [px], so that no pixel on the common edge of two triangles is missed


class Pose(NamedTuple):
    """Pose of a tap: its centre over the surface in [mm] and its turn about z in [deg]."""

    x_mm: float
    y_mm: float
    angle_deg: float


class Relief:
    """Surface to be drawn from above: a mesh in [mm], z up, and its name for error messages."""

    def __init__(self, name: str, mesh: trimesh.Trimesh) -> None:
        self.name = name
        self.triangles_mm = np.asarray(mesh.triangles, dtype=np.float64)
        self.low_mm = self.triangles_mm[:, :, :2].min(axis=1)
        self.high_mm = self.triangles_mm[:, :, :2].max(axis=1)


def depth_image(relief: Relief, pose: Pose, size: int, cell_mm: float) -> NDArray[np.float32]:
    """Return the depth (size, size) in [mm] of the part of a surface under a pad of `size` x `size` cells.

    Rows go down the pad from the top left; the sensor's y points down its rows, the surface's y up: the pad faces the
    surface. Off the surface the depth is NOTHING_MM. Depth counts from first contact, the highest point under the
    footprint, also between the cells' centres, on the triangles' edges. ValueError if nothing lies under the pad.
    """
    width_mm = size * cell_mm
    triangles = _under(relief, pose, width_mm)
    height_mm = _draw(triangles, size, cell_mm)
    top_mm = height_mm.max()
    if not np.isfinite(top_mm):
        raise ValueError(f"nothing of surface {relief.name!r} lies under the pad at {pose}; expected a pose over it")
    peak_mm = _highest(triangles, width_mm)
    if peak_mm - top_mm <= _UNFELT_MM:
        top_mm = max(peak_mm, top_mm)
    depth_mm = top_mm - height_mm
    return np.where(np.isfinite(depth_mm), depth_mm, NOTHING_MM).astype(np.float32)


def _under(relief: Relief, pose: Pose, width_mm: float) -> NDArray[np.float64]:
    """Return triangles (t, 3, 3) in the pad's axes, limited to those whose bounding box there meets the footprint."""
    place, reach_mm = np.array([pose.x_mm, pose.y_mm]), width_mm / np.sqrt(2)
    near = (relief.low_mm <= place + reach_mm) & (relief.high_mm >= place - reach_mm)
    triangles_mm = relief.triangles_mm[near.all(axis=1)]
    cosine, sine = cos(radians(pose.angle_deg)), sin(radians(pose.angle_deg))
    x_mm, y_mm = triangles_mm[:, :, 0] - pose.x_mm, triangles_mm[:, :, 1] - pose.y_mm
    turned = np.stack([cosine * x_mm + sine * y_mm, sine * x_mm - cosine * y_mm, triangles_mm[:, :, 2]], axis=2)
    flat = turned[:, :, :2]
    return turned[((flat.min(axis=1) <= width_mm / 2) & (flat.max(axis=1) >= -width_mm / 2)).all(axis=1)]


def _highest(triangles_mm: NDArray[np.float64], width_mm: float) -> float:
    """Return the highest point of the triangles' edges inside the footprint, in [mm]; -inf if there is none."""
    start = triangles_mm
    step = np.roll(triangles_mm, -1, axis=1) - start
    with np.errstate(divide="ignore", invalid="ignore"):
        at_low = (-width_mm / 2 - start[:, :, :2]) / step[:, :, :2]
        at_high = (width_mm / 2 - start[:, :, :2]) / step[:, :, :2]
    # fmin and fmax ignore 0/0, the case of an edge along a side of the footprint.
    enters = np.maximum(np.fmin(at_low, at_high).max(axis=2), 0)
    leaves = np.minimum(np.fmax(at_low, at_high).min(axis=2), 1)
    inside = enters <= leaves
    rise_mm = step[inside, 2]
    ends = start[inside, 2] + np.maximum(enters[inside] * rise_mm, leaves[inside] * rise_mm)
    return float(np.max(ends, initial=-np.inf))


def _draw(triangles_mm: NDArray[np.float64], size: int, cell_mm: float) -> NDArray[np.float64]:
    """Return the topmost triangle's height at each pixel's centre, (size, size) in [mm]; -inf without one."""
    height_mm = np.full((size, size), -np.inf)
    corners = triangles_mm.copy()
    corners[:, :, :2] = corners[:, :, :2] / cell_mm + (size - 1) / 2  # in pixels
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = edge1[:, 0] * edge2[:, 1] - edge2[:, 0] * edge1[:, 1]
    facing = np.abs(area) > 1e-12  # the others are seen edge-on
    corners, edge1, edge2, area = corners[facing], edge1[facing], edge2[facing], area[facing]
    slope_x = (edge1[:, 2] * edge2[:, 1] - edge2[:, 2] * edge1[:, 1]) / area
    slope_y = (edge2[:, 2] * edge1[:, 0] - edge1[:, 2] * edge2[:, 0]) / area
    bottom_mm, top_mm = corners[:, :, 2].min(axis=1), corners[:, :, 2].max(axis=1)

    triangle, row = _spans(corners[:, :, 1].min(axis=1), corners[:, :, 1].max(axis=1), size)
    left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for start, stop in ((0, 1), (1, 2), (2, 0)):
        x0, y0 = corners[triangle, start, 0], corners[triangle, start, 1]
        x1, y1 = corners[triangle, stop, 0], corners[triangle, stop, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (row - y0) / (y1 - y0)  # not finite on a level edge, whose ends belong to the other two edges
        crosses = (share >= -_ROUNDING_PX) & (share <= 1 + _ROUNDING_PX)
        x = x0 + np.clip(share, 0, 1) * (x1 - x0)
        left = np.where(crosses, np.minimum(left, x), left)
        right = np.where(crosses, np.maximum(right, x), right)
    strip, column = _spans(left, right, size)
    x0, y0, z0 = corners[triangle, 0].T
    z_mm = (z0 - slope_x[triangle] * x0 + slope_y[triangle] * (row - y0))[strip] + slope_x[triangle][strip] * column
    # The slope of a nearly vertical wall is too steep to be extrapolated beyond its corners.
    z_mm = np.clip(z_mm, bottom_mm[triangle][strip], top_mm[triangle][strip])
    np.maximum.at(height_mm.reshape(-1), (row * size)[strip] + column, z_mm)
    return height_mm


def _spans(
    low_px: NDArray[np.float64], high_px: NDArray[np.float64], size: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all integers between bounds (t,), both included, and from 0 to below size: (owner, number) of each."""
    first = np.ceil(np.clip(low_px - _ROUNDING_PX, 0, size)).astype(np.int64)
    last = np.floor(np.clip(high_px + _ROUNDING_PX, -1, size - 1)).astype(np.int64)
    counts = np.maximum(last - first + 1, 0)
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) + np.repeat(first - np.cumsum(counts) + counts, counts)
