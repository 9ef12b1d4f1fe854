"""Encoding of results, maps and events as ROS 2 messages, of the usual types where one fits, else of our own. No I/O.

Lengths are in metres, as ROS has them. A value that is not available is NaN, or its message is not made.
"""

import math
import re
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import orjson

from edge.errors import UsageError
from edge.perception.event import Event, EventKind
from edge.perception.record_fields import FIELDS, Columns, Out
from edge.perception.result import Result
from firmware_bridge.pad_geometry import SensorGeometry
from firmware_bridge.recording.cdr import STD_HEADER, TIME, MessageType, stamp
from firmware_bridge.sensor_file.model import PadFrame

_TYPE_FIELDS: Final = {
    "sensor_msgs/Image": "std_msgs/Header header, uint32 height, uint32 width, string encoding, uint8 is_bigendian, "
    "uint32 step, uint8[] data",
    "geometry_msgs/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force, geometry_msgs/Vector3 torque",
    "geometry_msgs/WrenchStamped": "std_msgs/Header header, geometry_msgs/Wrench wrench",
    "rcl_interfaces/Log": "builtin_interfaces/Time stamp, uint8 level, string name, string msg, string file, "
    "string function, uint32 line",
    "std_msgs/String": "string data",
    "std_msgs/Float64": "float64 data",
    "std_msgs/Int8": "int8 data",
    "sensor_msgs/PointField": "string name, uint32 offset, uint8 datatype, uint32 count",
    "sensor_msgs/PointCloud2": "std_msgs/Header header, uint32 height, uint32 width, sensor_msgs/PointField[] fields, "
    "bool is_bigendian, uint32 point_step, uint32 row_step, uint8[] data, bool is_dense",
    "geometry_msgs/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/PointStamped": "std_msgs/Header header, geometry_msgs/Point point",
    "geometry_msgs/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position, geometry_msgs/Quaternion orientation",
    "foxglove_msgs/Vector2": "float64 x, float64 y",
    "foxglove_msgs/PackedElementField": "string name, uint32 offset, uint8 type",
    "foxglove_msgs/Grid": "builtin_interfaces/Time timestamp, string frame_id, geometry_msgs/Pose pose, "
    "uint32 column_count, foxglove_msgs/Vector2 cell_size, uint32 row_stride, uint32 cell_stride, "
    "foxglove_msgs/PackedElementField[] fields, uint8[] data",
    "geometry_msgs/PoseStamped": "std_msgs/Header header, geometry_msgs/Pose pose",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose, float64[36] covariance",
    "geometry_msgs/PoseWithCovarianceStamped": "std_msgs/Header header, geometry_msgs/PoseWithCovariance pose",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation, geometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": "std_msgs/Header header, string child_frame_id, "
    "geometry_msgs/Transform transform",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "diagnostic_msgs/KeyValue": "string key, string value",
    "diagnostic_msgs/DiagnosticStatus": "byte level, string name, string message, string hardware_id, "
    "diagnostic_msgs/KeyValue[] values",
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header, diagnostic_msgs/DiagnosticStatus[] status",
}
"""Fields of each type, each after the types in it."""


def _types() -> dict[str, MessageType]:
    types = {"builtin_interfaces/Time": TIME, "std_msgs/Header": STD_HEADER}
    for name, fields in _TYPE_FIELDS.items():
        lines = fields.split(", ")
        kinds = [line.partition(" ")[0].removesuffix("[]") for line in lines]
        parts = [types[kind] for kind in kinds if kind in types]
        types[name] = MessageType(name.replace("/", "/msg/"), "\n".join(lines), *parts)
    return types


TYPES: Final = _types()
IMAGE: Final = TYPES["sensor_msgs/Image"]
GRID: Final = TYPES["foxglove_msgs/Grid"]
WRENCH_STAMPED: Final = TYPES["geometry_msgs/WrenchStamped"]
LOG: Final = TYPES["rcl_interfaces/Log"]
STRING: Final = TYPES["std_msgs/String"]
POINT_CLOUD: Final = TYPES["sensor_msgs/PointCloud2"]
POINT_STAMPED: Final = TYPES["geometry_msgs/PointStamped"]
TF_MESSAGE: Final = TYPES["tf2_msgs/TFMessage"]
DIAGNOSTIC_ARRAY: Final = TYPES["diagnostic_msgs/DiagnosticArray"]


def header(frame: str, unix_ns: int) -> dict[str, Any]:
    """Return the fields of a std_msgs/Header."""
    return {"stamp": stamp(unix_ns), "frame_id": frame}


_FIELDS: Final = tuple(field for field in FIELDS if Out.ROS in field.out)
_NAMES: Final = tuple(name for field in _FIELDS for name in field.names)
_COLUMNS: Final = Columns(field.in_message() for field in _FIELDS)
_MEMBERS: Final = "\n".join(f"{field.kind.message} {name}" for field in _FIELDS for name in field.names)
RESULT: Final = MessageType(
    "tactile_edge_sr/msg/Result",
    f"""\
# What was made of one scan, without its maps. Not known: NaN of numbers, -1 of contact.
std_msgs/Header header     # wall clock time of the scan; frame_id as of its maps
{_MEMBERS}
string record              # all of it as JSON, as in a line of jsonl:
""",
    STD_HEADER,
)
Vector = tuple[float, float, float]
_WARN, _ERROR = 30, 40
_LEVELS: Final[Mapping[EventKind, int]] = {
    **dict.fromkeys(("lost", "sink"), _ERROR),
    **dict.fromkeys(("silent", "trouble", "refused", "in_contact", "given_up", "rest_level"), _WARN),
    **dict.fromkeys(("baseline_doubted", "poses_silent", "poses_trouble"), _WARN),
}


def frame_of(result: Result) -> str:
    """Return the frame_id of a sensor: its name, after the kind of source where it is no device, as in emulated/4."""
    return result.scan.sensor if result.source == "device" else f"{result.source}/{result.scan.sensor}"


def force_and_torque(result: Result, geometry: SensorGeometry) -> tuple[Vector, Vector] | None:
    """Return force on the pad in [N] and torque about its middle in [N m]; x to the right, y down, z into the pad.

    A model with traction gives them, and so does the vendor's server, whose newtons act at the taxels. None where any
    of it is not available: our own calibration is of z alone.
    """
    if result.wrench is not None:
        x, y, z = result.wrench.torque_n_mm
        return result.wrench.force_n, (x / 1e3, y / 1e3, z / 1e3)
    vendor = result.scan.vendor
    is_vendors = result.scan.vendor_force_n is not None and result.scan.vendor_force_n[2] == result.force_n
    if not is_vendors or vendor is None or vendor.newtons is None or math.isnan(geometry.pitch_mm):
        return None
    newtons = vendor.newtons.reshape(3, -1).T.astype(np.float64)
    places_m = np.pad(geometry.taxel_centres_mm() / 1e3, ((0, 0), (0, 1)))  # on the face
    moments = np.cross(places_m, newtons)
    (fx, fy, fz), (tx, ty, tz) = newtons.sum(axis=0).tolist(), moments.sum(axis=0).tolist()
    return (fx, fy, fz), (tx, ty, tz)


def wrench(result: Result, geometry: SensorGeometry, unix_ns: int) -> bytes | None:
    """Return force on the pad and torque as a message; None where a part of them is not available."""
    force_torque = force_and_torque(result, geometry)
    return None if force_torque is None else wrench_message(*force_torque, frame_of(result), unix_ns)


def wrench_message(force_n: Vector, torque_n_m: Vector, frame: str, unix_ns: int) -> bytes:
    """Return a force in [N] and a torque in [N m] as a message."""
    force, torque = (dict(zip("xyz", vector, strict=True)) for vector in (force_n, torque_n_m))
    return WRENCH_STAMPED.encode({"header": header(frame, unix_ns), "wrench": {"force": force, "torque": torque}})


def transforms(frames: Mapping[str, PadFrame], unix_ns: int) -> bytes:
    """Return where pads are on the robot as a message; by their frame_id."""
    made = [
        {
            "header": header(pad.parent, unix_ns),
            "child_frame_id": child,
            "transform": {
                "translation": dict(zip("xyz", (place / 1e3 for place in pad.place_mm), strict=True)),
                "rotation": dict(zip("xyzw", pad.quaternion, strict=True)),
            },
        }
        for child, pad in frames.items()
    ]
    return TF_MESSAGE.encode({"transforms": made})


def result_message(result: Result, record: Mapping[str, Any], unix_ns: int) -> bytes:
    """Return a result without its maps as a message; `record` is its record from edge.sinks.json_records."""
    values = dict(zip(_NAMES, _COLUMNS.flat(result), strict=True))
    values["header"] = header(frame_of(result), unix_ns)
    values["record"] = orjson.dumps(record, option=orjson.OPT_SERIALIZE_NUMPY).decode()
    return RESULT.encode(values)


def log_message(event: Event, unix_ns: int) -> bytes:
    """Return an event as a line of ROS's log: `function` is its kind, `name` its sensor or "edge-sr"."""
    return LOG.encode(
        {
            "stamp": stamp(unix_ns),
            "level": _LEVELS.get(event.kind, 20),
            "name": event.sensor or "edge-sr",
            "msg": event.text,
            "file": "",
            "function": event.kind,
            "line": 0,
        }
    )


def base_topic(text: str) -> str:
    """Return a topic as a user writes it without its leading slash, or raise a UsageError."""
    topic = text.removeprefix("/")
    if not all(re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", token) for token in topic.split("/")):
        raise UsageError(
            f"topic {text!r} is not a ROS topic: expected letters, digits and _ between single slashes, no digit "
            "first, such as ros2:skin or ros2:/gripper/skin"
        )
    return topic


def sensor_path(sensor: str) -> str:
    """Return the part of a topic that stands for a sensor; no two sensors share one.

    "4" becomes s4, "left/4" left/s4; a name that is not valid in ROS, or could be taken for another, becomes x_ and its
    UTF-8 in hexadecimal digits.
    """
    return "/".join(map(_token, sensor.split("/")))


def _token(part: str) -> str:
    if re.fullmatch(r"(?!s[0-9])(?!x_)[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*", part):
        return part
    if re.fullmatch(r"[0-9][A-Za-z0-9]*(_[A-Za-z0-9]+)*", part):
        return f"s{part}"
    return f"x_{part.encode().hex() or '0'}"
