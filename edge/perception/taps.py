"""Stage that follows the taps of one sensor, and gives the window of those that a pattern is due of."""

import numpy as np

from edge.inference.contract import Contract
from edge.inference.pose_input import scheduled_rows
from edge.perception.contact_options import RuntimeOptions
from edge.perception.event import Report
from edge.perception.next_tap import TapAdvice
from edge.perception.pattern_check import REPEATS
from edge.perception.step import Step, Window
from edge.perception.tap_poses import TapPoses
from edge.perception.tap_tracker import TapState, TapTracker
from edge.perception.taxel_health import TaxelWatch
from firmware_bridge.poses.pose_track import PoseTrack

NO_TAP = -1
"""Number of a window that is no tap: readings in doubt, to be looked at."""


class Taps:
    """Stage: contact, the window of taps, their poses, and where to touch next.

    Args:
        tracker: of the sensor's taps.
        watch: over its taxels.
        contract: of the model.
        options: thresholds of taps, and how many a pattern is made from at most.
        report: takes an event for each tap that is left out.

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
        self._poses = TapPoses(contract, options.taps or 1, report) if posed else None
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
