"""Encoding of results and events as ROS 2 messages, of the usual types where one fits, else of our own. No I/O.

The texts of sensor_msgs, geometry_msgs, diagnostic_msgs, std_msgs, builtin_interfaces and rcl_interfaces are those of
ROS 2's interface definitions (Apache-2.0), without their comments. A value that is not available is NaN, never made up.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
import orjson
from numpy.typing import NDArray

from edge.perception.event import Event, EventKind
from edge.perception.field import Columns, Out
from edge.perception.result import Result
from edge.perception.result_fields import FIELDS
from edge.sinks.ros2.diagnostics import Diagnosis
from firmware_bridge.recording.cdr import STD_HEADER, TIME, MessageType, stamp

IMAGE: Final = MessageType(
    "sensor_msgs/msg/Image",
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
    "uint8[] data",
    STD_HEADER,
)
VECTOR3: Final = MessageType("geometry_msgs/msg/Vector3", "float64 x\nfloat64 y\nfloat64 z")
_WRENCH: Final = MessageType(
    "geometry_msgs/msg/Wrench", "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque", VECTOR3
)
WRENCH_STAMPED: Final = MessageType(
    "geometry_msgs/msg/WrenchStamped",
    "std_msgs/Header header\ngeometry_msgs/Wrench wrench",
    *(STD_HEADER, _WRENCH, VECTOR3),
)
LOG: Final = MessageType(
    "rcl_interfaces/msg/Log",
    "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line",
    TIME,
)
STRING: Final = MessageType("std_msgs/msg/String", "string data")
_KEY_VALUE: Final = MessageType("diagnostic_msgs/msg/KeyValue", "string key\nstring value")
_DIAGNOSTIC_STATUS: Final = MessageType(
    "diagnostic_msgs/msg/DiagnosticStatus",
    "byte level\nstring name\nstring message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values",
    _KEY_VALUE,
)
DIAGNOSTIC_ARRAY: Final = MessageType(
    "diagnostic_msgs/msg/DiagnosticArray",
    "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status",
    *(STD_HEADER, _DIAGNOSTIC_STATUS),
)
_FIELDS: Final = tuple(field for field in FIELDS if Out.ROS in field.out)
_NAMES: Final = tuple(name for field in _FIELDS for name in field.names)
_COLUMNS: Final = Columns(field.in_message() for field in _FIELDS)
_MEMBERS: Final = "\n".join(f"{field.kind.message} {name}" for field in _FIELDS for name in field.names)
RESULT: Final = MessageType(
    "tactile_edge_sr/msg/Result",
    f"""\
# What was made of one scan, without its maps. Not known: NaN of numbers, -1 of contact.
std_msgs/Header header     # wall clock time of the scan; frame_id as of images
{_MEMBERS}
string record              # all of it as JSON, as in a line of jsonl:
""",
    STD_HEADER,
)
Vector = tuple[float, float, float]
_WARN, _ERROR, _INFO = 30, 40, 20
_LEVELS: Final[Mapping[EventKind, int]] = {
    **dict.fromkeys(("lost", "sink"), _ERROR),
    **dict.fromkeys(("silent", "trouble", "refused", "in_contact", "given_up", "rest_level"), _WARN),
    **dict.fromkeys(("poses_silent", "poses_trouble"), _WARN),
}


def frame_of(result: Result) -> str:
    """Return the frame_id of a sensor: its name, after the kind of source where it is no device, as in emulated/4."""
    return result.scan.sensor if result.source == "device" else f"{result.source}/{result.scan.sensor}"


def force_and_torque(result: Result) -> tuple[Vector, Vector] | None:
    """Return force on the pad in [N] and torque about its middle in [N m]; x to the right, y down, z into the pad.

    Force and torque are complete where the model gives traction. Else torques are NaN, and so are x and y of the force,
    because our own calibration is of z alone; the vendor's force has all three. None where there are only counts.
    """
    if result.wrench is not None:
        x, y, z = result.wrench.torque_n_mm
        return result.wrench.force_n, (x / 1e3, y / 1e3, z / 1e3)
    if result.force_n is None:
        return None
    vendor = result.scan.vendor_force_n
    force_n = vendor if vendor is not None and vendor[2] == result.force_n else (math.nan, math.nan, result.force_n)
    return force_n, (math.nan, math.nan, math.nan)


def image(values: NDArray[np.float32], frame: str, unix_ns: int) -> bytes:
    """Return a map (H, W) as an Image of encoding 32FC1, in the map's unit, x to the right and y down.

    A map (3, H, W) of vectors becomes one of 32FC3, with x, y, z of a pixel side by side.
    """
    pixels = np.ascontiguousarray(values if values.ndim == 2 else values.transpose(1, 2, 0), dtype="<f4")
    height, width = pixels.shape[:2]
    return IMAGE.encode(
        {
            "header": _header(frame, unix_ns),
            "height": height,
            "width": width,
            "encoding": "32FC1" if values.ndim == 2 else "32FC3",
            "is_bigendian": 0,
            "step": pixels[0].nbytes,
            "data": pixels.view(np.uint8),
        }
    )


def image_map(data: bytes) -> NDArray[np.float32]:
    """Return the map (H, W), or (3, H, W), in an Image that `image` made.

    Raises:
        CdrError: it is not an Image.
        ValueError: the Image is of another encoding or byte order.
    """
    image = IMAGE.decode(data)
    if image["encoding"] not in ("32FC1", "32FC3") or image["is_bigendian"]:
        raise ValueError(f"an image of encoding {image['encoding'][:20]!r}, expected 32FC1 or 32FC3, little-endian")
    pixels = image["data"].view("<f4")
    if image["encoding"] == "32FC1":
        return pixels.reshape(image["height"], image["width"])
    return pixels.reshape(image["height"], image["width"], 3).transpose(2, 0, 1)


def wrench(result: Result, unix_ns: int) -> bytes | None:
    """Return force on the pad and torque as a message; None where the force is not available in [N]."""
    known = force_and_torque(result)
    if known is None:
        return None
    return wrench_message(*known, frame_of(result), unix_ns)


def wrench_message(force_n: Vector, torque_n_m: Vector, frame: str, unix_ns: int) -> bytes:
    """Return a force in [N] and a torque in [N m] as a message."""
    force, torque = (dict(zip("xyz", vector, strict=True)) for vector in (force_n, torque_n_m))
    return WRENCH_STAMPED.encode({"header": _header(frame, unix_ns), "wrench": {"force": force, "torque": torque}})


def result_message(result: Result, record: Mapping[str, Any], unix_ns: int) -> bytes:
    """Return a result without its maps as a message; `record` is its record from edge.sinks.json_encoding."""
    values = dict(zip(_NAMES, _COLUMNS.flat(result), strict=True))
    values["header"] = _header(frame_of(result), unix_ns)
    values["record"] = orjson.dumps(record, option=orjson.OPT_SERIALIZE_NUMPY).decode()
    return RESULT.encode(values)


def diagnostics_message(statuses: Iterable[tuple[str, str, Diagnosis]], unix_ns: int) -> bytes:
    """Return the states of sensors, each with its name and its sensor, as a message."""
    status = [
        {
            "level": said.level,
            "name": name,
            "message": said.text,
            "hardware_id": sensor,
            "values": [{"key": key, "value": value} for key, value in said.values.items()],
        }
        for name, sensor, said in statuses
    ]
    return DIAGNOSTIC_ARRAY.encode({"header": _header("", unix_ns), "status": status})


def log_message(event: Event, unix_ns: int) -> bytes:
    """Return an event as a line of ROS's log: `function` is its kind, `name` its sensor or "edge-sr"."""
    return LOG.encode(
        {
            "stamp": stamp(unix_ns),
            "level": _LEVELS.get(event.kind, _INFO),
            "name": event.sensor or "edge-sr",
            "msg": event.text,
            "file": "",
            "function": event.kind,
            "line": 0,
        }
    )


def _header(frame: str, unix_ns: int) -> dict[str, Any]:
    return {"stamp": stamp(unix_ns), "frame_id": frame}
