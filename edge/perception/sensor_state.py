"""State of one sensor between scans: its zeroing, its taxels, its taps and its last pattern."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from edge.perception.baseline_doubt import BaselineDoubt, Doubt, doubt_text
from edge.perception.change_gate import LastReading
from edge.perception.contact_options import DEFAULTS, RuntimeOptions
from edge.perception.dead_taxel_fill import Filler, Readings, TaxelEstimator
from edge.perception.event import EventKind, Note, Untimed
from edge.perception.gain_following import GainFollower
from edge.perception.next_tap import TapAdvice
from edge.perception.pattern_check import PatternCheck
from edge.perception.result import Result, WrenchOrigin
from edge.perception.tap_poses import TapPoses
from edge.perception.tap_tracker import TapTracker
from edge.perception.taxel_health import TaxelWatch
from edge.perception.zero_on_demand import Rezeroing
from firmware_bridge.errors import BaselineRefusedError
from firmware_bridge.pad_geometry import AXES, SensorGeometry
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import Scan
from firmware_bridge.silence import TAPS_FORGOTTEN_NS
from firmware_bridge.zeroing.baseline import Baseline, BaselineEstimator, deformation
from firmware_bridge.zeroing.drift_tracker import Drift, DriftTracker


class Sensor:
    """State of one sensor between scans.

    Attributes:
        baseline: subtracted from the scans, drift and all; None before there is one.
        drift: what has become of the rest level since it was zeroed; None without a baseline.
        zeroing_notes: why there is no baseline yet, or how a zeroing on demand stands.
        drift_notes: what the user should know of the rest level.
        rest: tells whether its readings may be a touch, or an old baseline explains them as well.
        doubt: what it said last.
        doubt_notes: the same for the user.
        counts_per_newton: summed z per [N], if that is known.
        pad: what is known of it.
        pad_row: the same as the model takes it.
        poses: chooses the taps of a model that takes poses; None for other models.
        advice: proposes where to touch next; None for models that take no poses.
        check: decides whether its patterns are to be believed; None where the model has no checks.
        gains: (3, rows, cols) that the model takes readings divided by; None where it takes them as they are.
        gains_certainty: of the gains that are available, see firmware_bridge.scans.pad_constants.Pad; None without.
        follower: learns the gains from contacts; None where they are not learned.
        wrench_origin: whether the model gets the sensor's counts per newton.
        filler: estimates the dead taxels; None where none is dead, or nothing may be estimated.
        events: what has happened to the zeroing since the last scan; the reader clears them.
    """

    def __init__(
        self,
        name: str,
        geometry: SensorGeometry,
        taps: TapTracker,
        estimator: TaxelEstimator | None,
        notes: tuple[Note, ...] = (),
        mounting: Mounting | None = None,
        unix_time_s: Callable[[], float] = time.time,
        options: RuntimeOptions = DEFAULTS,
    ) -> None:
        self.taps = taps
        self.rest = BaselineDoubt(options, geometry.taxel_count)
        self.doubt: Doubt | None = None
        self.doubt_notes: tuple[Note, ...] = ()
        self.poses: TapPoses | None = None
        self.advice: TapAdvice | None = None
        self.last_reading = LastReading(geometry.scan_shape)
        self.last: Result | None = None
        # Plain attributes, since properties would make a scan at rest take a twentieth longer.
        self.baseline: Baseline | None = None
        self.drift: Drift | None = None
        self.zeroing_notes = notes
        self.drift_notes: tuple[Note, ...] = ()
        self.events: list[Untimed] = []
        self.counts_per_newton: float | None = None
        self.pad: Pad | None = None
        self.pad_row: NDArray[np.float32] = np.zeros(0, dtype=np.float32)
        self.gains: NDArray[np.float32] | None = None
        self.check: PatternCheck | None = None
        self.gains_certainty: float | None = None
        self.follower: GainFollower | None = None
        self._learned: Pad | None = None
        self.wrench_origin: WrenchOrigin = "nominal"
        self.watch = TaxelWatch((geometry.rows, geometry.cols), mounting)
        self._mounting = mounting
        self._name = name
        self.filler: Filler | None = None
        self._received_ns: int | None = None
        self._estimator = estimator
        self._unix_time_s = unix_time_s
        self._zeroing = BaselineEstimator(clock=unix_time_s)
        self._rezeroing: Rezeroing | None = None
        self._taken: Baseline | None = None
        self._taken_ns: int | None = None
        self._tracker: DriftTracker | None = None

    def take_pad(self, contract: Contract) -> None:
        """Convert the pad's properties to model input, once for all its runs."""
        pad = self.pad
        if self.counts_per_newton is not None and (pad is None or pad.counts_per_newton is None):
            pad = replace(pad or Pad(), counts_per_newton=self.counts_per_newton)
        self.pad_row = contract.pad_row(pad)
        self.gains = None
        if contract.takes_gains and pad is not None and pad.gains is not None:
            self.gains = np.asarray(pad.gains, dtype=np.float32).reshape(len(AXES), contract.rows, contract.cols)
        if self.check is not None:
            self.check.use_pad(self.pad_row, outside=contract.is_outside(pad))
        calibrated = pad is not None and pad.counts_per_newton is not None
        self.gains_certainty = None if pad is None or pad.gains is None else pad.gains_certainty
        takes = any(name == "counts_per_newton" for name, _, _ in contract.pad_inputs)
        self.wrench_origin = "calibrated" if calibrated and takes else "nominal"

    def take_learned(self) -> Pad | None:
        """Return the pad if its gains were learned since the last call."""
        learned, self._learned = self._learned, None
        return learned

    def learn(self, contract: Contract) -> None:
        """Learn from the contact that waits; if new gains come into use, an event reports it."""
        pad = None if self.follower is None else self.follower.learn(self.watch.dead)
        if self.follower is not None and self.check is not None and self.follower.contradicts_file:
            if not self.check.suspected:
                why = "its contacts contradict the gains of its sensor file: is it another sensor's file?"
                self.report("suspected", why)
            self.check.suspect_file()
            return
        if pad is None or self.follower is None:
            return
        self.pad, self._learned = pad, self.follower.learned
        self.take_pad(contract)
        self.last = None  # its pattern was made with other gains
        widths = pad.gain_half_widths or ()
        percent = 100 * float(np.sqrt(np.square(widths).mean()))
        detail = f"gains learned from {self.follower.contacts} contacts, each within {percent:.0f} %"
        self.report("gains_learned", detail)

    def use(self, baseline: Baseline, age_s: float | None, time_ns: int) -> None:
        """Subtract a baseline from now on.

        Args:
            baseline: of this sensor.
            age_s: its age at `time_ns`, in [s]; None if unknown.
            time_ns: on the clock of the scans, in [ns]; ages follow it, since a wall clock may be set.
        """
        self.baseline = self._taken = baseline
        self._taken_ns = None if age_s is None else time_ns - int(age_s * 1e9)
        self._tracker = DriftTracker(baseline)
        self.drift, self.drift_notes = self._tracker.summary, ()
        self.rest.begin(baseline.origin)

    def weigh(self, readings: NDArray[np.float32], z_counts: float, time_ns: int) -> bool:
        """Return whether the baseline is in doubt, and report when that begins, changes and ends.

        Args:
            readings: (3, rows, cols) in counts over the baseline, without gaps.
            z_counts: their summed z.
            time_ns: of the scan, in [ns].
        """
        doubt = self.rest.weigh(readings, z_counts, time_ns)
        if doubt is not self.doubt:
            self.doubt = doubt
            if doubt is None:
                self.report("baseline_cleared")
            else:
                text = doubt_text(doubt, self.rest.counts, self.age_s(time_ns))
                self.doubt_notes = (Note("baseline_in_doubt", text),)
                self.report("baseline_doubted", text)
        return doubt is not None

    def age_s(self, time_ns: int) -> float | None:
        """Return the age of the baseline, in [s]; None if unknown."""
        return None if self._taken_ns is None else max(time_ns - self._taken_ns, 0) / 1e9

    def lose_touch(self, *, same_pad: bool = False) -> None:
        """Forget earlier readings and taps, since no scan of the sensor arrived for a time.

        Drift is followed again once the pad has been at rest and its rest level has been compared with the earlier one;
        a contact is believed again once the pad was seen at rest, unless it is the `same_pad` for sure.
        """
        self.taps.reset()
        self.last = None
        self.watch.forget()
        self.rest.lose_touch(same_pad=same_pad)
        self._zeroing = BaselineEstimator(clock=self._unix_time_s)
        if self._tracker is not None:
            self._tracker.forget()
        if self._rezeroing is not None:
            self._end_rezeroing()
            self.report("given_up", "the sensor was away; request it again")

    def take(self, scan: Scan) -> NDArray[np.float32] | None:
        """Take a scan and return each taxel's newest reading over the baseline (3, rows, cols); None without one."""
        if self._received_ns is not None and scan.time_ns - self._received_ns > TAPS_FORGOTTEN_NS:
            self.lose_touch()
        self._received_ns = scan.time_ns
        before = self.watch.dead
        zeroed = self.watch.push(scan, self.baseline)
        if self.watch.dead is not before:
            self._bury()
        if self.baseline is None:
            self._zero(scan)
        elif self._rezeroing is None or not self._rezero(scan, self._rezeroing):
            return zeroed
        return None if self.baseline is None else deformation(self.watch.held, self.baseline, self._mounting)

    def fill(self, zeroed: NDArray[np.float32]) -> Readings | None:
        """Return readings with estimates for the dead taxels; None if no taxel is dead, or too many are."""
        return self.filler(zeroed) if self.filler is not None and self.watch.may_be_estimated else None

    def follow_drift(self, scan: Scan, contact: bool) -> None:
        """Let the rest level follow the readings of a free pad; it applies from the next scan on."""
        tracker, taken = self._tracker, self._taken
        if tracker is None or taken is None or not tracker.push(scan, contact, self.watch.dead):
            return
        self.baseline = taken.moved(tracker.counts)
        self.drift, note = tracker.summary, tracker.note
        self.drift_notes = () if note is None else (Note("rest_level", note),)
        event = tracker.take_event()
        if event is not None:
            self.report("rest_level", event)

    def zero_again(self, *, force: bool) -> None:
        """Take a new baseline from the next scans, with an event for the outcome; the old one stays in use until then.

        Args:
            force: also in contact.
        """
        if self.baseline is None:
            self.report("zeroing")
        elif self.taps.contact and not force:
            self.report("in_contact")
        else:
            old = None if force or self.doubt is not None else self.baseline
            self._rezeroing = Rezeroing(old, force=force, unix_time_s=self._unix_time_s)
            self.zeroing_notes = (self._rezeroing.note,)

    def _bury(self) -> None:
        """Prepare the estimate of the dead taxels after their set has changed."""
        # Earlier taps hold what a taxel read before it was detected; and no tap may hold estimates that no note
        # reports.
        self.taps.reset()
        self.filler = None
        dead = np.count_nonzero(self.watch.dead)
        if 0 < 2 * dead <= self.watch.dead.size and self._estimator is not None:
            self.filler = self._estimator.filler(self.watch.dead)

    def _zero(self, scan: Scan) -> None:
        """Use the scan for the baseline; after a refusal a note reports it and zeroing starts over."""
        try:
            baseline = self._zeroing.push(scan, self._silent())
        except BaselineRefusedError as refusal:
            self.zeroing_notes = (Note("zeroing_restarted", f"zeroing started over: {refusal}"),)
            return
        if baseline is not None:
            self.use(baseline, 0.0, scan.time_ns)
            self.zeroing_notes = ()

    def _rezero(self, scan: Scan, rezeroing: Rezeroing) -> bool:
        """Push a scan to a zeroing on demand and return whether it gave a new baseline."""
        try:
            baseline = rezeroing.push(scan, self.taps.contact, self._silent())
        except BaselineRefusedError as refusal:
            self._end_rezeroing()
            self.report("given_up", str(refusal))
            return False
        self.zeroing_notes = (rezeroing.note,)
        if baseline is None:
            return False
        old = "" if self._taken is None else f" instead of {self._taken.id}"
        self.report("zeroed", f"baseline {baseline.id}{old}")
        self._end_rezeroing()
        self.use(baseline, 0.0, scan.time_ns)
        self.taps.reset()  # earlier taps were zeroed with another rest level
        return True

    def _end_rezeroing(self) -> None:
        self._rezeroing, self.zeroing_notes = None, ()

    def report(self, kind: EventKind, detail: str = "") -> None:
        """Report an event with the sensor's next scan."""
        self.events.append(Untimed(kind, self._name, detail))

    def _silent(self) -> NDArray[np.bool_] | None:
        silent = self.watch.silent_long
        return silent if 2 * np.count_nonzero(silent) < silent.size else None
