"""Choice of a sensor's taps for a model that takes poses, and their poses."""

from collections.abc import Callable, Sequence
from math import hypot, radians, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from edge.inference.pose_input import pose_rows, scheduled_rows
from edge.perception.event import EventKind
from edge.perception.tap_tracker import TapState
from firmware_bridge.poses.pad_pose import PadPose
from firmware_bridge.poses.pose_track import PoseTrack

LEAST_APART_MM: Final = 0.5
"""Least distance between the pads of two taps, in [mm], root mean square over their taxels. The error of a taxel is the
same in all taps at one place, and the model takes it for seen several times: on real grips such taps made five times as
many holes as one alone (docs/decisions.md)."""


class PosedTaps(NamedTuple):
    """Taps that a pattern can be made from: places in the tracker's window, newest first, and poses as model input."""

    slots: Sequence[int]
    rows: NDArray[np.float32]


class TapPoses:
    """Poses of one sensor's taps: each earlier tap has that of its peak, and each that is left out an event.

    While the sensor has no poses, so many `scheduled` taps at most follow the paper's schedule.
    """

    def __init__(self, contract: Contract, scheduled: int, report: Callable[[EventKind, str], object]) -> None:
        self._reach_mm, self._step_deg = contract.reach_mm, contract.angle_step_deg
        # Root mean square of the taxels' distance from the middle of the pad.
        self._radius_mm = contract.pitch_mm * sqrt((contract.rows**2 + contract.cols**2 - 2) / 12)
        self._scheduled = scheduled
        self._report = report
        self._poses: dict[int, PadPose] = {}
        self._reported: set[int] = set()

    def follow(self, tap: TapState, track: PoseTrack) -> None:
        """Look up the poses of earlier taps, and forget those that the tracker has forgotten.

        A pose may come later than its scan, and a track is short, so that every scan looks for what is missing.
        """
        known = self._poses
        for peak in tap.peaks:
            if peak.tap not in known and (pose := track.at(peak.time_ns)) is not None:
                known[peak.tap] = pose
        if max(len(known), len(self._reported) - 1) > len(tap.peaks):
            remembered = {peak.tap for peak in tap.peaks}
            self._poses = {number: pose for number, pose in known.items() if number in remembered}
            self._reported &= remembered | {tap.tap}

    def choose(self, tap: TapState, pose: PadPose | None, *, scheduled: bool) -> PosedTaps:
        """Return the taps to use during contact; the pose is that of the newest tap's pad at this scan."""
        if scheduled:
            taps = min(tap.taps_used, self._scheduled)
            return PosedTaps(range(taps), scheduled_rows(taps, self._step_deg))
        if pose is None:
            self._leave_out(tap.tap, "tap_without_pose", "this tap has no pose: its pattern is made from it alone")
            return PosedTaps((0,), scheduled_rows(1, 0.0))
        slots, poses = [0], [pose]
        for slot, peak in enumerate(tap.peaks, 1):
            earlier = self._poses.get(peak.tap)
            if earlier is None:
                self._leave_out(peak.tap, "tap_without_pose", "an earlier tap has no pose, and is left out")
                continue
            away_mm = hypot(earlier.x_mm - pose.x_mm, earlier.y_mm - pose.y_mm)
            if away_mm > self._reach_mm:
                why = f"an earlier tap is {away_mm:.1f} mm away, and the model takes none beyond {self._reach_mm:g} mm"
                self._leave_out(peak.tap, "tap_out_of_reach", f"{why}: it is left out")
                continue
            if any(self._apart_mm(earlier, other) < LEAST_APART_MM for other in poses):
                continue
            slots.append(slot)
            poses.append(earlier)
        return PosedTaps(slots, pose_rows(poses))

    def _apart_mm(self, one: PadPose, other: PadPose) -> float:
        """Return the distance between two pads, root mean square over their taxels, in [mm], for small turns."""
        turned_mm = self._radius_mm * radians(abs((one.turn_deg - other.turn_deg + 180) % 360 - 180))
        return hypot(one.x_mm - other.x_mm, one.y_mm - other.y_mm, turned_mm)

    def _leave_out(self, tap: int, kind: EventKind, why: str) -> None:
        if tap not in self._reported:
            self._reported.add(tap)
            self._report(kind, why)
