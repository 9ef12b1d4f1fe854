"""Depth images: how far below its highest point a surface lies under the sensor's footprint."""

from dataclasses import dataclass
from math import cos, radians, sin
from typing import Final

import numpy as np
import trimesh
from numpy.typing import NDArray

MAP_CELL_MM: Final = 0.1
NOTHING_MM: Final = 1e3
"""Depth where there is no surface at all: out of any press's reach."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the sensor taps: its centre over the surface in [mm] and its turn about z in [deg]."""

    x_mm: float
    y_mm: float
    angle_deg: float


@dataclass(frozen=True, slots=True)
class DepthMap:
    """A surface seen from above.

    Attributes:
        depth_mm: (n, m) below the highest point, in [mm]; row = y, column = x; NOTHING_MM off the surface.
        left_mm: x of the first column's centre.
        bottom_mm: y of the first row's centre.
    """

    depth_mm: NDArray[np.float32]
    left_mm: float
    bottom_mm: float


def depth_map(mesh: trimesh.Trimesh, cell_mm: float = MAP_CELL_MM) -> DepthMap:
    """Look down on a mesh once, so that every pose is a look-up."""
    triangles = np.asarray(mesh.triangles, dtype=np.float64)
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    width, height = (np.ceil((high[:2] - low[:2]) / cell_mm)).astype(int)
    top_mm = np.full((height, width), -np.inf)
    for corners in triangles:
        _raise_to(top_mm, corners, low, cell_mm)
    depth_mm = np.where(np.isfinite(top_mm), high[2] - top_mm, NOTHING_MM).astype(np.float32)
    return DepthMap(depth_mm, float(low[0] + cell_mm / 2), float(low[1] + cell_mm / 2))


def _raise_to(top_mm: NDArray[np.float64], corners: NDArray[np.float64], low: NDArray[np.float64], cell: float) -> None:
    """Z-buffer one triangle (3, 3) into the map, over its own bounding box only."""
    (x0, y0, z0), (x1, y1, z1), (x2, y2, z2) = corners
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    if abs(area) < 1e-12:  # seen edge-on
        return
    first = np.maximum(np.floor((corners[:, :2].min(axis=0) - low[:2]) / cell).astype(int), 0)
    last = np.minimum(np.ceil((corners[:, :2].max(axis=0) - low[:2]) / cell).astype(int), top_mm.shape[::-1])
    x = low[0] + (np.arange(first[0], last[0]) + 0.5) * cell
    y = low[1] + (np.arange(first[1], last[1])[:, None] + 0.5) * cell
    share1 = ((x - x0) * (y2 - y0) - (x2 - x0) * (y - y0)) / area
    share2 = ((x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)) / area
    inside = (share1 >= 0) & (share2 >= 0) & (share1 + share2 <= 1)
    z = z0 + share1 * (z1 - z0) + share2 * (z2 - z0)
    box = top_mm[first[1] : last[1], first[0] : last[0]]
    np.maximum(box, np.where(inside, z, -np.inf), out=box)


def depth_image(surface: DepthMap, pose: Pose, size: int, cell_mm: float) -> NDArray[np.float32]:
    """Depth under the footprint, (size, size) in [mm], row-major from the top left, in the sensor's axes.

    The sensor's y points down its rows, the surface's y up: the pad faces the surface.
    """
    along_mm = (np.arange(size) - (size - 1) / 2) * cell_mm
    right_mm, down_mm = along_mm[None, :], along_mm[:, None]
    cosine, sine = cos(radians(pose.angle_deg)), sin(radians(pose.angle_deg))
    x_mm = pose.x_mm + cosine * right_mm + sine * down_mm
    y_mm = pose.y_mm + sine * right_mm - cosine * down_mm
    column = np.rint((x_mm - surface.left_mm) / MAP_CELL_MM).astype(int)
    row = np.rint((y_mm - surface.bottom_mm) / MAP_CELL_MM).astype(int)
    height, width = surface.depth_mm.shape
    on_map = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return np.where(on_map, surface.depth_mm[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)], NOTHING_MM)
