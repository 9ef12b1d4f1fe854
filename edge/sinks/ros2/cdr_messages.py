"""Encoding of results and events as ROS 2 messages, of the usual types where one fits, else of our own. No I/O.

Lengths are in metres, as ROS has them. A value that is not available is NaN, or its message is not made.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, Final

import numpy as np
import orjson
from numpy.typing import NDArray

from edge.perception.event import Event, EventKind
from edge.perception.field import Columns, Out
from edge.perception.result import Result
from edge.perception.result_fields import FIELDS
from edge.sinks.ros2.ros_types import LOG, TF_MESSAGE, WRENCH_STAMPED, header
from firmware_bridge.pad_geometry import SensorGeometry
from firmware_bridge.recording.cdr import STD_HEADER, MessageType, stamp
from firmware_bridge.sensor_file.pad_frame import PadFrame

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
    known = result.scan.vendor_force_n is not None and result.scan.vendor_force_n[2] == result.force_n
    if not known or vendor is None or vendor.newtons is None or math.isnan(geometry.pitch_mm):
        return None
    newtons = vendor.newtons.reshape(3, -1).T.astype(np.float64)
    moments = np.cross(_taxel_places_m(geometry), newtons)
    (fx, fy, fz), (tx, ty, tz) = newtons.sum(axis=0).tolist(), moments.sum(axis=0).tolist()
    return (fx, fy, fz), (tx, ty, tz)


def wrench(result: Result, geometry: SensorGeometry, unix_ns: int) -> bytes | None:
    """Return force on the pad and torque as a message; None where a part of them is not available."""
    known = force_and_torque(result, geometry)
    return None if known is None else wrench_message(*known, frame_of(result), unix_ns)


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
                "translation": dict(zip("xyz", (one / 1e3 for one in pad.place_mm), strict=True)),
                "rotation": dict(zip("xyzw", pad.quaternion, strict=True)),
            },
        }
        for child, pad in frames.items()
    ]
    return TF_MESSAGE.encode({"transforms": made})


def result_message(result: Result, record: Mapping[str, Any], unix_ns: int) -> bytes:
    """Return a result without its maps as a message; `record` is its record from edge.sinks.json_encoding."""
    values = dict(zip(_NAMES, _COLUMNS.flat(result), strict=True))
    values["header"] = header(frame_of(result), unix_ns)
    values["record"] = orjson.dumps(record, option=orjson.OPT_SERIALIZE_NUMPY).decode()
    return RESULT.encode(values)


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


@lru_cache(maxsize=8)
def _taxel_places_m(geometry: SensorGeometry) -> NDArray[np.float64]:
    """Return the centres of the taxels (taxels, 3) on the face, in [m]."""
    return np.pad(geometry.taxel_centres_mm() / 1e3, ((0, 0), (0, 1)))
