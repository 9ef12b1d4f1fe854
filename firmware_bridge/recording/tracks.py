"""Recordings in memory: tracks of scans, one per sensor; and what all formats have in common."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.errors import CdrError, RecordingError
from firmware_bridge.pad_geometry import SensorGeometry, pad_of
from firmware_bridge.poses import PadPose, TimedPose
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import ABSENT, VendorReading, is_sensor_name
from firmware_bridge.schedule import LAST_TIME_NS, NS_PER_S

if TYPE_CHECKING:
    from firmware_bridge.zeroing.baseline import Baseline

MOST_SENSORS: Final = 64  # most sensors of a recording; one wire can have sixteen
MOST_POSES: Final = 1 << 23  # most poses of a recording: those of a day at 100 Hz, in 3 GB
RATES_HZ: Final = (1e-3, 1e5)  # lowest and highest rate, in [Hz]: beyond them periods in [ns] overflow, or become 0
A_RATE: Final = f"a positive number, {RATES_HZ[0]:g} to {RATES_HZ[1]:g}"


@dataclass(frozen=True, slots=True)
class Track:
    """Scans of one sensor in a recording; what was not recorded is None."""

    sensor: str
    counts: NDArray[np.int32]  # (n, 3, rows, cols), ABSENT where a taxel gave no reading
    time_ns: NDArray[np.int64] | None  # (n,), monotonic, never falling
    numbers: NDArray[np.int64] | None = None  # (n,)
    device_time_ns: NDArray[np.int64] | None = None  # (n,) on the clock of `time_ns`; -1 where the device had none
    renewed: NDArray[np.bool_] | None = None  # (n, rows, cols), True where a reading was new
    vendor: tuple[VendorReading | None, ...] | None = None  # (n,)
    pad: SensorGeometry | None = None

    @property
    def geometry(self) -> SensorGeometry:
        """Pad of the sensor, by its grid where the file does not name it."""
        return self.pad or pad_of(*self.counts.shape[2:])

    @property
    def mean_rate_hz(self) -> float | None:
        """Mean rate by the recorded times, in [Hz]; None without times."""
        if self.time_ns is None or self.time_ns[-1] <= self.time_ns[0]:
            return None
        return (len(self.time_ns) - 1) * NS_PER_S / float(self.time_ns[-1] - self.time_ns[0])


@dataclass(frozen=True, slots=True)
class Recording:
    """Tracks of one file, at least one, each with at least one scan; what the file does not state is None."""

    path: Path
    tracks: tuple[Track, ...]  # one per sensor, in the order in which they first occur
    rate_hz: float | None  # of each sensor's scans
    baselines: "Mapping[str, Baseline]" = field(default_factory=dict)  # at the first scan of each sensor that has one
    mountings: Mapping[str, Mounting] = field(default_factory=dict)  # taxels are in place, axes are still to be turned
    unix_offset_ns: int | None = None  # from `time_ns` to [ns] since 1970
    notes: tuple[str, ...] = ()
    origin: Literal["device", "emulated"] | None = None  # however often its scans were played and recorded again
    poses: Sequence[TimedPose] = ()  # in the order in which they were taken
    poses_by_row: bool = False  # times of the poses are rows of the scans, which have no times themselves
    pauses: NDArray[np.float64] | None = None  # (n,) periods without a scan before each scan, of scans without times


def origin_of(kinds: Iterable[str | None]) -> Literal["device", "emulated"] | None:
    """Return the origin of scans of these kinds of sources together, None if it is uncertain."""
    kinds = set(kinds)
    if "emulated" in kinds:
        return "emulated"
    return "device" if kinds == {"device"} else None


def is_rate(rate_hz: float) -> bool:
    """Return True if scans can come at this rate in [Hz]."""
    return RATES_HZ[0] <= rate_hz <= RATES_HZ[1]


def checked_pose(numbers: Sequence[float], time_ns: int, holds: int, used_from_ns: int, sensor: str) -> TimedPose:
    """Return the pose of these POSE_FIELDS, and of the other fields of a pose's message, as recordings hold them."""
    check(not sensor or is_sensor_name(sensor), "sensor", sensor, "a name, or none")
    check_times({"time_ns": time_ns, "used_from_ns": used_from_ns}, time_ns=0, used_from_ns=-1)
    check(holds <= 1, "holds", holds, "0 or 1")
    try:
        pose = PadPose(*numbers)
    except ValueError as error:
        raise CdrError(str(error)) from error
    return TimedPose(pose, time_ns, sensor or None, bool(holds), None if used_from_ns < 0 else used_from_ns)


def mounting_text(mounting: Mounting) -> str:
    """Return a mounting as JSON, without its number of taxels, which the scans show."""
    fields = asdict(mounting)
    del fields["taxel_count"]
    return json.dumps(fields)


def read_mounting(text: str, taxel_count: int) -> Mounting:
    """Return the mounting in a text of `mounting_text`; a ValueError where it is none, or none of so many taxels."""
    try:
        fields = json.loads(text)
        order, signs = tuple(fields["order"]), tuple(fields["signs"])
        if not all(type(value) is int for value in (*order, *signs)) or type(fields["swap_xy"]) is not bool:
            raise ValueError("not whole numbers")
        if any(gain != 1 for gain in fields.get("gains", ())):
            raise ValueError("it has gains, which this release does not apply: play it with the one that recorded it")
        return Mounting(order, fields["swap_xy"], signs, taxel_count)
    except (TypeError, KeyError, RecursionError, OverflowError) as error:
        raise ValueError(" ".join(str(error).split())[:120] or type(error).__name__) from error


def check_raw(name: object, counts: NDArray[Any]) -> None:
    """Raise a RecordingError where counts (n, 3, rows, cols) are absent on some axes, or over a baseline, cut off at 0.

    Raw ones are far from 0; those of a broken chip are 0 on all its axes. Of eight grips that were cut off, a reading
    in two was 0 on one axis and not on another, and their patterns look right. A taxel is taken for one that gave a
    reading where x is there.
    """
    absent = counts == ABSENT
    if (absent.any(axis=1) != absent.all(axis=1)).any():
        raise RecordingError(f"{name}: a taxel absent on some axes, expected all of a taxel's axes absent or none")
    zero = counts == 0
    share = float((zero.any(axis=1) & ~zero.all(axis=1)).mean())
    if share > 0.2:  # three taxels of sixteen
        raise RecordingError(
            f"{name}: {100 * share:.0f} % of the readings are 0 on one axis and not on another, as readings over a "
            "baseline that were cut off at 0: expected raw counts, nothing subtracted"
        )


def check_times(fields: Mapping[str, Any], **least: int) -> None:
    """Check that numbers and times of a recording are in range; `least` has the lowest valid one of each by name."""
    for name, low in least.items():
        check(low <= fields[name] <= LAST_TIME_NS, name, fields[name], f"{low}..{LAST_TIME_NS}")


def check(right: bool, name: str, got: object, expected: str) -> None:
    """Raise a CdrError unless a value of a recording, called `name`, is `right`."""
    if not right:
        raise CdrError(f"{name}: {str(got)[:60]!r}, expected {expected}")
