"""Scan in, result out: the stages of each sensor in their order, and one call of the model for all that wait."""

import time
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.errors import UsageError, WindowError
from edge.inference.contract import Model
from edge.inference.intervals import doubt
from edge.perception.event import OLD_NS, UNCHECKED, Event, EventKind, age_notes, notes_on_missing
from edge.perception.gain_learning import ContactModel, Learn
from edge.perception.pattern_description import Describe
from edge.perception.result import Estimate, LastPattern, Result, Step, Window
from edge.perception.run_options import DEFAULTS, RuntimeOptions
from edge.perception.taps import Taps, TapTracker
from edge.perception.taxel_health import Health
from edge.perception.trust_check import PatternCheck, SensorPad
from edge.perception.zeroing import BaselineDoubt, Zeroing
from edge.validation import check_baselines, check_counts_per_newton, check_kind, check_mountings, check_pads
from firmware_bridge.links.base import SourceKind
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.poses import PadPose, PoseTrack
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import TAPS_FORGOTTEN_NS
from firmware_bridge.zeroing.baseline import Baseline

MOST_TOGETHER: Final = 4  # sensors whose patterns are made in one call: scans that come meanwhile wait for its end


class Sensor:
    """Stages of one sensor, made complete once with what is stored for it."""

    def __init__(self, name: str, time_ns: int, runtime: "Runtime") -> None:
        """Begin with the first scan of a runtime's sensor, at a time in [ns]."""
        contract, geometry, options, trust = runtime.model.contract, runtime.geometry, runtime.options, runtime.trust
        mounting, baseline = runtime.mountings.get(name), runtime.baselines.get(name)
        mounting = mounting if mounting is not None and mounting.turns_axes else None
        pad = _of(name, runtime.pad)
        self.events: list[Callable[[int], Event]] = []  # at the time of the next scan
        self.last: LastPattern | None = None  # used again while nothing changes
        self.pad = SensorPad(
            contract, trust, pad, _of(name, runtime.counts_per_newton), runtime.scale_intervals.get(name)
        )
        check = None if trust is None else PatternCheck(trust, contract, self.pad, self.report)
        self._name = name
        self._received_ns: int | None = None
        self._check, self._options = check, options
        self.tracker = TapTracker(contract.taps, options)
        self._health = Health((geometry.rows, geometry.cols), mounting, runtime.estimator)
        notes = notes_on_missing(name, runtime.mountings, runtime.baselines)
        self._zeroing = Zeroing(self.tracker, self._health, mounting, self.report, runtime.unix_time_s, notes)
        self._doubt = BaselineDoubt(options, geometry.taxel_count, self.report)
        self._taps = Taps(self.tracker, self._health, contract, options, self.report)
        self._describe = Describe(contract, geometry, self.pad)
        self.learn: Learn | None = None
        if runtime.contacts is not None and options.learn:
            measured = pad if runtime.measured is None else runtime.measured.get(name)
            self.learn = Learn(runtime.contacts, measured, self.pad, check, self.report)
        if baseline is not None:
            age_s = baseline.age_s(runtime.unix_time_s())
            # A baseline from the future means that one of the two clocks was wrong.
            self._zeroing.use(baseline, age_s if age_s >= 0 else None, time_ns)
            self._doubt.begin(baseline.origin)

    def follow(self, step: Step, track: PoseTrack | None, events: list[Callable[[int], Event]]) -> None:
        """Pass the step of the next scan, which takes the events of all, through the stages before the model."""
        scan = step.scan
        if self._received_ns is not None and scan.time_ns - self._received_ns > TAPS_FORGOTTEN_NS:
            self.lose_touch()
        self._received_ns = scan.time_ns
        if self._health(step, self._zeroing.baseline):
            # Earlier taps hold what a taxel read before it was found dead, or estimates that no note would report.
            self.tracker.reset()
        if (zeroed := self._zeroing(step)) is not None:
            self._doubt.begin(zeroed.origin)
        self._health.fill(step)
        step.notes = (*step.notes, *self._zeroing.notes, *self._zeroing.drift_notes)
        if scan.time_ns - scan.not_before_ns > OLD_NS:
            step.notes = (*step.notes, *age_notes(scan))
        if events or self.events:
            step.events = tuple(event(scan.time_ns) for event in (*events, *self.events))
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
        if not step.contact and self.learn is not None and self.learn.waiting and self.learn.learn(self._health.dead):
            self.last = None  # it was made with other gains
        if step.doubted:
            step.notes = (*step.notes, *self._doubt.notes)
        elif step.contact and self._check is None:
            step.notes = (*step.notes, UNCHECKED)
        step.gains_certainty, step.scale_error = self.pad.gains_certainty, self.pad.scale_error
        per_newton = self.pad.counts_per_newton
        if per_newton is not None and step.force_counts is not None:
            step.force_n = step.force_counts / per_newton
        elif scan.vendor_force_n is not None:
            step.force_n = scan.vendor_force_n[2]

    def begin(self, step: Step, due: Window) -> tuple[Estimate, NDArray[np.float32]]:
        """Return an estimate of the taps of a window that belong together, and the model's input for it."""
        scaled = due.counts / self.pad.counts_per_unit
        if due.poses is None:
            scaled[due.taps :] = 0
            return Estimate(due.taps, due.counts[: due.taps], None), scaled
        taps, belonging, dropped = list(range(due.taps)), None, None
        if due.taps > 1 and self._check is not None and not step.doubted:
            taps, belonging = self._check.taps_of_contact(self.tracker, due, scaled, posed=step.pose is not None)
            dropped = due.taps - len(taps)
        return Estimate(len(taps), due.counts[taps], due.poses[taps], belonging, dropped), scaled[taps]

    def finish(self, step: Step, due: Window, made: Estimate, newest: NDArray[np.float32]) -> None:
        """Pass a step through the stages after the model; the newest readings (3, rows, cols) are in network units."""
        step.estimate = made
        self.last = None if self._options.every_scan else LastPattern(made, step.scan.number, due)
        if step.doubted:  # nothing follows from it, and nothing is learned
            made.traction = None
            return
        if made.deviation is not None and step.dead:
            made.deviation = made.deviation * self._health.widening
        about = None if made.pattern is None or made.deviation is None else doubt(made.pattern, made.deviation)
        if self._check is not None and made.pattern is not None:
            made.trusted, made.untrusted_reason, made.mismatch = self._check.judge(
                due.tap, newest, made.pattern, about[0] if about else None, made.traction, self._health.most_repeats
            )
        self._describe(made, due.tap, newest, about)
        self._taps.see(due.tap, step.force_counts or 0.0, None if made.trusted is False else step.pose, made.taps_used)
        if self.learn is not None:
            self.learn(step, made, due.counts[0])

    def zero_again(self, *, force: bool) -> None:
        """Take a new baseline from the next scans, with an event for the outcome; `force` also in contact."""
        self._zeroing.zero_again(force=force, doubted=self._doubt.reported is not None)

    def lose_touch(self) -> None:
        """Forget earlier readings and taps, since no scan of the sensor arrived for a time."""
        self.tracker.reset()
        self.last = None
        self._health.forget()
        self._doubt.lose_touch()
        self._zeroing.lose_touch()

    def report(self, kind: EventKind, detail: str = "") -> None:
        """Report an event with the sensor's next scan."""
        self.events.append(partial(Event, kind=kind, sensor=self._name, detail=detail))


def _of(name: str, setting: Any) -> Any:
    return setting.get(name) if isinstance(setting, Mapping) else setting


@dataclass(eq=False, repr=False)
class Runtime:
    """Maker of one result per scan; `open_runtime` makes one, and describes the settings that have no comment here.

    Raises a ModelError where the model is for another sensor, and a UsageError where a setting is out of range, of
    another grid, or asks for more taps than the model takes.
    """

    model: Model
    _: KW_ONLY
    source: SourceKind
    estimator: NDArray[np.float64] | None = None  # of dead taxels; without it they allow no pattern
    contacts: ContactModel | None = None  # by which gains are learned, if the options ask for that
    geometry: SensorGeometry = USPA44
    baselines: Mapping[str, Baseline] = field(default_factory=dict)
    counts_per_newton: float | Mapping[str, float] | None = None
    mountings: Mapping[str, Mounting] = field(default_factory=dict)  # by name; without one the axes are as wired
    pad: Pad | Mapping[str, Pad] | None = None
    measured: Mapping[str, Pad] | None = None  # by name, without what was learned; None for `pad`
    scale_intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # 90 %, of counts per newton
    options: RuntimeOptions = DEFAULTS
    clock_ns: Callable[[], int] = time.perf_counter_ns
    # Dates baselines, and tells how old a stored one is at the first scan; from then on ages follow scan time.
    unix_time_s: Callable[[], float] = time.time

    def __post_init__(self) -> None:
        contract, options, geometry = self.model.contract, self.options, self.geometry
        contract.check_sensor(geometry)
        check_baselines(self.baselines, geometry)
        check_counts_per_newton(self.counts_per_newton)
        check_pads(self.pad, geometry)
        check_pads(self.measured, geometry)
        check_mountings(self.mountings, geometry)
        if options.taps is not None and options.taps > contract.taps:
            raise UsageError(f"taps is {options.taps}, but model '{self.model.name}' takes {contract.taps} at most")
        self.baselines, self.mountings = dict(self.baselines), dict(self.mountings)
        self.trust = contract.read_trust()
        self.unposed = None if contract.takes_poses else self.model.name  # for a user who states poses all the same
        # A newer scan keeps the place of the one it overtakes: the sensor that has waited longest is the first.
        self.waiting: dict[str, tuple[Sensor, Step, Window]] = {}
        self._sensors: dict[str, Sensor] = {}
        self._events: list[Callable[[int], Event]] = []
        self._tracks: dict[str | None, PoseTrack] = {}
        self._scan_shape = geometry.scan_shape

    @property
    def expected(self) -> frozenset[str]:
        """Names of the sensors with stored baselines or counts per newton."""
        per_newton = self.counts_per_newton
        return frozenset({*self.baselines, *(per_newton if isinstance(per_newton, Mapping) else ())})

    def take_learned(self) -> dict[str, Pad]:
        """Return the pads with gains learned since the last call, by sensor name."""
        learned = {name: sensor.learn.take_learned() for name, sensor in self._sensors.items() if sensor.learn}
        return {name: pad for name, pad in learned.items() if pad is not None}

    def reset(self) -> None:
        """Forget the taps of every sensor, as for a new object, and report it as an event; zeroing stays."""
        for sensor in self._sensors.values():
            sensor.tracker.reset()
        self._events.append(partial(Event, kind="reset", sensor=None))

    def zero(self, name: str | None = None, *, force: bool = False) -> None:
        """Zero a sensor or all from the next scans, also in contact if forced; an event reports the outcome."""
        chosen = list(self._sensors) if name is None else [name] if name in self._sensors else []
        for sensor in chosen:
            self._sensors[sensor].zero_again(force=force)
        if not chosen:
            sensors = ", ".join(sorted(self._sensors))
            why = f"no sensor {name}, there are {sensors}" if sensors else "no scan has arrived yet"
            self._events.append(partial(Event, kind="refused", sensor=None, detail=f"zeroing refused: {why}"))

    def pose(self, pose: PadPose, time_ns: int, sensor: str | None = None, *, holds: bool = False) -> bool:
        """Take a pose of a pad at a monotonic time in [ns]; False unless it is later than the one before.

        Without a sensor it is of every sensor without poses of its own; a pose that holds is one until the next.
        """
        check_kind("pose", pose, "away_mm", "a PadPose")
        return self._tracks.setdefault(sensor, PoseTrack()).add(time_ns, pose, holds=holds)

    def lose_touch(self, sensors: str = "") -> None:
        """Forget readings and taps of sensors whose names begin so, after their link broke; zeroing stays."""
        for name, sensor in self._sensors.items():
            if name.startswith(sensors):
                sensor.lose_touch()

    def push(self, scan: Scan, *, infer: bool = True) -> Result:
        """Make the result of one scan, inferred at once if it is in contact and `infer` is true; raises as `infer`."""
        ready = self.take(scan)
        if scan.sensor not in self.waiting:
            return ready[-1]
        if infer:
            return self.infer(only=scan.sensor)[0]
        _, step, _ = self.waiting.pop(scan.sensor)
        step.overtake()
        return step.freeze()

    def take(self, scan: Scan, clock_ns: Callable[[], int] | None = None) -> list[Result]:
        """Take a scan and return the results that are ready, or raise a WindowError where it is of another geometry.

        A scan that needs a pattern waits for `infer`. If the next one of its sensor comes first, its result is ready
        without a pattern, and the newer scan takes its place. Results state their latency by the clock of the scans.
        """
        name = scan.sensor
        if scan.counts.shape != self._scan_shape:
            raise WindowError(f"scan has shape {scan.counts.shape}, expected {self._scan_shape}")
        sensor = self._sensors.get(name)
        if sensor is None:
            sensor = self._sensors[name] = Sensor(name, scan.time_ns, self)
        step = Step(scan, self.source, self.model.name, self.model.contract.output_unit)
        # Without a pose of any pad, which is the rule, this is all that poses cost.
        track = (self._tracks.get(name) or self._tracks.get(None) or None) if self._tracks else None
        sensor.follow(step, track, self._events)
        ready: list[Result] = []
        overtaken = self.waiting.get(name) if self.waiting else None
        if overtaken is not None:
            overtaken[1].overtake()
            ready.append(overtaken[1].freeze())
        if step.due is not None and not (sensor.last and sensor.last.reuse(step, step.due)):
            self.waiting[name] = sensor, step, step.due
            return ready
        if overtaken is not None:
            del self.waiting[name]
        ready.append(step.freeze(clock_ns() if step.estimate is not None and clock_ns is not None else None))
        return ready

    def infer(self, clock_ns: Callable[[], int] | None = None, *, only: str | None = None) -> list[Result]:
        """Infer the patterns of the sensors that have waited longest, MOST_TOGETHER in one call, or of one alone.

        Raises a ModelError where the model gave what is not finite, or a deviation that is not above zero.
        """
        due = list(map(self.waiting.pop, list(self.waiting)[:MOST_TOGETHER] if only is None else [only]))
        if not due:
            return []
        model, start_ns = self.model, self.clock_ns()
        begun: list[Estimate] = []
        inputs: list[NDArray[np.float32]] = []
        pads: list[NDArray[np.float32]] = []
        poses: list[NDArray[np.float32]] = []
        for sensor, step, window in due:
            made, given = sensor.begin(step, window)
            begun.append(made)
            inputs.append(given)
            pads.append(sensor.pad.row)
            if made.poses is not None:
                poses.append(made.poses)
        patterns = model.run_together(inputs, pads, *([poses] if poses else []))
        run_time_us = (self.clock_ns() - start_ns) / 1e3
        for row, ((sensor, step, window), made) in enumerate(zip(due, begun, strict=True)):
            made.pattern, step.run_time_us = patterns[row], run_time_us
            made.deviation = None if model.deviation is None else model.deviation[row]
            made.traction = None if model.traction is None else model.traction[row]
            sensor.finish(step, window, made, inputs[row][0])
        done_ns = None if clock_ns is None else clock_ns()
        return [step.freeze(done_ns) for _, step, _ in due]
