"""Stage that follows the taps of one sensor: the window of those that a pattern is due of, and where to touch next."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from edge.inference.pose_input import scheduled_rows
from edge.perception.contact_options import RuntimeOptions
from edge.perception.event import Report
from edge.perception.pattern_check import REPEATS
from edge.perception.result import NextTap
from edge.perception.step import Step, Window
from edge.perception.tap_poses import TapPoses
from edge.perception.tap_tracker import TapState, TapTracker
from edge.perception.taxel_health import TaxelWatch
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses.pad_pose import PadPose
from firmware_bridge.poses.pose_track import PoseTrack

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

    def proposal(self, tap: TapState) -> NextTap | None:
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
    apart_mm = np.hypot(*(_SHIFTS_MM[:, None] - places_mm).transpose(2, 0, 1))
    free = (apart_mm > _HALF_PITCH_MM / 2).all(axis=1) & (apart_mm <= reach_mm).all(axis=1)
    if not free.any():
        return None
    from_middle_mm = np.hypot(*(_SHIFTS_MM - places_mm.mean(axis=0)).T)
    dx_mm, dy_mm = _SHIFTS_MM[int(np.where(free, from_middle_mm, np.inf).argmin())].tolist()
    return dx_mm, dy_mm


def _reached(newest: PadPose, dx_mm: float, dy_mm: float) -> PadPose:
    """Return the pose in the object's plane of a shift in the newest tap's axes."""
    turn = math.radians(newest.turn_deg)
    cosine, sine = math.cos(turn), math.sin(turn)
    return PadPose(
        newest.x_mm + cosine * dx_mm - sine * dy_mm,
        newest.y_mm + sine * dx_mm + cosine * dy_mm,
        newest.turn_deg,
        newest.error_mm,
        newest.error_deg,
    )


NO_TAP = -1
"""Number of a window that is no tap: readings in doubt, to be looked at."""


class Taps:
    """Stage: contact, the window of taps, their poses, and where to touch next.

    Attributes:
        advice: proposes where to touch next; None for models that take no poses.
    """

    def __init__(
        self, tracker: TapTracker, watch: TaxelWatch, contract: Contract, options: RuntimeOptions, report: Report
    ) -> None:
        self._tracker, self._watch = tracker, watch
        self._most = contract.taps if options.taps is None else options.taps
        self._on_counts = options.contact_on_counts
        posed = contract.takes_poses
        self._poses = TapPoses(contract, options.taps or contract.unposed_taps, report) if posed else None
        self.advice = TapAdvice(contract.reach_mm, self._most) if posed else None

    def __call__(self, step: Step, track: PoseTrack | None) -> None:
        """Take a step with readings; `track` has the poses of its pad, None if there are none."""
        scan, readings, z_counts = step.scan, step.readings, step.force_counts
        if readings is None or z_counts is None:
            return
        tap = self._tracker.push(readings, scan.time_ns, z_counts, scan.on_bus_ns, doubted=step.doubted)
        if self._poses is not None and track is not None:
            self._poses.follow(tap, track)
        step.state, step.contact = "idle", tap.contact
        if tap.contact:
            step.state, step.due = "contact", self._window(step, tap, scheduled=track is None)
        elif step.doubted:
            step.state, step.contact = "baseline_in_doubt", None
            if z_counts >= self._on_counts:  # to be looked at, and made from this scan alone
                counts = np.zeros_like(tap.window)
                counts[0] = readings
                rows = None if self._poses is None else scheduled_rows(1, 0.0)
                step.due = Window(counts, 1, (0,), rows, NO_TAP, (NO_TAP, step.filled))
        if self.advice is not None and not step.doubted:
            step.next_tap = self.advice.proposal(tap)

    def _window(self, step: Step, tap: TapState, *, scheduled: bool) -> Window:
        taps = min(tap.taps_used, self._most)
        if self._poses is None:
            # A copy, since the tracker overwrites its own if the sensor's next scan comes in the same call.
            counts, slots, rows = tap.window.copy(), range(len(tap.window)), None
        else:
            posed = self._poses.choose(tap, step.pose, scheduled=scheduled)
            taps = min(taps, len(posed.slots))
            slots, rows = posed.slots[:taps], posed.rows[:taps]
            counts = tap.window[list(slots)]
        made_by = (tap.tap, tuple(slots), taps, step.filled, self._watch.most_repeats >= REPEATS)
        return Window(counts, taps, slots, rows, tap.tap, made_by)
