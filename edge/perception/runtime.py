"""Scan in, result out: all state between scans is kept here, per sensor."""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Final

from edge.errors import UsageError, WindowError
from edge.inference.contract import Model
from edge.perception.contact_options import DEFAULTS, RuntimeOptions
from edge.perception.dead_taxel_fill import TaxelEstimator
from edge.perception.event import EventKind, Untimed, notes_on_missing
from edge.perception.gain_learning import ContactModel
from edge.perception.result import Origin, Result, Step, Window
from edge.perception.sensor import Sensor
from edge.validation import check_baselines, check_counts_per_newton, check_mountings, check_pads
from firmware_bridge.links.base import SourceKind
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.poses import PadPose, PoseTrack
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import Baseline

MOST_TOGETHER: Final = 4  # sensors whose patterns are made in one call: scans that come meanwhile wait for its end


class Runtime:
    """Maker of one result per scan; `open_runtime` makes one, and describes the settings that are not listed here.

    Args:
        estimator: of dead taxels, on the same grid; without it there is no pattern while a taxel is dead.
        contacts: distribution of contacts by which gains are learned, if the options ask for that; without it none are.
        mountings: directions of a sensor's axes, and its gains, by name; without one the axes are as wired.
        measured: pads without what was learned, by name, from which learning begins; None for `pad`.
        unix_time_s: dates baselines that are taken, and gives the age of a stored one at the first scan of its sensor;
            from then on ages follow scan time.

    Attributes:
        unposed: name of the model if it takes no poses, reported to a user who states some; None if it takes them.
        waiting: the newest scan of each sensor that waits for its pattern.

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
        self.unposed = None if contract.takes_poses else model.name
        self._events: list[Untimed] = []
        self._origin = Origin(source, model.name, contract.output_unit)
        self._scan_shape = geometry.scan_shape
        self._new_sensor = partial(
            Sensor,
            contract=contract,
            trust=contract.read_trust(),
            geometry=geometry,
            options=options,
            estimator=estimator,
            contacts=contacts if options.learn else None,
            unix_time_s=unix_time_s,
        )
        self._baselines = dict(baselines or {})
        self._counts_per_newton = counts_per_newton
        self._pad, self._measured = pad, measured
        self._mounted = frozenset(mountings or ())
        self._mountings = {name: one for name, one in (mountings or {}).items() if one.turns_axes}
        self._clock_ns = clock_ns
        self._sensors: dict[str, Sensor] = {}
        # A newer scan keeps the place of the one it overtakes: the sensor that has waited longest is the first.
        self.waiting: dict[str, tuple[Sensor, Step, Window]] = {}
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
        """Zero a sensor or all from the next scans, also in contact if forced; an event reports the outcome.

        The old baselines stay in use until then.
        """
        if not self._sensors:
            self._report("refused", "zeroing refused: no scan has arrived yet")
        elif name is not None and name not in self._sensors:
            known = ", ".join(sorted(self._sensors))
            self._report("refused", f"zeroing refused: no sensor {name}, there are {known}")
        for sensor in self._sensors.values() if name is None else filter(None, [self._sensors.get(name)]):
            sensor.zero_again(force=force)

    def pose(self, pose: PadPose, time_ns: int, sensor: str | None = None, *, holds: bool = False) -> bool:
        """Take a pose of a pad at a monotonic time in [ns]; False unless it is later than the one before.

        Without a sensor it is of every sensor without poses of its own; a pose that holds is one until the next.
        """
        return self._tracks.setdefault(sensor, PoseTrack()).add(time_ns, pose, holds=holds)

    def lose_touch(self, sensors: str = "", *, same_pad: bool = False) -> None:
        """Forget readings and taps of sensors whose names begin so, after their link broke; zeroing stays.

        Contacts may have been missed, but a recording that goes on from another place is of the `same_pad`.
        """
        for name, sensor in self._sensors.items():
            if name.startswith(sensors):
                sensor.lose_touch(same_pad=same_pad)

    def _report(self, kind: EventKind, detail: str = "") -> None:
        self._events.append(Untimed(kind, None, detail))

    def push(self, scan: Scan, *, infer: bool = True) -> Result:
        """Make the result of one scan, inferred at once if it is in contact and `infer` is true; raises as `infer`."""
        sensor, step = self._follow(scan)
        if step.due is not None and not infer:
            step.overtake()
        elif step.due is not None and not sensor.reuse(step, step.due):
            self._infer([(sensor, step, step.due)])
        return step.freeze()

    def take(self, scan: Scan, clock_ns: Callable[[], int] | None = None) -> list[Result]:
        """Take a scan and return the results that are ready, in the order of their scans.

        A scan that needs a pattern waits for `infer`. If the next one of its sensor comes first, its result is ready
        without a pattern, and the newer scan takes its place. Results state their latency by the clock of the scans.

        Raises:
            WindowError: the scan is not of this sensor geometry.
        """
        sensor, step = self._follow(scan)
        overtaken = self.waiting.get(scan.sensor) if self.waiting else None
        ready: list[Result] = []
        if overtaken is not None:
            overtaken[1].overtake()
            ready.append(overtaken[1].freeze())
        if step.due is not None and not sensor.reuse(step, step.due):
            self.waiting[scan.sensor] = sensor, step, step.due
            return ready
        if overtaken is not None:
            del self.waiting[scan.sensor]
        if step.estimate is not None and clock_ns is not None:
            step.ready(clock_ns())
        ready.append(step.freeze())
        return ready

    def infer(self, clock_ns: Callable[[], int] | None = None) -> list[Result]:
        """Infer the patterns of the sensors that have waited longest, MOST_TOGETHER in one call.

        Raises:
            ModelError: the model gave a pattern or a traction that is not finite, or a deviation that is not finite and
                above zero.
        """
        due = [self.waiting.pop(sensor) for sensor in list(self.waiting)[:MOST_TOGETHER]]
        if not due:
            return []
        self._infer(due)
        if clock_ns is not None:
            done_ns = clock_ns()
            for _, step, _ in due:
                step.ready(done_ns)
        return [step.freeze() for _, step, _ in due]

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

    def _infer(self, due: Sequence[tuple[Sensor, Step, Window]]) -> None:
        """Give steps the patterns that are due, inferred in one call."""
        model, start_ns = self._model, self._clock_ns()
        begun = [sensor.begin(step, window) for sensor, step, window in due]
        poses = [made.poses for made, _ in begun if made.poses is not None]
        pads = [sensor.pad.row for sensor, _, _ in due]
        patterns = model.run_together([given for _, given in begun], pads, *([poses] if poses else []))
        run_time_us = (self._clock_ns() - start_ns) / 1e3
        deviations, tractions = model.deviation, model.traction
        for row, ((sensor, step, window), (made, given)) in enumerate(zip(due, begun, strict=True)):
            made.pattern, step.run_time_us = patterns[row].copy(), run_time_us
            made.deviation = None if deviations is None else deviations[row].copy()
            made.traction = None if tractions is None else tractions[row].copy()
            sensor.finish(step, window, made, given[0])

    def _meet(self, scan: Scan) -> Sensor:
        """Return a new sensor, with what is stored for it."""
        name = scan.sensor
        per_newton, pad, measured = self._counts_per_newton, self._pad, self._measured
        pad = pad.get(name) if isinstance(pad, Mapping) else pad
        self._sensors[name] = sensor = self._new_sensor(
            name,
            scan.time_ns,
            mounting=self._mountings.get(name),
            baseline=self._baselines.get(name),
            counts_per_newton=per_newton.get(name) if isinstance(per_newton, Mapping) else per_newton,
            pad=pad,
            measured=pad if measured is None else measured.get(name),
            notes=notes_on_missing(name, self._mounted, self._baselines),
        )
        return sensor
