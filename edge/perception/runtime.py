"""Scan in, result out: all state between scans is kept here, per sensor."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from edge.errors import UsageError, WindowError
from edge.inference.model_interface import Model
from edge.perception.contact_options import DEFAULTS, RuntimeOptions
from edge.perception.dead_taxel_fill import TaxelEstimator
from edge.perception.event import EventKind, Untimed, notes_on_missing
from edge.perception.gain_learning import ContactModel
from edge.perception.result import Result
from edge.perception.sensor import Common, Sensor, Settings
from edge.perception.step import Origin, Step
from edge.validation import check_baselines, check_counts_per_newton, check_mountings, check_pads
from firmware_bridge.links.base import SourceKind
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.poses.pad_pose import PadPose
from firmware_bridge.poses.pose_track import PoseTrack
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import Baseline

_SMOOTHING: Final = 0.1
"""Share of the newest call in the time that a pattern is expected to take."""


class Runtime:
    """Maker of one result per scan.

    Args:
        model: the loaded model.
        source: kind of source that the scans come from; every result carries it.
        estimator: of dead taxels, on the same grid; without it there is no pattern while a taxel is dead.
        contacts: distribution of contacts by which gains are learned, if the options ask for that; without it none are.
        geometry: of the sensors; refused if the model was not trained for it.
        baselines: stored baselines by sensor name; a sensor without one is zeroed from its first
            scans, during which its pad must be still and free.
        counts_per_newton: summed z per [N], of all sensors or by name; without it a force in newtons is the vendor's,
            if the scan has one.
        mountings: directions of a sensor's axes, and its gains, by name; without one the axes are as wired.
        pad: properties of the pad of all sensors, or of each by name, for models that use them. Counts per newton that
            it lacks are those above.
        measured: pads without what was learned, by name, from which learning begins; None for `pad`.
        options: thresholds of taps, and which computations may be omitted.
        clock_ns: measures run time.
        unix_time_s: dates baselines that are taken, and gives the age of a stored one at the first scan of its sensor;
            from then on ages follow scan time.

    Raises:
        ModelError: the model is for another sensor.
        UsageError: counts per newton, a pad or a number of taps are out of range, or a baseline or a mounting is of
            another grid; the options ask for more taps than the model takes.
    """

    def __init__(
        self,
        model: Model,
        *,
        source: SourceKind,
        estimator: TaxelEstimator | None = None,
        contacts: ContactModel | None = None,
        geometry: SensorGeometry = USPA44,
        baselines: Mapping[str, Baseline] | None = None,
        counts_per_newton: float | Mapping[str, float] | None = None,
        mountings: Mapping[str, Mounting] | None = None,
        pad: Pad | Mapping[str, Pad] | None = None,
        measured: Mapping[str, Pad] | None = None,
        options: RuntimeOptions = DEFAULTS,
        clock_ns: Callable[[], int] = time.perf_counter_ns,
        unix_time_s: Callable[[], float] = time.time,
    ) -> None:
        model.contract.check_sensor(geometry)
        check_baselines(baselines or {}, geometry)
        check_counts_per_newton(counts_per_newton)
        check_pads(pad, geometry)
        check_pads(measured, geometry)
        check_mountings(mountings or {}, geometry)
        contract = model.contract
        if options.taps is not None and options.taps > contract.taps:
            raise UsageError(f"taps is {options.taps}, but model '{model.name}' takes {contract.taps} at most")
        self._model = model
        self.unposed = None if contract.takes_poses else model.name  # it reports to a user who states poses
        self._events: list[Untimed] = []
        self._origin = Origin(source, model.name, contract.output_unit)
        self._scan_shape = geometry.scan_shape
        learned_by = contacts if options.learn else None
        trust = contract.read_trust()
        self._common = Common(contract, trust, geometry, options, estimator, learned_by, unix_time_s)
        self._baselines = dict(baselines or {})
        self._counts_per_newton = counts_per_newton
        self._pad, self._measured = pad, measured
        self._mounted = frozenset(mountings or ())
        self._mountings = {name: one for name, one in (mountings or {}).items() if one.turns_axes}
        self._options = options
        self._clock_ns = clock_ns
        self._sensors: dict[str, Sensor] = {}
        self._queue = WaitingSteps()
        self._tracks: dict[str | None, PoseTrack] = {}

    def __repr__(self) -> str:
        sensors = ", ".join(self._sensors) or "none so far"
        return f"<Runtime of {self._origin.model}, {self._origin.source}, sensors: {sensors}>"

    @property
    def expected(self) -> frozenset[str]:
        """Names of the sensors with stored baselines or counts per newton."""
        per_newton = self._counts_per_newton
        return frozenset({*self._baselines, *(per_newton if isinstance(per_newton, Mapping) else ())})

    def take_learned(self) -> dict[str, Pad]:
        """Return the pads with gains learned since the last call, by sensor name."""
        learned = {name: sensor.take_learned() for name, sensor in self._sensors.items()}
        return {name: pad for name, pad in learned.items() if pad is not None}

    def reset(self) -> None:
        """Forget the taps of every sensor, as for a new object, and report it as an event; zeroing stays."""
        for sensor in self._sensors.values():
            sensor.reset_taps()
        self._report("reset")

    def zero(self, name: str | None = None, *, force: bool = False) -> None:
        """Zero again from the next scans; the old baselines stay in use until then, and an event reports the outcome.

        Args:
            name: of the sensor; None for all.
            force: also in contact.
        """
        if not self._sensors:
            self._report("refused", "zeroing refused: no scan has arrived yet")
        elif name is not None and name not in self._sensors:
            known = ", ".join(sorted(self._sensors))
            self._report("refused", f"zeroing refused: no sensor {name}, there are {known}")
        for sensor in self._sensors.values() if name is None else filter(None, [self._sensors.get(name)]):
            sensor.zero_again(force=force)

    def pose(self, pose: PadPose, time_ns: int, sensor: str | None = None, *, holds: bool = False) -> bool:
        """Take a pose of a pad; False if one at the same time or later was taken before.

        Args:
            pose: of the pad in the object's plane.
            time_ns: monotonic time of the pose, in [ns].
            sensor: name of the sensor; None for every sensor without poses of its own.
            holds: the pad rests there until the next pose.
        """
        return self._tracks.setdefault(sensor, PoseTrack()).add(time_ns, pose, holds=holds)

    def lose_touch(self, sensors: str = "", *, same_pad: bool = False) -> None:
        """Forget all readings and taps after the link broke, since contacts may have been missed; zeroing stays.

        Args:
            sensors: prefix of the names of the sensors concerned; all by default.
            same_pad: it cannot be another one since, as in a recording that goes on from another place.
        """
        for name, sensor in self._sensors.items():
            if name.startswith(sensors):
                sensor.lose_touch(same_pad=same_pad)

    def _report(self, kind: EventKind, detail: str = "") -> None:
        self._events.append(Untimed(kind, None, detail))

    def push(self, scan: Scan, *, infer: bool = True) -> Result:
        """Make the result of one scan, inferred at once if it is in contact and `infer` is true; raises as `infer`."""
        sensor, step = self._follow(scan)
        if step.due is not None:
            if not infer:
                step.overtake()
            elif not sensor.reuse(step, step.due):
                self._infer([(sensor, step)])
        return step.freeze()

    def take(self, scan: Scan, clock_ns: Callable[[], int] | None = None) -> list[Result]:
        """Take a scan and return the results that are ready, in the order of their scans.

        A scan that needs a pattern waits for `infer`. If the next one of its sensor comes first, its result is ready
        without a pattern, and the newer scan takes its place: no sensor waits longer because it sends more.

        Args:
            scan: next one of its sensor.
            clock_ns: clock of the scans, by which results state their latency, in [ns]; None leaves it out.

        Raises:
            WindowError: the scan is not of this sensor geometry.
        """
        sensor, step = self._follow(scan)
        if step.due is not None and not sensor.reuse(step, step.due):
            return [overtaken.freeze() for overtaken in self._queue.join(sensor, step)]
        if step.estimate is not None and clock_ns is not None:
            step.ready(clock_ns())
        return [*(overtaken.freeze() for overtaken in self._queue.leave(scan.sensor)), step.freeze()]

    @property
    def waiting(self) -> int:
        """Number of sensors whose newest scan waits for its pattern."""
        return len(self._queue)

    def infer(self, longest_us: float | None = None, clock_ns: Callable[[], int] | None = None) -> list[Result]:
        """Infer the patterns of the sensors that have waited longest, in one call, and return their results.

        Args:
            longest_us: time that the call may take, in [us], None for no limit; those that do not fit wait on.
            clock_ns: as in `take`.

        Raises:
            ModelError: the model gave a pattern or a traction that is not finite, or a deviation that is not finite and
                above zero.
        """
        due = self._queue.take(longest_us)
        if not due:
            return []
        self._infer(due)
        if clock_ns is not None:
            done_ns = clock_ns()
            for _, step in due:
                step.ready(done_ns)
        return [step.freeze() for _, step in due]

    def _follow(self, scan: Scan) -> tuple[Sensor, Step]:
        """Pass a scan through the stages of its sensor before the model."""
        if scan.counts.shape != self._scan_shape:
            raise WindowError(f"scan has shape {scan.counts.shape}, expected {self._scan_shape}")
        sensor = self._sensors.get(scan.sensor) or self._meet(scan)
        step = Step(scan, self._origin)
        # Without a pose of any pad, which is the rule, this is all that poses cost.
        track = (self._tracks.get(scan.sensor) or self._tracks.get(None) or None) if self._tracks else None
        sensor.follow(step, track, self._events)
        return sensor, step

    def _infer(self, waiting: Sequence[tuple[Sensor, Step]]) -> None:
        """Give steps the patterns that are due, inferred in one call."""
        model, start_ns = self._model, self._clock_ns()
        due = [(sensor, step, step.due) for sensor, step in waiting if step.due is not None]
        begun = [sensor.begin(step, window) for sensor, step, window in due]
        poses = [made.poses for made, _ in begun if made.poses is not None]
        pads = [sensor.pad.row for sensor, _, _ in due]
        patterns = model.run_together([given for _, given in begun], pads, *([poses] if poses else []))
        run_time_us = (self._clock_ns() - start_ns) / 1e3
        self._queue.took(run_time_us / len(due))
        deviations, tractions = model.deviation, model.traction
        for row, ((sensor, step, window), (made, given)) in enumerate(zip(due, begun, strict=True)):
            made.pattern, step.run_time_us = patterns[row].copy(), run_time_us
            made.deviation = None if deviations is None else deviations[row].copy()
            made.traction = None if tractions is None else tractions[row].copy()
            sensor.finish(step, window, made, given[0])

    def _meet(self, scan: Scan) -> Sensor:
        name = scan.sensor
        per_newton, pad, measured = self._counts_per_newton, self._pad, self._measured
        pad = pad.get(name) if isinstance(pad, Mapping) else pad
        settings = Settings(
            self._mountings.get(name),
            self._baselines.get(name),
            per_newton.get(name) if isinstance(per_newton, Mapping) else per_newton,
            pad,
            pad if measured is None else measured.get(name),
            notes_on_missing(name, self._mounted, self._baselines),
        )
        self._sensors[name] = sensor = Sensor(name, self._common, settings, scan.time_ns)
        return sensor


class WaitingSteps:
    """Queue of one step a sensor, that of its newest scan: no sensor waits longer because another sends more."""

    def __init__(self) -> None:
        # A newer scan keeps the place of the one it overtakes: the sensor that has waited longest is the first.
        self._waiting: dict[str, tuple[Sensor, Step]] = {}
        self._pattern_us = 0.0

    def __len__(self) -> int:
        return len(self._waiting)

    def join(self, sensor: Sensor, step: Step) -> list[Step]:
        """Let a step wait for its pattern in its sensor's place; return the one that it overtakes, if any."""
        overtaken = self._waiting.get(step.scan.sensor)
        self._waiting[step.scan.sensor] = sensor, step
        return _overtaken(overtaken)

    def leave(self, sensor: str) -> list[Step]:
        """Give up a sensor's place, since its newest scan needs none; return the step that waited, if any."""
        return _overtaken(self._waiting.pop(sensor, None)) if self._waiting else []

    def take(self, longest_us: float | None) -> list[tuple[Sensor, Step]]:
        """Return those that have waited longest, one at least, as many as are inferred in so long, in [us].

        Of calls that are needed for all of them, each takes as many.
        """
        count = len(self._waiting)
        if longest_us is not None and count:
            count = math.ceil(count / max(1, math.ceil(count * self._pattern_us / longest_us)))
        return [self._waiting.pop(sensor) for sensor in list(self._waiting)[:count]]

    def took(self, pattern_us: float) -> None:
        """Learn the time that each pattern of a call took, in [us]."""
        self._pattern_us += (_SMOOTHING if self._pattern_us else 1.0) * (pattern_us - self._pattern_us)


def _overtaken(waited: tuple[Sensor, Step] | None) -> list[Step]:
    if waited is None:
        return []
    waited[1].overtake()
    return [waited[1]]
