"""Taps of one sensor: contact, the window of a due pattern with its poses, and where to touch next.

Contact has two thresholds on the summed z, so that noise around one of them cannot split a tap. While a tap goes on
the window holds its current frame, so that a robot gets a pattern from its first scan; earlier taps have their peaks.
"""

import math
from collections import deque
from collections.abc import Container, Sequence
from dataclasses import dataclass
from math import cos, hypot, radians, sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract, pose_rows, scheduled_rows
from edge.perception.event import EventKind, Report
from edge.perception.result import NextTap, Step, Window
from edge.perception.run_options import RuntimeOptions
from edge.perception.taxel_health import REPEATS, Health
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses import PadPose, PoseTrack

MIN_TAP_SCANS: Final = 2  # a touch in a single scan may be a flipped bit: it is reported, but not remembered as a tap


@dataclass(eq=False, slots=True)
class TapPeak:
    """Peak of a tap, when its readings (3, rows, cols) were taken, and its pose if known."""

    tap: int
    time_ns: int
    readings: NDArray[np.float32]
    pose: PadPose | None = None


class TapTracker:
    """Tracker of the taps of one sensor, for windows of K taps."""

    newest: NDArray[np.float32]  # readings (3, rows, cols) in contact
    peaks: tuple[TapPeak, ...]  # of the earlier taps, newest first: one fewer than a window has taps

    def __init__(self, taps: int, options: RuntimeOptions) -> None:
        self._earlier = taps - 1
        self._on_counts = options.contact_on_counts
        self._off_counts = options.contact_off_counts
        self._idle_reset_ns = options.idle_reset_s * 1e9
        self._peak: TapPeak | None = None
        self.contact = False
        self.tap = -1  # number of the tap, from 0; without contact that of the last one
        self._last_contact_ns = 0
        self.reset()

    def reset(self) -> None:
        """Forget every tap. A tap in progress continues as the first one, with a new number."""
        self.tap += self.contact
        self.peaks = ()
        self._tap_scans = 0
        self._peak_counts = -math.inf

    def forget(self, slots: Container[int]) -> None:
        """Forget the earlier taps at these places of the window; those before them move up."""
        self.peaks = tuple(peak for slot, peak in enumerate(self.peaks, 1) if slot not in slots)

    def push(
        self, readings: NDArray[np.float32], z_counts: float, time_ns: int, taken_ns: int, *, doubted: bool = False
    ) -> None:
        """Take a scan's zeroed counts (3, rows, cols), their summed z, and when it arrived and was taken, in [ns].

        The idle time counts from the last scan in contact; time that runs backwards counts as no time, and a gap within
        a tap does not end it. A scan that is doubted is no contact, whatever its z: this ends a tap where a pad rests.
        """
        if self.contact:
            self.contact = z_counts >= self._off_counts and not doubted
            if not self.contact:
                self._release()
        elif z_counts >= self._on_counts and not doubted:
            self._forget_if_idle(time_ns)
            self.contact = True
            self.tap += 1

        if self.contact:
            self._last_contact_ns = time_ns
            self._tap_scans += 1
            self.newest = readings.copy()
            if z_counts > self._peak_counts:
                self._peak_counts = z_counts
                self._peak = TapPeak(self.tap, taken_ns, self.newest)
        else:
            self._forget_if_idle(time_ns)

    def _release(self) -> None:
        if self._tap_scans >= MIN_TAP_SCANS and self._peak is not None:
            self.peaks = (self._peak, *self.peaks)[: self._earlier]
        self._tap_scans = 0
        self._peak_counts = -math.inf

    def _forget_if_idle(self, time_ns: int) -> None:
        self._last_contact_ns = min(self._last_contact_ns, time_ns)
        if time_ns - self._last_contact_ns > self._idle_reset_ns:
            self.reset()


HALF_PITCH_MM: Final = USPA44.pitch_mm / 2  # four taps half a pitch apart read what lies between the taxels
_SHIFTS_MM: Final = np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]) * HALF_PITCH_MM


def next_shift_mm(places_mm: NDArray[np.floating], reach_mm: float) -> tuple[float, float] | None:
    """Return the shift dx, dy in [mm] from the newest tap, of half a pitch along x, y or both, to touch next.

    Places (K, 2) of the taps so far are in the newest one's axes, and the next one must be in reach of all that are
    themselves in reach; None where each place was touched or is out of reach.
    """
    places_mm = places_mm[np.hypot(*places_mm.T) <= reach_mm]
    distances_mm = np.hypot(*(_SHIFTS_MM[:, None] - places_mm).transpose(2, 0, 1))
    free = (distances_mm > HALF_PITCH_MM / 2).all(axis=1) & (distances_mm <= reach_mm).all(axis=1)
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
    """Stage: contact, the window of taps, their poses, and where to touch next."""

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
        self._strongest: tuple[int, float, PadPose | None] = -1, 0.0, None  # pattern: its tap, its summed z, its pose

    def __call__(self, step: Step, track: PoseTrack | None) -> None:
        """Take a step with readings; `track` has the poses of its pad, None if there are none."""
        scan, readings, z_counts = step.scan, step.readings, step.force_counts
        if readings is None or z_counts is None:
            return
        tap = self._tracker
        tap.push(readings, z_counts, scan.time_ns, scan.on_bus_ns, doubted=step.doubted)
        if track is not None:  # a pose may come later than its scan, and a track is short
            for peak in tap.peaks:
                peak.pose = peak.pose or track.at(peak.time_ns)
        if tap.contact:
            step.state, step.contact, step.due = "contact", True, self._window(step, tap, scheduled=track is None)
        elif not step.doubted:
            step.state, step.contact = "idle", False
            if tap.peaks and self._contract.takes_poses:
                step.next_tap = self._propose(tap.peaks)
        else:
            step.state = "baseline_in_doubt"
            if z_counts >= self._on_counts:  # to be looked at, and made from this scan alone
                counts = np.zeros((self._contract.taps, *readings.shape), dtype=np.float32)
                counts[0] = readings
                rows = scheduled_rows(1, 0.0) if self._contract.takes_poses else None
                step.due = Window(counts, 1, (0,), rows, NO_TAP, (NO_TAP, step.filled))

    def see(self, tap: int, z_counts: float, pose: PadPose | None, taps_used: int) -> None:
        """Take a pattern's tap and pose, None if it is not believed: the strongest one tells where the tap was."""
        if tap != self._strongest[0] or z_counts >= self._strongest[1]:
            self._strongest = tap, z_counts, pose if taps_used < self._most else None

    def _window(self, step: Step, tap: TapTracker, *, scheduled: bool) -> Window:
        if self._contract.takes_poses:
            slots, rows = self._choose(tap, step.pose, scheduled=scheduled)
            slots, rows = tuple(slots[: self._most]), rows[: self._most]
            taps = len(slots)
            counts = np.stack([tap.newest, *(tap.peaks[slot - 1].readings for slot in slots[1:])])
        else:
            taps, rows = min(1 + len(tap.peaks), self._most), None
            slots = tuple(range(taps))
            counts = np.zeros((self._contract.taps, *tap.newest.shape), dtype=np.float32)
            counts[0] = tap.newest
            for slot, peak in enumerate(tap.peaks, 1):
                counts[slot] = peak.readings
        made_by = (tap.tap, slots, step.filled, self._health.most_repeats >= REPEATS)
        return Window(counts, taps, slots, rows, tap.tap, made_by)

    def _choose(
        self, tap: TapTracker, pose: PadPose | None, *, scheduled: bool
    ) -> tuple[Sequence[int], NDArray[np.float32]]:
        """Return the taps to use during contact: places in the window, newest first, and their poses as model input."""
        if scheduled:
            taps = min(1 + len(tap.peaks), self._scheduled)
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

    def _propose(self, peaks: tuple[TapPeak, ...]) -> NextTap | None:
        """Return where to touch next; None where no tap is to follow the newest."""
        tap, _, newest = self._strongest
        if newest is None or tap != peaks[0].tap:
            return None
        poses = [newest, *(peak.pose for peak in peaks[1:] if peak.pose is not None)]
        seen = [pose.seen_from(newest) for pose in poses]
        shift_mm = next_shift_mm(np.array([(pose.x_mm, pose.y_mm) for pose in seen]), self._contract.reach_mm)
        return None if shift_mm is None else NextTap(*shift_mm, 0.0, _reached(newest, *shift_mm))
