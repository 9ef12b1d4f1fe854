"""Poses of a recording that is played, each at the scan that it served first."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.poses.pose_track import GAP_NS
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.recording.pose_columns import PoseColumns


class PoseLane:
    """Poses of one recording, in their order."""

    def __init__(self, poses: PoseColumns, first_ns: int, sensors: Sequence[str] = ()) -> None:
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
        stated = poses.used_from_ns >= 0
        self._due_ns = np.where(stated, poses.used_from_ns, poses.time_ns - GAP_NS) - first_ns
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
            pose = self._poses.at(self._row, start_ns - self._first_ns)
            self._row += 1
            if pose.sensor is not None or not self._sensors:
                yield pose
                continue
            for sensor in self._sensors:
                yield TimedPose(pose.pose, pose.time_ns, sensor, pose.holds, pose.used_from_ns)


def timed_by_rows(poses: PoseColumns, due_times_ns: NDArray[np.int64]) -> PoseColumns:
    """Return poses of rows with the times of the rows, since the first one, in [ns]."""
    times_ns = due_times_ns[poses.time_ns]
    return PoseColumns(times_ns, poses.values, poses.sensors, poses.sensor, poses.holds, times_ns)
