"""One sensor between its scans: the stages that every scan passes, made complete once."""

import math
from collections.abc import Callable, Hashable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from edge.inference.trust import Trust
from edge.perception.baseline_doubt import BaselineDoubt
from edge.perception.contact_options import RuntimeOptions
from edge.perception.dead_taxel_fill import TaxelEstimator
from edge.perception.event import OLD_NS, UNCHECKED, EventKind, Note, Untimed, age_notes
from edge.perception.gain_following import Learn, SensorPad
from edge.perception.gain_learning import ContactModel
from edge.perception.pattern_check import Check, PatternCheck
from edge.perception.pattern_description import Describe
from edge.perception.result import Estimate, Step, Window
from edge.perception.tap_tracker import TapTracker
from edge.perception.taps import Taps
from edge.perception.taxel_health import Health, TaxelWatch
from edge.perception.zeroing import Zeroing
from firmware_bridge.pad_geometry import SensorGeometry
from firmware_bridge.poses import PoseTrack
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.schedule import TAPS_FORGOTTEN_NS
from firmware_bridge.zeroing.baseline import Baseline

NOISE_COUNTS: Final = 2.0  # standard deviation of a reading at rest: 1.7 to 2.6 in recordings
_CHANGE_COUNTS: Final = math.sqrt(2) * NOISE_COUNTS  # the same of a change, since noise is in both scans
MOVED: Final = np.array([0.05, 0.05, 0.25, 0.05, 0.25], dtype=np.float32)
"""Change of a relative pose, in [mm] and [deg] as model input has them: a quarter of the usual errors."""


class LastPattern:
    """Estimate of a sensor's last pattern, and what it was made from; allocates no array after construction.

    Attributes:
        estimate: None before the first, and where it must not be used again.
    """

    def __init__(self, scan_shape: tuple[int, int, int]) -> None:
        self.estimate: Estimate | None = None
        self._scan_number = -1
        self._counts = np.zeros(scan_shape, dtype=np.float32)
        self._change = np.zeros(scan_shape, dtype=np.float32)
        self._made_by: Hashable = None
        self._poses: NDArray[np.float32] | None = None

    def reuse(self, step: Step, due: Window) -> bool:
        """Give a step the estimate if readings and poses have not changed beyond noise since; return whether it has it.

        Nor must the maker have changed, which is what distinguishes the pattern from others.
        """
        if self.estimate is None or due.made_by != self._made_by:
            return False
        poses = due.poses
        if poses is not None and (
            self._poses is None or poses.shape != self._poses.shape or (np.abs(poses - self._poses) > MOVED).any()
        ):
            return False
        np.subtract(due.counts[0], self._counts, out=self._change)
        np.abs(self._change, out=self._change)
        # Noise reaches neither five of its deviations in one reading, nor 1.4 of them in the RMS of all.
        if np.maximum.reduce(self._change, axis=None) > 5 * _CHANGE_COUNTS:
            return False
        if float(np.vdot(self._change, self._change)) > (1.4 * _CHANGE_COUNTS) ** 2 * self._change.size:
            return False
        step.estimate, step.reused_from = self.estimate, self._scan_number
        return True

    def keep(self, step: Step, due: Window, made: Estimate) -> None:
        """Keep the estimate of a step's pattern."""
        self.estimate, self._scan_number = made, step.scan.number
        self._counts[...] = due.counts[0]
        self._poses, self._made_by = due.poses, due.made_by


class Sensor:
    """Stages of one sensor, in their order: `follow` before the model, `finish` after it."""

    def __init__(
        self,
        name: str,
        time_ns: int,
        *,
        contract: Contract,
        trust: Trust | None,
        geometry: SensorGeometry,
        options: RuntimeOptions,
        estimator: TaxelEstimator | None,
        contacts: ContactModel | None,
        unix_time_s: Callable[[], float],
        mounting: Mounting | None,
        baseline: Baseline | None,
        counts_per_newton: float | None,
        pad: Pad | None,
        measured: Pad | None,
        notes: tuple[Note, ...],
    ) -> None:
        """Begin with the sensor's first scan, at a time in [ns]; `measured` is its pad without what was learned."""
        grid_shape = (geometry.rows, geometry.cols)
        self.events: list[Untimed] = []
        self._name, self._contract, self._options = name, contract, options
        self._received_ns: int | None = None
        self._watch = TaxelWatch(grid_shape, mounting)
        self._tracker = TapTracker(contract.taps, options, grid_shape)
        check = None if trust is None else PatternCheck(trust, contract)
        self._checked = check is not None
        self.pad = SensorPad(contract, pad, counts_per_newton, check)
        self._health = Health(self._watch, estimator)
        self._zeroing = Zeroing(self._tracker, self._watch, mounting, self.report, unix_time_s, notes)
        self._doubt = BaselineDoubt(options, geometry.taxel_count, self.report)
        self._taps = Taps(self._tracker, self._watch, contract, options, self.report)
        self._check = Check(check, self._tracker, self._watch, self.report)
        self._describe = Describe(contract, trust, geometry, self.pad)
        self._last = LastPattern(geometry.scan_shape)
        self._learn = None if contacts is None else Learn(contacts, measured, pad, self.pad, check, self.report)
        if baseline is not None:
            age_s = baseline.age_s(unix_time_s())
            # A baseline from the future means that one of the two clocks was wrong.
            self._zeroing.use(baseline, age_s if age_s >= 0 else None, time_ns)
            self._doubt.begin(baseline.origin)

    def follow(self, step: Step, track: PoseTrack | None, events: list[Untimed]) -> None:
        """Pass the step of the sensor's next scan through the stages before the model; a window is due then, or none.

        It takes the events of all sensors with those of its own; `track` has the poses of its pad, None without.
        """
        scan = step.scan
        if self._received_ns is not None and scan.time_ns - self._received_ns > TAPS_FORGOTTEN_NS:
            self.lose_touch()
        self._received_ns = scan.time_ns
        if self._health(step, self._zeroing.baseline):
            # Earlier taps hold what a taxel read before it was found dead, or estimates that no note would report.
            self._tracker.reset()
        if (zeroed := self._zeroing(step)) is not None:
            self._doubt.begin(zeroed.origin)
        self._health.fill(step)
        step.notes = (*step.notes, *self._zeroing.notes, *self._zeroing.drift_notes)
        if scan.time_ns - scan.not_before_ns > OLD_NS:
            step.notes = (*step.notes, *age_notes(scan))
        if events or self.events:
            step.events = tuple(event.at(scan.time_ns) for event in (*events, *self.events))
            events.clear()
            self.events.clear()
        if step.zeroed is None:
            return
        if track is not None:
            step.pose = track.at(scan.on_bus_ns)
        if step.readings is None:
            step.state = "incomplete"
            return
        self._doubt(step)
        self._taps(step, track)
        if self._options.follow_drift:
            self._zeroing.follow_drift(step)
        if not step.contact and self._learn is not None and self._learn.waiting and self._learn.learn(self._watch.dead):
            self._last.estimate = None
        if step.doubted:
            step.notes = (*step.notes, *self._doubt.notes)
        elif step.contact and not self._checked:
            step.notes = (*step.notes, UNCHECKED)
        step.gains_certainty = self.pad.gains_certainty
        per_newton = self.pad.counts_per_newton
        if per_newton is not None and step.force_counts is not None:
            step.force_n = step.force_counts / per_newton
        elif scan.vendor_force_n is not None:
            step.force_n = scan.vendor_force_n[2]

    def reuse(self, step: Step, due: Window) -> bool:
        """Give a step the sensor's last pattern if nothing has changed since; return whether it has it."""
        return not self._options.every_scan and self._last.reuse(step, due)

    def begin(self, step: Step, due: Window) -> tuple[Estimate, NDArray[np.float32]]:
        """Return an estimate of the taps of a window that belong together, and the model's input for its pattern."""
        scaled = self._contract.scale_window(due.counts, self.pad.gains)
        taps, belonging = self._check.belonging(step, due, scaled)
        poses = None if due.poses is None else due.poses[taps]
        dropped = None if belonging is None else due.taps - len(taps)
        made = Estimate(len(taps), due.counts[taps], poses, belonging, dropped)
        if poses is not None:
            return made, scaled[taps]
        scaled[len(taps) :] = 0
        return made, scaled

    def finish(self, step: Step, due: Window, made: Estimate, newest: NDArray[np.float32]) -> None:
        """Pass a step through the stages after the model; the newest readings (3, rows, cols) are in network units."""
        step.estimate = made
        self._last.keep(step, due, made)
        if step.doubted:  # nothing follows from it, and nothing is learned
            made.traction = None
            return
        self._check(step, made, due.tap, newest)
        self._describe(made, due.tap, newest)
        if self._taps.advice is not None:
            self._taps.advice.see(step, due.tap)
        if self._learn is not None and self._learn(step, made, due.counts[0], self._watch.dead):
            self._last.estimate = None  # it was made with other gains

    def zero_again(self, *, force: bool) -> None:
        """Take a new baseline from the next scans, with an event for the outcome; `force` also in contact."""
        self._zeroing.zero_again(force=force, doubted=self._doubt.reported is not None)

    def reset_taps(self) -> None:
        """Forget the taps, as for a new object."""
        self._tracker.reset()

    def lose_touch(self, *, same_pad: bool = False) -> None:
        """Forget earlier readings and taps, since no scan of the sensor arrived for a time.

        Drift is followed again once the pad has been at rest and its rest level has been compared with the earlier one;
        a contact is believed again once the pad was seen at rest, unless it is the `same_pad` for sure.
        """
        self._tracker.reset()
        self._last.estimate = None
        self._watch.forget()
        self._doubt.lose_touch(same_pad=same_pad)
        self._zeroing.lose_touch()

    def take_learned(self) -> Pad | None:
        """Return the pad if its gains were learned since the last call."""
        return None if self._learn is None else self._learn.take_learned()

    def report(self, kind: EventKind, detail: str = "") -> None:
        """Report an event with the sensor's next scan."""
        self.events.append(Untimed(kind, self._name, detail))
