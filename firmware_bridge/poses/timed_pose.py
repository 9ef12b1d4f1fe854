"""A pose of a pad as it came, with its time and its sensor."""

from dataclasses import dataclass, replace

from firmware_bridge.poses.pad_pose import PadPose


@dataclass(frozen=True, slots=True)
class TimedPose:
    """A pose with its time.

    Attributes:
        pose: pose of the pad in the object's plane.
        time_ns: monotonic time of the pose, in [ns].
        sensor: name of the sensor; None for every sensor without poses of its own.
        holds: the pad rests there until the next pose.
        used_from_ns: time of the first scan that was made with it at hand, in [ns]: a pose arrives later than its own
            time, and a replay must not use it earlier. None if it is not available.
    """

    pose: PadPose
    time_ns: int
    sensor: str | None = None
    holds: bool = False
    used_from_ns: int | None = None

    def later(self, by_ns: int) -> "TimedPose":
        """Return the same pose with later times."""
        used_from_ns = None if self.used_from_ns is None else self.used_from_ns + by_ns
        return replace(self, time_ns=self.time_ns + by_ns, used_from_ns=used_from_ns)
