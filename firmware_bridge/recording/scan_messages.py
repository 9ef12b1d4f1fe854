"""Messages of scans, baselines, poses and sensors: all that is needed to play a recording again, bit for bit.

Decoders raise a CdrError for bytes that are no such message, and for a value that is impossible.
"""

from dataclasses import asdict
from dataclasses import fields as dataclass_fields
from functools import lru_cache
from typing import Any, Final, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import AXES, USPA44, SensorGeometry
from firmware_bridge.poses import POSE_FIELDS, TimedPose
from firmware_bridge.recording.cdr import STD_HEADER, MessageType, stamp
from firmware_bridge.recording.tracks import check, check_times, checked_pose
from firmware_bridge.scans.scan import ABSENT, HIGHEST_COUNT, Scan, VendorReading, is_sensor_name
from firmware_bridge.scans.xela_server_messages import HIGHEST_NEWTONS, HIGHEST_UPS_HZ, KELVIN
from firmware_bridge.schedule import NS_PER_S
from firmware_bridge.zeroing.baseline import LAST_UNIX_S, Baseline, Origin

SCAN_NAME: Final = "tactile_edge_sr/msg/Scan"
BASELINE_NAME: Final = "tactile_edge_sr/msg/Baseline"
# The reader takes a definition by its text, so not even a comment in it may change: earlier recordings have it.
_SCAN_TEXT: Final = """\
# One reading of all taxels of one sensor, raw.
std_msgs/Header header          # wall clock time of time_ns; frame_id is the sensor
string sensor
int64 number                    # of this sensor's scans, from 0
int64 time_ns                   # monotonic, when its newest reading arrived
int64 device_time_ns            # the same by the device's own time stamps; -1 without
uint64 fresh                    # bit i: taxel i, row-major from the top left, gave a reading
uint64 renewed                  # bit i: fresh, and another reading than before
int32[{counts}] counts                # [axis x, y, z][row][column]; -1 where not fresh
float32[] vendor_newtons        # the same, by the vendor's software; empty where it tells none
float32[] vendor_temperature_k  # [row][column], empty where it tells none
float32[] vendor_ups_hz         # [row][column], empty where it tells none
"""
_BASELINE_TEXT: Final = """\
# What is subtracted from a sensor's scans from the next one on, drift and all.
std_msgs/Header header
string sensor
string id                       # of the baseline as it was taken
string origin                   # start-up, demand, or file
float64 created_unix_s          # when it was taken, since 1970
int32 scans                     # that it is the median of
float64 age_s                   # NaN where a clock was wrong
float32[{counts}] counts              # [axis x, y, z][row][column]; NaN where a taxel was not zeroed
"""
_SENSOR_TEXT: Final = """\
# What the scans of a sensor mean, repeated, since tools copy messages alone, or those from some time on.
std_msgs/Header header
string sensor
string facts                    # JSON: by name, what the file's metadata records hold as well, and units
"""
_POSE_TEXT: Final = """\
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
"""


@lru_cache
def scan_type(taxel_count: int) -> MessageType:
    """Return the message of a scan of so many taxels."""
    return MessageType(SCAN_NAME, _SCAN_TEXT.format(counts=len(AXES) * taxel_count), STD_HEADER)


@lru_cache
def baseline_type(taxel_count: int) -> MessageType:
    """Return the message of a baseline of so many taxels."""
    return MessageType(BASELINE_NAME, _BASELINE_TEXT.format(counts=len(AXES) * taxel_count), STD_HEADER)


SENSOR: Final = MessageType("tactile_edge_sr/msg/Sensor", _SENSOR_TEXT, STD_HEADER)
POSE: Final = MessageType("tactile_edge_sr/msg/PadPose", _POSE_TEXT, STD_HEADER)


class RecordedScan(NamedTuple):
    """Content of a scan message, checked; numbers as in `scan_type`."""

    frame: str
    sensor: str
    number: int
    time_ns: int
    device_time_ns: int
    fresh: int
    renewed: int
    counts: NDArray[np.int32]
    vendor: VendorReading | None


def encode_scan(scan: Scan, frame: str, unix_ns: int, fresh: int, renewed: int) -> bytes:
    """Encode a scan that was on the bus at `unix_ns` [ns] since 1970; `fresh` and `renewed` are its masks as numbers.

    `frame` is that of the results' messages, so that raw scans are marked, too, where their source is no device.
    """
    vendor = ((field.name, getattr(scan.vendor, field.name, None)) for field in dataclass_fields(VendorReading))
    return scan_type(scan.fresh.size).encode(
        {
            "header": _header(frame, unix_ns),
            "sensor": scan.sensor,
            "number": scan.number,
            "time_ns": scan.time_ns,
            "device_time_ns": -1 if scan.device_ns is None else scan.device_ns,
            "fresh": fresh,
            "renewed": renewed,
            "counts": scan.counts,
            **{f"vendor_{name}": () if array is None else array for name, array in vendor},
        }
    )


def decode_scan(data: bytes, geometry: SensorGeometry = USPA44) -> RecordedScan:
    """Decode the scan in a message."""
    fields = scan_type(geometry.taxel_count).decode(data)
    sensor, fresh, renewed = fields["sensor"], fields["fresh"], fields["renewed"]
    check(is_sensor_name(sensor), "sensor", sensor, "a name")
    check_times(fields, number=0, time_ns=0, device_time_ns=-1)
    right = fresh < 1 << geometry.taxel_count and renewed & ~fresh == 0
    check(right, "fresh and renewed", (fresh, renewed), "renewed taxels that are")
    counts = fields["counts"].reshape(geometry.scan_shape)
    _check_range("counts", counts, ABSENT, HIGHEST_COUNT)
    taxels = np.unpackbits(np.frombuffer(fresh.to_bytes(8, "little"), np.uint8), bitorder="little")
    absent = ~taxels[: geometry.taxel_count].astype(bool).reshape(geometry.rows, geometry.cols)
    right = bool(((counts == ABSENT) == absent).all())
    check(right, "counts", "readings", "one on each axis of a fresh taxel, none of others")
    vendor: dict[str, NDArray[np.float32]] = {}
    for name, shape, low, high in (
        ("newtons", geometry.scan_shape, -HIGHEST_NEWTONS, HIGHEST_NEWTONS),
        ("temperature_k", absent.shape, *KELVIN),
        ("ups_hz", absent.shape, 0, HIGHEST_UPS_HZ),
    ):
        array = fields[f"vendor_{name}"]
        # NaN is a taxel without a thermometer.
        _check_range(f"vendor_{name}", array, low, high, or_none=name == "temperature_k")
        if array.size:
            right = array.size == int(np.prod(shape))
            check(right, f"vendor_{name}", f"{array.size} numbers", f"none, or {int(np.prod(shape))}")
            vendor[name] = array.reshape(shape).copy()  # a view would keep the whole chunk of a file in memory
    return RecordedScan(
        *(fields["header"]["frame_id"], sensor, fields["number"], fields["time_ns"], fields["device_time_ns"]),
        *(fresh, renewed, counts, VendorReading(**vendor) if vendor else None),
    )


def encode_baseline(baseline: Baseline, frame: str, age_s: float | None, unix_ns: int) -> bytes:
    """Encode a baseline that is used from `unix_ns` on, in [ns] since 1970."""
    return baseline_type(baseline.counts[0].size).encode(
        {
            "header": _header(frame, unix_ns),
            "sensor": baseline.sensor,
            "id": baseline.id,
            "origin": baseline.origin,
            # Without a valid date (the clock of a recording may begin later) the age dates it.
            "created_unix_s": baseline.created_unix_s if baseline.created_unix_s > 0 else np.nan,
            "scans": baseline.scans,
            "age_s": np.nan if age_s is None else age_s,
            "counts": baseline.counts,
        }
    )


def decode_baseline(data: bytes, geometry: SensorGeometry = USPA44) -> Baseline:
    """Decode the baseline in a message, with the origin that it had in the recorded run."""
    fields = baseline_type(geometry.taxel_count).decode(data)
    sensor, created_unix_s, scans = fields["sensor"], fields["created_unix_s"], fields["scans"]
    check(is_sensor_name(sensor), "sensor", sensor, "a name")
    check(is_sensor_name(fields["id"]), "id", fields["id"], "a short text")
    if np.isnan(created_unix_s):
        age_s, at = fields["age_s"], fields["header"]["stamp"]
        check(np.isnan(age_s) or 0 <= age_s <= LAST_UNIX_S, "age_s", age_s, f"0..{LAST_UNIX_S:g} seconds, or none")
        created_unix_s = at["sec"] + at["nanosec"] / NS_PER_S - age_s
    else:
        check(0 < created_unix_s <= LAST_UNIX_S, "created_unix_s", created_unix_s, "seconds since 1970, or none")
    check(scans >= 1, "scans", scans, "a whole number from 1")
    counts = np.array(fields["counts"].reshape(geometry.scan_shape))
    _check_range("counts", counts, 0, HIGHEST_COUNT + 1, or_none=True)
    counts.setflags(write=False)
    origin: Origin = fields["origin"] if fields["origin"] in get_args(Origin) else "file"
    return Baseline(sensor, counts, created_unix_s, scans, origin, fields["id"])


def encode_pose(timed: TimedPose, unix_ns: int) -> bytes:
    """Encode a pose whose time is `unix_ns` [ns] since 1970."""
    return POSE.encode(
        {
            "header": _header(timed.sensor or "", unix_ns),
            "sensor": timed.sensor or "",
            "time_ns": timed.time_ns,
            "used_from_ns": -1 if timed.used_from_ns is None else timed.used_from_ns,
            **asdict(timed.pose),
            "holds": int(timed.holds),
        }
    )


def decode_pose(data: bytes) -> TimedPose:
    """Decode the pose in a message."""
    fields = POSE.decode(data)
    numbers = [fields[name] for name in POSE_FIELDS]
    return checked_pose(numbers, *(fields[name] for name in ("time_ns", "holds", "used_from_ns", "sensor")))


def _header(frame: str, unix_ns: int) -> dict[str, Any]:
    return {"stamp": stamp(unix_ns), "frame_id": frame}


def _check_range(name: str, array: NDArray[Any], low: float, high: float, *, or_none: bool = False) -> None:
    inside = (array >= low) & (array <= high)
    right = (inside | np.isnan(array)) if or_none else inside
    got = "others" if right.all() else f"{array[~right][0]:g}"
    check(bool(right.all()), name, got, f"{low:g}..{high:g}" + ", or none" * or_none)
