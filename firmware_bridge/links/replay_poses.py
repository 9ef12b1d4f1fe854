"""Poses of a recording that is played, each at the scan that it served first."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from firmware_bridge.poses.pose_track import GAP_NS
from firmware_bridge.poses.timed_pose import TimedPose


class PoseLane:
    """Poses of one recording, in their order."""

    def __init__(self, poses: Sequence[TimedPose], first_ns: int, sensors: Sequence[str] = ()) -> None:
        """Begin before the first pose.

        Args:
            poses: of the recording, with times.
            first_ns: time of the first scan of the recording, in [ns].
            sensors: names of the sensors for which poses of all sensors are meant, where others are played as well.
        """
        self._poses = poses
        self._first_ns = first_ns
        self._sensors = sensors
        # A file of another program does not state which scan a pose served. There each pose comes early, so that it is
        # interpolated; one that comes earlier than the longest gap would not be used earlier.
        used_from_ns = (one.time_ns - GAP_NS if one.used_from_ns is None else one.used_from_ns for one in poses)
        self._due_ns = np.fromiter(used_from_ns, np.int64, len(poses)) - first_ns
        self._row = 0

    def begin_at(self, due_ns: int) -> None:
        """Go on with the poses around a scan, at its time in [ns] since the first one of the recording."""
        later = self._due_ns >= due_ns - GAP_NS
        self._row = int(later.argmax()) if later.any() else len(self._poses)

    def up_to(self, due_ns: int, start_ns: int) -> Iterator[TimedPose]:
        """Yield the next poses that a scan uses.

        Args:
            due_ns: time of the scan since the first one of the recording, in [ns].
            start_ns: time of the first scan as it is played, in [ns].
        """
        while self._row < len(self._poses) and self._due_ns[self._row] <= due_ns:
            pose = self._poses[self._row].later(start_ns - self._first_ns)
            self._row += 1
            for sensor in (pose.sensor,) if pose.sensor is not None or not self._sensors else self._sensors:
                yield replace(pose, sensor=sensor)
