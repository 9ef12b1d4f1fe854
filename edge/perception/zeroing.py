"""Stages that know a sensor's rest level: its baseline, taken or stored, and its drift; and whether to believe it.

A flat grip moves all taxels together, and so does a pad that has warmed, or is another one than was zeroed. What tells
is how it began. A touch is quick, and begins from a rest level that was seen in this run; or it is local, and leaves
half of the pad at rest. All else over a threshold is in doubt.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.perception.event import Note, Report
from edge.perception.result import Step, age_text
from edge.perception.run_options import RuntimeOptions
from edge.perception.taps import TapTracker
from edge.perception.taxel_health import Health
from firmware_bridge.errors import BaselineRefusedError
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import FEWEST_SCANS, Baseline, BaselineEstimator, Origin, deformation
from firmware_bridge.zeroing.drift_tracker import Drift, DriftTracker

GIVE_UP_NS: Final = 15_000_000_000  # longest zeroing on demand: ten tries at 100 Hz, and four at 30 Hz


class Demand(NamedTuple):
    """Zeroing on demand, which goes on until a time in [ns]; forced, it zeroes a load away."""

    force: bool
    old: Baseline | None
    end_ns: int | None = None
    why: str = f"fewer than {FEWEST_SCANS} whole scans"


class Zeroing:
    """Stage: puts the newest readings over the baseline, takes a new one where it is due, and lets it follow drift."""

    def __init__(
        self,
        taps: TapTracker,
        health: Health,
        mounting: Mounting | None,
        report: Report,
        unix_time_s: Callable[[], float],
        notes: tuple[Note, ...] = (),
    ) -> None:
        self.baseline: Baseline | None = None  # with the drift that was followed
        self._taps, self._health, self._mounting = taps, health, mounting
        self._report, self._unix_time_s = report, unix_time_s
        self.notes = notes  # why there is no baseline yet, and how a zeroing on demand stands
        self._drift: Drift | None = None
        self.drift_notes: tuple[Note, ...] = ()
        self._estimator = BaselineEstimator(clock=unix_time_s)
        self._demand: Demand | None = None
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
        if self.baseline is None or self._demand is not None:
            new = self._take(step.scan)
        if new is not None:
            self.use(new, 0.0, step.scan.time_ns)
            self.notes = ()
            step.zeroed = deformation(self._health.held, new, self._mounting)
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
        if not tracker.push(step.scan, step.doubted or bool(step.contact), self._health.dead):
            return
        self.baseline = taken.moved(tracker.counts)
        self._drift, note = tracker.summary, tracker.note
        self.drift_notes = () if note is None else (Note("rest_level", note),)
        event = tracker.take_event()
        if event is not None:
            self._report("rest_level", event)

    def zero_again(self, *, force: bool, doubted: bool) -> None:
        """Take a new baseline from the next scans, forced also in contact; the old one stays in use until then."""
        if self.baseline is None:
            self._report("zeroing")
        elif self._taps.contact and not force:
            self._report("in_contact")
        else:
            # A baseline in doubt says nothing of a load.
            self._demand = Demand(force, None if force or doubted else self.baseline)
            self._begin()
            self.notes = (Note("zeroing", "zeroing: keep the pad still and free"),)

    def lose_touch(self) -> None:
        """Compare the rest level with the earlier one before drift is followed again; a zeroing that goes on ends."""
        if self._tracker is not None:
            self._tracker.forget()
        if self._demand is not None:
            self._give_up("the sensor was away; request it again")
        self._begin()

    def _begin(self) -> None:
        old = None if self._demand is None else self._demand.old
        self._estimator = BaselineEstimator(reference=old, clock=self._unix_time_s)

    def _give_up(self, why: str) -> None:
        self._demand, self.notes = None, ()
        self._report("given_up", why)

    def _take(self, scan: Scan) -> Baseline | None:
        """Use the scan for a new baseline; a refusal, also by a tap that goes on, starts it over."""
        demand = self._demand
        if demand is not None and demand.end_ns is None:
            self._demand = demand = demand._replace(end_ns=scan.time_ns + GIVE_UP_NS)
        if demand is not None and demand.end_ns is not None and scan.time_ns >= demand.end_ns:
            self._give_up(f"{demand.why}; tried for {GIVE_UP_NS / 1e9:.0f} s")
            return None
        silent = self._health.silent_long
        try:
            if demand is not None and self._taps.contact and not demand.force:
                self._begin()
                raise BaselineRefusedError("the pad is in contact: free it")
            new = self._estimator.push(scan, silent if 2 * np.count_nonzero(silent) < silent.size else None)
        except BaselineRefusedError as refusal:
            self.notes = (Note("zeroing_restarted", f"zeroing started over: {refusal}"),)
            self._demand = None if demand is None else demand._replace(why=str(refusal))
            return None
        if new is None or demand is None:
            return new
        self._demand = None
        self._report("zeroed", f"baseline {new.id}" + ("" if self._taken is None else f" instead of {self._taken.id}"))
        self._taps.reset()  # earlier taps were zeroed with another rest level
        return replace(new, origin="demand")


Doubt = Literal["unseen", "outage", "held", "below", "slow", "alike", "left"]  # why readings are no contact
# Largest reading of a taxel at rest, on any axis: more than a pad turned over in the earth's field (36) and the first
# recovery after a grip (45), and less than the change of any public recording's rest level in four hours (64 to 715).
NEAR_COUNTS: Final = 50.0
SEEN_SHARE: Final = 0.75  # share of the taxels at rest by which the pad is seen at rest
LOCAL_SHARE: Final = 0.5  # share of the taxels at rest beside which the others are touched
_TEXTS: Final[dict[Doubt, str]] = {
    "unseen": "most taxels are off it together, by {counts}, and the pad was not seen at rest near it in this run",
    "outage": "after an outage most taxels are off it together, by {counts}: is this another pad?",
    "held": "taken from this recording, whose readings hardly change: the pad is free, or holds something all the time",
    "below": "far below the baseline on all taxels, by {counts}: it was taken while something pressed, or is old",
    "slow": "all taxels rose slowly together, by {counts}, as drift does",
    "alike": "all taxels changed alike by {counts}, as in a field or by warming, and as no touch does",
    "left": "all taxels stay off by {counts} after a release, as a pad does that has warmed or recovers",
}


class BaselineDoubt:
    """Stage: decides whether a step's readings may be a touch, and reports when a doubt begins, changes and ends."""

    def __init__(self, options: RuntimeOptions, taxels: int, report: Report) -> None:
        self._report = report
        self.reported: Doubt | None = None
        self.notes: tuple[Note, ...] = ()
        self._on, self._off = options.contact_on_counts, options.contact_off_counts
        # Drift explains a rise of 40 counts/s a taxel: twice the fastest on record. A release leaves up to 150 a taxel:
        # warming by 3 K gives 120.
        self._drift_per_ns = 40.0 * taxels / 1e9
        self._left = 150.0 * taxels
        self.counts = (0.0, 0.0, 0.0)  # medians of all taxels on x, y, z when the doubt began
        self.begin("file")

    def begin(self, origin: Origin) -> None:
        """Begin with a baseline of an origin: of a file, or taken from these very scans."""
        seen = origin != "file"
        self.doubt: Doubt | None = None
        self._held = origin == "unsure"
        self._seen = seen
        self._unseen: Doubt = "unseen"
        self._touched = seen  # until it was low once, nothing is known of how a contact began
        self._before: NDArray[np.float32] | None = None
        self._newest: NDArray[np.float32] | None = None
        self._level = self._peak = self._still_counts = 0.0
        self._newest_ns = self._still_ns = 0

    def lose_touch(self) -> None:
        """Forget how a contact began, and that the pad was seen: after an outage it may be another one."""
        if self._seen:
            self._before, self._newest = self._newest, None
            self._seen, self._unseen = False, "outage"
        self._touched = self._seen

    def __call__(self, step: Step) -> None:
        """Mark the step where its readings are in doubt."""
        if step.readings is None or step.force_counts is None:
            return
        doubt = self._weigh(step.readings, step.force_counts, step.scan.time_ns)
        step.doubted = doubt is not None
        if doubt is self.reported:
            return
        self.reported = doubt
        if doubt is None:
            self._report("baseline_cleared", "")
        else:
            why = _TEXTS[doubt].format(counts="x {:+.0f}, y {:+.0f}, z {:+.0f} counts".format(*self.counts))
            age = age_text(step.baseline_age_s)
            text = f"baseline in doubt: {why} (baseline {age}); free the pad and zero again"
            self.notes = (Note("baseline_in_doubt", text),)
            self._report("baseline_doubted", text)

    def _weigh(self, zeroed: NDArray[np.float32], z_counts: float, time_ns: int) -> Doubt | None:
        """Return why readings (3, rows, cols) over the baseline, with their summed z, are in doubt."""
        self._newest = zeroed
        if self._held:
            return "held"
        if self._seen and -self._off < z_counts < self._off:
            self._newest_ns, self._level, self._peak = time_ns, 0.0, 0.0
            self._touched, self.doubt = False, None
            return None
        near = np.maximum.reduce(np.abs(zeroed)) <= NEAR_COUNTS
        at_rest = np.count_nonzero(near) / near.size
        if at_rest >= SEEN_SHARE:
            self._seen, self._peak, self._level = True, 0.0, 0.0
        elif not self._seen:
            self._seen = self._goes_on(zeroed)
        before, self.doubt = self.doubt, None
        if z_counts <= -self._off and float(np.median(zeroed[2])) < -NEAR_COUNTS:
            self.doubt, self._seen, self._touched = "below", False, False
        elif at_rest >= LOCAL_SHARE and z_counts >= self._on:
            self._touched = True
        elif not self._seen:
            self.doubt = None if self._touched else self._unseen
        elif at_rest < LOCAL_SHARE:
            self.doubt = self._explanation(zeroed, z_counts, time_ns, before)
        if self.doubt is not None and before is None:
            x, y, z = np.median(zeroed.reshape(3, -1), axis=1).tolist()
            self.counts = (x, y, z)
        if z_counts < self._off:
            self._touched = False
        self._peak = max(self._peak, z_counts)
        self._newest_ns = time_ns
        return self.doubt

    def _goes_on(self, zeroed: NDArray[np.float32]) -> bool:
        """Return whether the readings are those from before an outage, once."""
        before, self._before = self._before, None
        if before is None:
            return False
        far = np.abs(zeroed - before) > NEAR_COUNTS + 0.1 * np.abs(before)  # as a grip changes that has gone on
        self._touched = np.count_nonzero(far.any(axis=0)) <= (1 - SEEN_SHARE) * far[0].size
        return self._touched

    def _explanation(
        self, zeroed: NDArray[np.float32], z_counts: float, time_ns: int, before: Doubt | None
    ) -> Doubt | None:
        """Return what explains readings of most taxels over a baseline that was seen as well as a touch."""
        if not self._touched:
            rise = self._drift_per_ns * max(time_ns - self._newest_ns, 0)
            self._level = min(z_counts, self._level + rise)
            if z_counts < self._on and before is None:
                return None
            if z_counts < 2 * self._level:
                return "slow"
            if self._alike(zeroed):
                return "alike"
            self._touched = True
        if abs(z_counts - self._still_counts) > 100:
            self._still_counts, self._still_ns = z_counts, time_ns
        slack = 1.2 if before == "left" else 1.0
        left = z_counts < slack * min(self._left, 0.5 * self._peak)
        still = before == "left" or time_ns - self._still_ns >= 100_000_000
        return "left" if left and still else None

    @staticmethod
    def _alike(zeroed: NDArray[np.float32]) -> bool:
        flat = zeroed.reshape(3, -1)
        common = np.median(flat, axis=1, keepdims=True)
        # In real flat grips taxels differ by 0.55 of the median and more, in simulated presses by more than all of it.
        return bool((np.abs(flat - common) <= 10 + 0.3 * np.abs(common)).all())
