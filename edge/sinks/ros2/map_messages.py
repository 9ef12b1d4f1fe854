"""Maps of results as ROS 2 messages: images, grids and clouds of points, and the maps in recorded messages. No I/O."""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.perception.patches import Patch
from edge.perception.result import Result
from edge.sinks.ros2.messages import GRID, IMAGE, POINT_CLOUD, header
from firmware_bridge.pad_geometry import SensorGeometry
from firmware_bridge.recording.cdr import stamp
from firmware_bridge.scans.scan import ABSENT, Scan

_POINT_FIELDS: Final = ("x", "y", "z", "fx", "fy", "fz", "sigma")
_CONTACT_FIELDS: Final = (
    *("x", "y", "z", "fx", "fy", "fz", "nx", "ny", "nz"),
    *("area", "length", "width", "long_axis"),
)
_FLOAT32: Final = 7  # number of float32 in sensor_msgs/PointField, and in foxglove_msgs/PackedElementField


class Unit(NamedTuple):
    """Unit of a map in messages, and the factor to it from the map's own."""

    name: str
    factor: float


UNITS: Final[Mapping[str, Unit]] = {
    "pattern": Unit("m", 1e-3),
    "deviation": Unit("m", 1e-3),
    "traction": Unit("Pa", 1e3),
}


def in_si(name: str, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the map of this name in its unit of UNITS."""
    return values * np.float32(UNITS[name].factor)


def image(values: NDArray[np.float32], frame: str, unix_ns: int) -> bytes:
    """Return a map (H, W), or one (3, H, W) of vectors as 3 H rows of x, y and z, as an Image of encoding 32FC1."""
    pixels = np.ascontiguousarray(values.reshape(-1, values.shape[-1]), dtype="<f4")
    height, width = pixels.shape
    return IMAGE.encode(
        {
            "header": header(frame, unix_ns),
            "height": height,
            "width": width,
            "encoding": "32FC1",
            "is_bigendian": 0,
            "step": 4 * width,
            "data": pixels.view(np.uint8),
        }
    )


def grid(name: str, values: NDArray[np.float32], frame: str, unix_ns: int, geometry: SensorGeometry) -> bytes:
    """Return a map (H, W), or (3, H, W) of vectors, as a Grid that lies on the pad's face, in its unit of UNITS."""
    layers = values.reshape(-1, *values.shape[-2:])
    count, height, width = layers.shape
    pitch_m = geometry.pixel_pitch_mm(height // geometry.rows) / 1e3
    corner = {"x": -width * pitch_m / 2, "y": -height * pitch_m / 2, "z": 0.0}
    names = (name,) if count == 1 else "xyz"
    return GRID.encode(
        {
            "timestamp": stamp(unix_ns),
            "frame_id": frame,
            "pose": {"position": corner, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}},
            "column_count": width,
            "cell_size": {"x": pitch_m, "y": pitch_m},
            "row_stride": 4 * count * width,
            "cell_stride": 4 * count,
            "fields": [{"name": field, "offset": 4 * at, "type": _FLOAT32} for at, field in enumerate(names)],
            "data": np.ascontiguousarray(in_si(name, layers).transpose(1, 2, 0), dtype="<f4").view(np.uint8),
        }
    )


def recorded_map(data: bytes) -> NDArray[np.float32]:
    """Return the map (H, W), or (3, H, W) of vectors, in a Grid; a CdrError or ValueError where it is none of ours."""
    message = GRID.decode(data)
    count, kinds = len(message["fields"]), {field["type"] for field in message["fields"]}
    if kinds != {_FLOAT32}:
        raise ValueError(f"a grid of numbers of type {sorted(kinds)}, expected {_FLOAT32}, float32")
    columns, strides = message["column_count"], (message["row_stride"], message["cell_stride"])
    offsets = [field["offset"] for field in message["fields"]]
    wanted = (4 * count * columns, 4 * count)
    if not columns or strides != wanted or offsets != [*range(0, 4 * count, 4)] or len(message["data"]) % wanted[0]:
        raise ValueError(f"a grid of {columns} columns, strides {strides}, fields at {offsets}: expected whole rows")
    layers = message["data"].view("<f4").reshape(-1, columns, count).transpose(2, 0, 1)
    return layers[0] if count == 1 else layers


def taxels(scan: Scan) -> NDArray[np.float32]:
    """Return the raw counts (3, rows, cols) of a scan, NaN where a taxel gave no reading."""
    counts = scan.counts.astype(np.float32)
    counts[scan.counts == ABSENT] = np.nan
    return counts


def points(result: Result, geometry: SensorGeometry, frame: str, unix_ns: int) -> bytes:
    """Return a pattern as a cloud of a point per pixel, in [m] and [N]; without a pattern, an empty cloud.

    What the model does not give is NaN; docs/ros2.md describes the fields, and those of contacts.
    """
    cloud = np.empty((0, 0, len(_POINT_FIELDS)), dtype="<f4")
    if result.pattern is not None:
        height, width = result.pattern.shape
        cloud = np.full((height, width, len(_POINT_FIELDS)), np.nan, dtype="<f4")
        cloud[..., :2] = _pixel_places_m(height, width, geometry)
        cloud[..., 2] = in_si("pattern", result.pattern)
        if result.traction is not None:
            cloud[..., 3:6] = _pixel_forces_n(result.traction, height, width, geometry)
        if result.deviation is not None:
            cloud[..., 6] = in_si("deviation", result.deviation)
    return _cloud(cloud, _POINT_FIELDS, frame, unix_ns)


def contacts(patches: Sequence[Patch], frame: str, unix_ns: int) -> bytes:
    """Return separate contacts as a cloud of a point each, in [m], [N] and [rad]; without one, an empty cloud."""
    rows = np.array(
        [
            [
                *(place / 1e3 for place in (*patch.centre_mm, 0.0)),
                *(patch.force_n or (math.nan,) * 3),
                *patch.normal,
                patch.area_mm2 / 1e6,
                *(size / 1e3 for size in patch.size_mm),
                math.radians(patch.long_axis_deg),
            ]
            for patch in patches
        ],
        dtype="<f4",
    )
    return _cloud(rows.reshape(1, -1, len(_CONTACT_FIELDS)), _CONTACT_FIELDS, frame, unix_ns)


def _cloud(cloud: NDArray[np.float32], fields: Sequence[str], frame: str, unix_ns: int) -> bytes:
    height, width, numbers = cloud.shape
    return POINT_CLOUD.encode(
        {
            "header": header(frame, unix_ns),
            "height": height,
            "width": width,
            "fields": [
                {"name": name, "offset": 4 * index, "datatype": _FLOAT32, "count": 1}
                for index, name in enumerate(fields)
            ],
            "is_bigendian": False,
            "point_step": 4 * numbers,
            "row_step": 4 * numbers * width,
            "data": cloud.view(np.uint8),
            "is_dense": bool(np.isfinite(cloud).all()),
        }
    )


@lru_cache(maxsize=8)
def _pixel_places_m(height: int, width: int, geometry: SensorGeometry) -> NDArray[np.float32]:
    """Return x and y of the pixels (H, W, 2) from the middle of the face, in [m]."""
    pitch_m = geometry.pixel_pitch_mm(height // geometry.rows) / 1e3
    y, x = np.indices((height, width), dtype=np.float32)
    return np.stack([x - (width - 1) / 2, y - (height - 1) / 2], axis=2) * np.float32(pitch_m)


def _pixel_forces_n(
    traction_kpa: NDArray[np.float32], height: int, width: int, geometry: SensorGeometry
) -> NDArray[np.float32]:
    """Return the force on each pixel (H, W, 3) of a traction (3, h, w) over the same face."""
    _, rows, cols = traction_kpa.shape
    pixel_m2 = (geometry.pixel_pitch_mm(height // geometry.rows) / 1e3) ** 2
    at_rows, at_cols = np.arange(height) * rows // height, np.arange(width) * cols // width
    forces = traction_kpa * np.float32(UNITS["traction"].factor * pixel_m2)
    return forces[:, at_rows][:, :, at_cols].transpose(1, 2, 0)
