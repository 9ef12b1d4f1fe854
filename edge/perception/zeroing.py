"""Stage that knows a sensor's rest level: its baseline, stored, taken at the start or on demand, and its drift."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.perception.event import Note, Report
from edge.perception.result import Step
from edge.perception.tap_tracker import TapTracker
from edge.perception.taxel_health import TaxelWatch
from firmware_bridge.errors import BaselineRefusedError
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import FEWEST_SCANS, Baseline, BaselineEstimator, deformation
from firmware_bridge.zeroing.drift_tracker import Drift, DriftTracker

GIVE_UP_NS: Final = 15_000_000_000
"""Longest zeroing on demand, in [ns] of scan time: ten tries at 100 Hz, and four at 30 Hz."""


class Rezeroing:
    """Zeroing of one sensor on demand: takes one new baseline, or gives up.

    Attributes:
        note: its progress.
    """

    def __init__(self, old: Baseline | None, *, force: bool, unix_time_s: Callable[[], float] = time.time) -> None:
        """Start with the next scan; without an old baseline, or by force, a load is zeroed away."""
        self.note = Note("zeroing", "zeroing: keep the pad still and free")
        self._old = old
        self._force = force
        self._unix_time_s = unix_time_s
        self._end_ns: int | None = None
        self._why = f"fewer than {FEWEST_SCANS} whole scans"
        self._estimator = self._new_estimator()

    def push(self, scan: Scan, contact: bool, silent: NDArray[np.bool_] | None) -> Baseline | None:
        """Take one more scan; return the new baseline once there are enough.

        A tap that goes on starts the zeroing over unless it is forced; `silent` taxels (rows, cols) are left unzeroed.

        Raises:
            BaselineRefusedError: the tries have taken too long; the message gives the last reason. The old baseline
                stays.
        """
        if self._end_ns is None:
            self._end_ns = scan.time_ns + GIVE_UP_NS
        if scan.time_ns >= self._end_ns:
            raise BaselineRefusedError(f"{self._why}; tried for {GIVE_UP_NS / 1e9:.0f} s")
        try:
            if contact and not self._force:
                if self._estimator.scans:
                    self._estimator = self._new_estimator()
                raise BaselineRefusedError("the pad is in contact: free it")
            taken = self._estimator.push(scan, silent)
        except BaselineRefusedError as refusal:
            self._why = str(refusal)
            self.note = Note("zeroing_restarted", f"zeroing started over: {refusal}")
            return None
        return None if taken is None else replace(taken, origin="demand")

    def _new_estimator(self) -> BaselineEstimator:
        return BaselineEstimator(reference=self._old, clock=self._unix_time_s)


class Zeroing:
    """Stage: puts the newest readings over the baseline, takes a new one where it is due, and lets it follow drift.

    It reports the outcome of zeroing on demand, and steps in the rest level; `notes` tell why there is no baseline at
    the start.

    Attributes:
        baseline: subtracted from the scans, drift and all; None before there is one.
        notes: why there is no baseline yet, and how a zeroing on demand stands.
        drift_notes: what has become of the rest level.
    """

    def __init__(
        self,
        taps: TapTracker,
        watch: TaxelWatch,
        mounting: Mounting | None,
        report: Report,
        unix_time_s: Callable[[], float],
        notes: tuple[Note, ...] = (),
    ) -> None:
        self.baseline: Baseline | None = None
        self._taps, self._watch, self._mounting = taps, watch, mounting
        self._report, self._unix_time_s = report, unix_time_s
        self.notes = notes
        self._drift: Drift | None = None
        self.drift_notes: tuple[Note, ...] = ()
        self._estimator = BaselineEstimator(clock=unix_time_s)
        self._rezeroing: Rezeroing | None = None
        self._taken: Baseline | None = None
        self._taken_ns: int | None = None
        self._tracker: DriftTracker | None = None

    def use(self, baseline: Baseline, age_s: float | None, time_ns: int) -> None:
        """Subtract a baseline, so many [s] old if that is known, from a time in [ns] on; it ages with the scans."""
        self.baseline = self._taken = baseline
        self._taken_ns = None if age_s is None else time_ns - int(age_s * 1e9)
        self._tracker = DriftTracker(baseline)
        self._drift, self.drift_notes = self._tracker.summary, ()

    def __call__(self, step: Step) -> Baseline | None:
        """Put the step's readings over the baseline; return a baseline that this very scan has completed."""
        new = None
        if self.baseline is None:
            new = self._zero(step.scan)
        elif self._rezeroing is not None:
            new = self._rezero(step.scan, self._rezeroing)
        if new is not None:
            self.use(new, 0.0, step.scan.time_ns)
            self.notes = ()
            step.zeroed = deformation(self._watch.held, new, self._mounting)
        if self.baseline is not None:
            step.baseline, step.drift = self.baseline, self._drift
            if self._taken_ns is not None:
                step.baseline_age_s = max(step.scan.time_ns - self._taken_ns, 0) / 1e9
        return new

    def follow_drift(self, step: Step) -> None:
        """Let the rest level follow the readings of a free pad; it applies from the next scan on."""
        tracker, taken = self._tracker, self._taken
        if tracker is None or taken is None:
            return
        if not tracker.push(step.scan, step.doubted or bool(step.contact), self._watch.dead):
            return
        self.baseline = taken.moved(tracker.counts)
        self._drift, note = tracker.summary, tracker.note
        self.drift_notes = () if note is None else (Note("rest_level", note),)
        event = tracker.take_event()
        if event is not None:
            self._report("rest_level", event)

    def zero_again(self, *, force: bool, doubted: bool) -> None:
        """Take a new baseline from the next scans, with an event for the outcome; the old one stays in use until then.

        It is forced also in contact; one in doubt says nothing of a load.
        """
        if self.baseline is None:
            self._report("zeroing")
        elif self._taps.contact and not force:
            self._report("in_contact")
        else:
            old = None if force or doubted else self.baseline
            self._rezeroing = Rezeroing(old, force=force, unix_time_s=self._unix_time_s)
            self.notes = (self._rezeroing.note,)

    def lose_touch(self) -> None:
        """Compare the rest level with the earlier one before drift is followed again; a zeroing that goes on ends."""
        self._estimator = BaselineEstimator(clock=self._unix_time_s)
        if self._tracker is not None:
            self._tracker.forget()
        if self._rezeroing is not None:
            self._rezeroing, self.notes = None, ()
            self._report("given_up", "the sensor was away; request it again")

    def _zero(self, scan: Scan) -> Baseline | None:
        """Use the scan for the first baseline; after a refusal a note reports it and zeroing starts over."""
        try:
            return self._estimator.push(scan, self._silent())
        except BaselineRefusedError as refusal:
            self.notes = (Note("zeroing_restarted", f"zeroing started over: {refusal}"),)
            return None

    def _rezero(self, scan: Scan, rezeroing: Rezeroing) -> Baseline | None:
        """Push a scan to a zeroing on demand and return the new baseline once there is one."""
        try:
            new = rezeroing.push(scan, self._taps.contact, self._silent())
        except BaselineRefusedError as refusal:
            self._rezeroing, self.notes = None, ()
            self._report("given_up", str(refusal))
            return None
        self.notes = (rezeroing.note,)
        if new is None:
            return None
        self._rezeroing = None
        self._report("zeroed", f"baseline {new.id}" + ("" if self._taken is None else f" instead of {self._taken.id}"))
        self._taps.reset()  # earlier taps were zeroed with another rest level
        return new

    def _silent(self) -> NDArray[np.bool_] | None:
        silent = self._watch.silent_long
        return silent if 2 * np.count_nonzero(silent) < silent.size else None
