"""Message of a pose in recordings. No I/O."""

from typing import Final

from firmware_bridge.errors import CdrError
from firmware_bridge.poses.pad_pose import PadPose
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.recording.cdr import STD_HEADER, MessageType, stamp
from firmware_bridge.recording.pose_columns import POSE_FIELDS
from firmware_bridge.scans.scan import is_sensor_name
from firmware_bridge.schedule import LAST_TIME_NS

POSE_NAME: Final = "tactile_edge_sr/msg/PadPose"
POSE: Final = MessageType(
    POSE_NAME,
    """\
# Pose of a pad in the plane of the object that it touches: x to the right, y down, a turn from x to y.
std_msgs/Header header          # wall clock time of time_ns
string sensor                   # empty for every sensor without poses of its own
int64 time_ns                   # monotonic
int64 used_from_ns              # monotonic time of the first scan that was made with it at hand
float64 x_mm
float64 y_mm
float64 turn_deg
float64 error_mm                # standard deviation of the place, along x and along y
float64 error_deg               # standard deviation of the turn
uint8 holds                     # 1: the pad rests there until the next pose
""",
    STD_HEADER,
)


def encode_pose(timed: TimedPose, unix_ns: int) -> bytes:
    """Encode a pose whose time is `unix_ns` [ns] since 1970."""
    return POSE.encode(
        {
            "header": {"stamp": stamp(unix_ns), "frame_id": timed.sensor or ""},
            "sensor": timed.sensor or "",
            "time_ns": timed.time_ns,
            "used_from_ns": -1 if timed.used_from_ns is None else timed.used_from_ns,
            **{name: getattr(timed.pose, name) for name in POSE_FIELDS},
            "holds": int(timed.holds),
        }
    )


def decode_pose(data: bytes | memoryview) -> TimedPose:
    """Decode the pose in a message.

    Raises:
        CdrError: it is no pose, or a value is impossible.
    """
    fields = POSE.decode(data)
    sensor, used_from_ns = fields["sensor"], fields["used_from_ns"]
    if sensor and not is_sensor_name(sensor):
        raise CdrError(f"sensor: {sensor[:20]!r}, expected a name, or none")
    for name, least in (("time_ns", 0), ("used_from_ns", -1)):
        if not least <= fields[name] <= LAST_TIME_NS:
            raise CdrError(f"{name}: {fields[name]}, expected {least}..{LAST_TIME_NS}")
    if fields["holds"] > 1:
        raise CdrError(f"holds: {fields['holds']}, expected 0 or 1")
    try:
        pose = PadPose(*(fields[name] for name in POSE_FIELDS))
    except ValueError as error:
        raise CdrError(str(error)) from error
    return TimedPose(
        pose, fields["time_ns"], sensor or None, bool(fields["holds"]), None if used_from_ns < 0 else used_from_ns
    )
