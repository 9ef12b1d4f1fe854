"""Poses of a recording in columns, checked: objects would take ten times the memory."""

from array import array
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.poses.pad_pose import MOST_DEG, MOST_MM, PadPose
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.scans.scan import is_sensor_name
from firmware_bridge.schedule import LAST_TIME_NS

POSE_FIELDS: Final = ("x_mm", "y_mm", "turn_deg", "error_mm", "error_deg")
_LIMITS: Final = ((-MOST_MM, MOST_MM), (-MOST_MM, MOST_MM), (-MOST_DEG, MOST_DEG), (0.0, MOST_MM), (0.0, MOST_DEG))


@dataclass(frozen=True, slots=True)
class PoseColumns:
    """Poses in the order in which they were taken.

    Attributes:
        time_ns: (n,) int64 monotonic times, in [ns]; where the file has no times, the rows of scans.
        values: (n, 5) float64, as in POSE_FIELDS.
        sensors: names of sensors, empty for all of them.
        sensor: (n,) index of the sensor of each pose.
        holds: (n,) bool, the pad rests there until the next pose.
        used_from_ns: (n,) int64 time of the first scan that was made with the pose at hand, in [ns]; -1 if unknown.
        by_row: each pose belongs to a row of scans, in place of a time.

    Raises:
        ValueError: a value is impossible; the message names the column.
    """

    time_ns: NDArray[np.int64]
    values: NDArray[np.float64]
    sensors: tuple[str, ...]
    sensor: NDArray[np.int32]
    holds: NDArray[np.bool_]
    used_from_ns: NDArray[np.int64]
    by_row: bool = False

    def __post_init__(self) -> None:
        for name, column, (low, high) in zip(POSE_FIELDS, self.values.T, _LIMITS, strict=True):
            inside = (column >= low) & (column <= high)  # False of NaN
            if not inside.all():
                raise ValueError(f"{name} is {column[~inside][0]}, expected {low:g}..{high:g}")
        for name, times, low in (("time_ns", self.time_ns, 0), ("used_from_ns", self.used_from_ns, -1)):
            inside = (times >= low) & (times <= LAST_TIME_NS)
            if not inside.all():
                raise ValueError(f"{name} is {times[~inside][0]}, expected {low}..{LAST_TIME_NS}")
        for name in self.sensors:
            if name and not is_sensor_name(name):
                raise ValueError(f"sensor is {name[:20]!r}, expected the name of a sensor, or none")

    def __len__(self) -> int:
        return len(self.time_ns)

    def at(self, row: int, later_ns: int) -> TimedPose:
        """Return one pose, later by `later_ns` [ns] than it was recorded."""
        used_from_ns = int(self.used_from_ns[row])
        return TimedPose(
            PadPose(*self.values[row].tolist()),
            int(self.time_ns[row]) + later_ns,
            self.sensors[int(self.sensor[row])] or None,
            bool(self.holds[row]),
            used_from_ns + later_ns if used_from_ns >= 0 else None,
        )


class PoseRows:
    """Poses that are added one by one, in arrays."""

    def __init__(self) -> None:
        self._times_ns = array("q")
        self._used_from_ns = array("q")
        self._values = array("d")
        self._sensor = array("i")
        self._holds = bytearray()
        self._sensors: dict[str, int] = {}

    @property
    def sensors(self) -> int:
        """Number of sensors that have poses, all of them counted as one more."""
        return len(self._sensors)

    def add(self, timed: TimedPose) -> None:
        """Add a pose."""
        self._times_ns.append(timed.time_ns)
        self._used_from_ns.append(-1 if timed.used_from_ns is None else timed.used_from_ns)
        self._values.extend(getattr(timed.pose, name) for name in POSE_FIELDS)
        self._sensor.append(self._sensors.setdefault(timed.sensor or "", len(self._sensors)))
        self._holds.append(timed.holds)

    def columns(self, *, by_row: bool = False) -> PoseColumns | None:
        """Return the poses, whose times are rows of scans if `by_row`; None without any."""
        if not self._times_ns:
            return None
        return PoseColumns(
            np.frombuffer(self._times_ns, np.int64),
            np.frombuffer(self._values, np.float64).reshape(-1, len(POSE_FIELDS)),
            tuple(self._sensors),
            np.frombuffer(self._sensor, np.int32),
            np.frombuffer(self._holds, np.bool_),
            np.frombuffer(self._used_from_ns, np.int64),
            by_row,
        )
