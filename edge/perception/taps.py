"""Stage that follows the taps of one sensor: the window of a due pattern, its poses, and where to touch next."""

from collections import deque
from collections.abc import Sequence
from math import cos, hypot, radians, sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract, pose_rows, scheduled_rows
from edge.perception.contact_options import RuntimeOptions
from edge.perception.event import EventKind, Report
from edge.perception.result import NextTap, Step, Window
from edge.perception.tap_tracker import TapTracker
from edge.perception.taxel_health import Health
from edge.perception.trust_check import REPEATS
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses import PadPose, PoseTrack

_HALF_PITCH_MM: Final = USPA44.pitch_mm / 2
"""Four taps half a pitch apart read what lies between the taxels. A search for the place of the largest expected gain
was worth 0.41 dB over such places at two taps and 0.08 dB at four, so it is not made."""
_SHIFTS_MM: Final = np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]) * _HALF_PITCH_MM


class TapAdvice:
    """Proposal for one sensor: made once, when a tap ends, and kept until the next one begins."""

    def __init__(self, reach_mm: float, taps: int) -> None:
        self._reach_mm, self._taps = reach_mm, taps
        self._strongest: Step | None = None
        self._tap = -1
        self._proposed: NextTap | None = None

    def see(self, made: Step, tap: int) -> None:
        """Take a step with a pattern: the strongest one of a tap, by its number, counts."""
        before = self._strongest
        if tap != self._tap:  # also after a reset within a tap, which goes on with another number
            self._tap, before = tap, None
        if before is None or (made.force_counts or 0.0) >= (before.force_counts or 0.0):
            self._strongest = made

    def proposal(self, tap: TapTracker) -> NextTap | None:
        """Return where to touch next; None during a tap, and where nothing can be proposed or the tap is forgotten."""
        if tap.contact or not tap.peaks or tap.peaks[0].tap != self._tap:
            self._proposed = None
            if not tap.contact:
                self._strongest = None
            return None
        if (made := self._strongest) is not None:
            self._strongest = None
            self._proposed = self._propose(made)
        return self._proposed

    def _propose(self, made: Step) -> NextTap | None:
        estimate = made.estimate
        # Without a pose the next tap could not be placed.
        if made.pose is None or estimate is None or estimate.poses is None:
            return None
        if estimate.trusted is False or estimate.taps_used >= self._taps:
            return None
        shift_mm = next_shift_mm(estimate.poses[:, :2], self._reach_mm)
        return None if shift_mm is None else NextTap(*shift_mm, 0.0, _reached(made.pose, *shift_mm))


def next_shift_mm(places_mm: NDArray[np.floating], reach_mm: float) -> tuple[float, float] | None:
    """Return the shift dx, dy in [mm] from the newest tap, of half a pitch along x, y or both, to touch next.

    Places (K, 2) of the taps so far are in the newest one's axes, and the next one must not be further than the reach
    from any of them; None where each place was touched or is out of reach.
    """
    distances_mm = np.hypot(*(_SHIFTS_MM[:, None] - places_mm).transpose(2, 0, 1))
    free = (distances_mm > _HALF_PITCH_MM / 2).all(axis=1) & (distances_mm <= reach_mm).all(axis=1)
    if not free.any():
        return None
    from_middle_mm = np.hypot(*(_SHIFTS_MM - places_mm.mean(axis=0)).T)
    dx_mm, dy_mm = _SHIFTS_MM[int(np.where(free, from_middle_mm, np.inf).argmin())].tolist()
    return dx_mm, dy_mm


def _reached(newest: PadPose, dx_mm: float, dy_mm: float) -> PadPose:
    """Return the pose in the object's plane of a shift in the newest tap's axes."""
    turn = radians(newest.turn_deg)
    cosine, sine = cos(turn), sin(turn)
    return PadPose(
        newest.x_mm + cosine * dx_mm - sine * dy_mm,
        newest.y_mm + sine * dx_mm + cosine * dy_mm,
        newest.turn_deg,
        newest.error_mm,
        newest.error_deg,
    )


NO_TAP = -1  # number of a window that is no tap: readings in doubt, to be looked at


class Taps:
    """Stage: contact, the window of taps, their poses, and where to touch next.

    Attributes:
        advice: proposes where to touch next; None for models that take no poses.
    """

    def __init__(
        self, tracker: TapTracker, health: Health, contract: Contract, options: RuntimeOptions, report: Report
    ) -> None:
        self._tracker, self._health = tracker, health
        self._contract, self._report = contract, report
        self._most = contract.taps if options.taps is None else options.taps
        self._scheduled = options.taps or contract.unposed_taps
        self._on_counts = options.contact_on_counts
        # Root mean square of the taxels' distance from the middle of the pad.
        self._radius_mm = contract.pitch_mm * sqrt((contract.rows**2 + contract.cols**2 - 2) / 12)
        self._reported: deque[int] = deque(maxlen=64)  # newest taps that were left out; no window has as many
        self.advice = TapAdvice(contract.reach_mm, self._most) if contract.takes_poses else None

    def __call__(self, step: Step, track: PoseTrack | None) -> None:
        """Take a step with readings; `track` has the poses of its pad, None if there are none."""
        scan, readings, z_counts = step.scan, step.readings, step.force_counts
        if readings is None or z_counts is None:
            return
        tap = self._tracker
        tap.push(readings, scan.time_ns, z_counts, scan.on_bus_ns, doubted=step.doubted)
        if track is not None:  # a pose may come later than its scan, and a track is short
            for peak in tap.peaks:
                peak.pose = peak.pose or track.at(peak.time_ns)
        step.state, step.contact = "idle", tap.contact
        if tap.contact:
            step.state, step.due = "contact", self._window(step, tap, scheduled=track is None)
        elif step.doubted:
            step.state, step.contact = "baseline_in_doubt", None
            if z_counts >= self._on_counts:  # to be looked at, and made from this scan alone
                counts = np.zeros_like(tap.window)
                counts[0] = readings
                rows = scheduled_rows(1, 0.0) if self._contract.takes_poses else None
                step.due = Window(counts, 1, (0,), rows, NO_TAP, (NO_TAP, step.filled))
        if self.advice is not None and not step.doubted:
            step.next_tap = self.advice.proposal(tap)

    def _window(self, step: Step, tap: TapTracker, *, scheduled: bool) -> Window:
        taps = min(tap.taps_used, self._most)
        if not self._contract.takes_poses:
            counts, slots, rows = tap.window, range(taps), None
        else:
            slots, rows = self._choose(tap, step.pose, scheduled=scheduled)
            taps = min(taps, len(slots))
            slots, rows = slots[:taps], rows[:taps]
            counts = tap.window[list(slots)]
        made_by = (tap.tap, tuple(slots), taps, step.filled, self._health.most_repeats >= REPEATS)
        return Window(counts, taps, slots, rows, tap.tap, made_by)

    def _choose(
        self, tap: TapTracker, pose: PadPose | None, *, scheduled: bool
    ) -> tuple[Sequence[int], NDArray[np.float32]]:
        """Return the taps to use during contact: places in the window, newest first, and their poses as model input.

        The pose is that of the newest tap's pad at this scan; without poses taps follow the paper's schedule.
        """
        if scheduled:
            taps = min(tap.taps_used, self._scheduled)
            return range(taps), scheduled_rows(taps, self._contract.angle_step_deg)
        if pose is None:
            self._leave_out(tap.tap, "tap_without_pose", "this tap has no pose: its pattern is made from it alone")
            return (0,), scheduled_rows(1, 0.0)
        slots, poses, reach_mm = [0], [pose], self._contract.reach_mm
        for slot, peak in enumerate(tap.peaks, 1):
            if (earlier := peak.pose) is None:
                self._leave_out(peak.tap, "tap_without_pose", "an earlier tap has no pose, and is left out")
                continue
            away_mm = hypot(earlier.x_mm - pose.x_mm, earlier.y_mm - pose.y_mm)
            if away_mm > reach_mm:
                why = f"an earlier tap is {away_mm:.1f} mm away, and the model takes none beyond {reach_mm:g} mm"
                self._leave_out(peak.tap, "tap_out_of_reach", f"{why}: it is left out")
                continue
            # The error of a taxel is the same in all taps at one place, and the model takes it for seen several times:
            # on real grips such taps made five times as many holes as one alone (docs/decisions.md).
            if any(earlier.away_mm(other, self._radius_mm) < 0.5 for other in poses):
                continue
            slots.append(slot)
            poses.append(earlier)
        return slots, pose_rows(poses)

    def _leave_out(self, tap: int, kind: EventKind, why: str) -> None:
        if tap not in self._reported:
            self._reported.append(tap)
            self._report(kind, why)
