"""Scan in, result out: all state between scans is kept here, per sensor."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.errors import UsageError, WindowError
from edge.inference.model_interface import Model
from edge.perception.contact_options import DEFAULTS, RuntimeOptions
from edge.perception.dead_taxel_fill import TaxelEstimator
from edge.perception.event import OLD_NS, UNCHECKED, Event, EventKind, Untimed, age_notes, notes_on_missing
from edge.perception.gain_following import GainFollower
from edge.perception.gain_learning import ContactModel
from edge.perception.next_tap import TapAdvice
from edge.perception.pattern_check import REPEATS, PatternCheck
from edge.perception.pattern_input import Due, DueQueue
from edge.perception.pattern_result import Describer, checked, with_taps_that_belong
from edge.perception.result import Result, overtaken, replace
from edge.perception.sensor_state import Sensor
from edge.perception.tap_poses import TapPoses
from edge.perception.tap_tracker import TapTracker
from edge.validation import check_baselines, check_counts_per_newton, check_mountings, check_pads
from firmware_bridge.links.base import SourceKind
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.poses.pad_pose import PadPose
from firmware_bridge.poses.pose_track import PoseTrack
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.stillness import STILL_COUNTS
from firmware_bridge.zeroing.baseline import Baseline


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
        self._taps = contract.taps if options.taps is None else options.taps
        self._events: list[Untimed] = []
        self._source: SourceKind = source
        self._estimator = estimator
        self._contacts = contacts if options.learn else None
        self._geometry, self._scan_shape = geometry, geometry.scan_shape
        self._describe, self._trust = Describer(contract, geometry), contract.read_trust()
        self._baselines = dict(baselines or {})
        self._counts_per_newton = counts_per_newton
        self._pad, self._measured = pad, measured
        self._mounted = frozenset(mountings or ())
        self._mountings = {name: one for name, one in (mountings or {}).items() if one.turns_axes}
        self._options = options
        # Plain attributes, since every scan reads them.
        self._every_scan = options.every_scan
        self._follow_drift = options.follow_drift
        # Twice what all taxels may change by unseen together, for sensors whose mounting has gains.
        self._hidden_counts = 2.0 * STILL_COUNTS * geometry.taxel_count
        self._clock_ns = clock_ns
        self._unix_time_s = unix_time_s
        self._sensors: dict[str, Sensor] = {}
        self._queue = DueQueue()
        self._tracks: dict[str | None, PoseTrack] = {}

    def __repr__(self) -> str:
        sensors = ", ".join(self._sensors) or "none so far"
        return f"<Runtime of {self._model.name}, {self._source}, sensors: {sensors}>"

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
            sensor.taps.reset()
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

    def rests(self, result: Result) -> bool:
        """Return True if no contact can begin while no reading of the sensor changes by more than noise."""
        counts = result.force_counts
        seen_counts = self._options.contact_on_counts - self._hidden_counts
        return result.state == "idle" and counts is not None and counts < seen_counts

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
        result, due = self._follow(scan)
        if due is None or not infer:
            return result if due is None else overtaken(result)
        same = None if self._every_scan else due.unchanged(result)
        return same or self._infer([(result, due)])[0]

    def take(self, scan: Scan) -> list[Result]:
        """Take a scan and return the results that are ready, in the order of their scans.

        A scan that needs a pattern waits for `infer`. If the next one of its sensor comes first, its result is ready
        without a pattern, and the newer scan takes its place: no sensor waits longer because it sends more.

        Raises:
            WindowError: the scan is not of this sensor geometry.
        """
        result, due = self._follow(scan)
        same = None if due is None or self._every_scan else due.unchanged(result)
        if due is None or same is not None:
            return [*self._queue.leave(scan.sensor), same or result]
        return self._queue.join(scan.sensor, result, due)

    @property
    def waiting(self) -> int:
        """Number of sensors whose newest scan waits for its pattern."""
        return len(self._queue)

    def infer(self, longest_us: float | None = None) -> list[Result]:
        """Infer the patterns of the sensors that have waited longest, in one call, and return their results.

        Args:
            longest_us: time that the call may take, in [us], None for no limit; those that do not fit wait on.

        Raises:
            ModelError: the model gave a pattern or a traction that is not finite, or a deviation that is not finite and
                above zero.
        """
        due = self._queue.take(longest_us)
        return self._infer(due) if due else []

    def _follow(self, scan: Scan) -> tuple[Result, Due | None]:
        """Return the result without a pattern, and the input of a pattern if one is due."""
        if scan.counts.shape != self._scan_shape:
            raise WindowError(f"scan has shape {scan.counts.shape}, expected {self._scan_shape}")
        sensor = self._sensors.get(scan.sensor) or self._meet(scan)
        zeroed = sensor.take(scan)
        readings = None if zeroed is None or sensor.filler is None else sensor.fill(zeroed)
        filled = None if readings is None else readings.filled
        watch = sensor.watch
        taxel_notes = () if watch.sound else watch.notes(filled)
        notes_of_age = () if scan.time_ns - scan.not_before_ns <= OLD_NS else age_notes(scan)
        notes = (*taxel_notes, *sensor.zeroing_notes, *sensor.drift_notes, *notes_of_age)
        unit, dead = self._model.contract.output_unit, watch.reasons
        events = self._take_events(sensor, scan.time_ns) if self._events or sensor.events else ()
        known: dict[str, Any] = {"pattern_unit": unit, "dead": dead, "notes": notes, "events": events}
        if sensor.baseline is None or zeroed is None:
            return Result(scan, self._source, self._model.name, "zeroing", **known), None
        # Without a pose of any pad, which is the rule, this is all that poses cost.
        track = self._track_of(scan.sensor) if self._tracks else None
        pose = None if track is None else track.at(scan.on_bus_ns)
        known |= {"baseline": sensor.baseline, "baseline_age_s": sensor.age_s(scan.time_ns), "drift": sensor.drift}
        known |= {"zeroed": zeroed, "filled": filled, "pose": pose}
        if not watch.sound and (watch.waiting or (dead and readings is None)):
            return Result(scan, self._source, self._model.name, "incomplete", **known), None

        force_counts = float(np.add.reduce(zeroed[2], axis=None)) if readings is None else readings.z_counts
        readings_counts = zeroed if readings is None else readings.counts
        doubted = sensor.weigh(readings_counts, force_counts, scan.time_ns)
        tap = sensor.taps.push(readings_counts, scan.time_ns, force_counts, scan.on_bus_ns, doubted=doubted)
        if sensor.poses is not None and track is not None:
            sensor.poses.follow(tap, track)
        if self._follow_drift:
            sensor.follow_drift(scan, tap.contact or doubted)
        if not tap.contact and sensor.follower is not None and sensor.follower.waiting:
            sensor.learn(self._model.contract)
        taps_used = min(tap.taps_used, self._taps)
        if sensor.counts_per_newton is not None:
            force_n = force_counts / sensor.counts_per_newton
        else:
            force_n = None if scan.vendor_force_n is None else scan.vendor_force_n[2]
        due: Due | None = None
        if tap.contact:
            posed = None if sensor.poses is None else sensor.poses.choose(tap, pose, scheduled=track is None)
            if posed is None:
                # A copy, since the tracker overwrites its own if the sensor's next scan comes in the same call.
                window, slots, poses = tap.window.copy(), range(len(tap.window)), None
            else:
                taps_used = min(taps_used, len(posed.slots))
                slots, poses = posed.slots[:taps_used], posed.rows[:taps_used]
                window = tap.window[list(slots)]
            made_by = (self._model.name, tap.tap, tuple(slots), taps_used, filled, watch.most_repeats >= REPEATS)
            due = Due(sensor, window, slots, poses, tap.tap, made_by)
            known["notes"] = notes if sensor.check is not None else (*notes, UNCHECKED)
        elif doubted:
            known |= {"notes": (*notes, *sensor.doubt_notes), "trusted": False, "untrusted_reason": "baseline"}
            if force_counts >= self._options.contact_on_counts:  # to be looked at, and made from this scan alone
                taps_used, due = 1, Due.alone(sensor, readings_counts, len(tap.window), (self._model.name, filled))
        result = Result(
            scan,
            self._source,
            self._model.name,
            "baseline_in_doubt" if doubted else "idle",
            contact=None if doubted else tap.contact,
            taps_used=taps_used,
            window=None if due is None else due.window[:taps_used],
            poses=None if due is None else due.poses,
            next_tap=None if doubted or sensor.advice is None else sensor.advice.proposal(tap),
            force_counts=force_counts,
            force_n=force_n,
            gains_certainty=sensor.gains_certainty,
            **known,
        )
        return result, due

    def _track_of(self, sensor: str) -> PoseTrack | None:
        """Return the poses of a sensor's pad, its own or those of all; None before the first."""
        return self._tracks.get(sensor) or self._tracks.get(None) or None

    def _take_events(self, sensor: Sensor, time_ns: int) -> tuple[Event, ...]:
        """Return the events up to a scan of a sensor, at its time in [ns]."""
        events = tuple(event.at(time_ns) for event in (*self._events, *sensor.events))
        self._events.clear()
        sensor.events.clear()
        return events

    def _infer(self, waiting: Sequence[tuple[Result, Due]]) -> list[Result]:
        """Return results with the patterns that are due, inferred in one call."""
        contract = self._model.contract
        start_ns = self._clock_ns()
        results: list[Result] = []
        windows: list[NDArray[np.float32]] = []
        for result, touch in waiting:
            window = contract.scale_window(touch.window[: contract.taps], touch.sensor.gains)
            made = with_taps_that_belong(result, touch.sensor, touch.window, window, touch.slots)
            results.append(made)
            if made.poses is None:
                window[made.taps_used :] = 0
            else:
                if made.taps_used < len(window) and made.window is not None:
                    window = contract.scale_window(made.window, touch.sensor.gains)
            windows.append(window)
        pads = [touch.sensor.pad_row for _, touch in waiting]
        poses = [made.poses for made in results if made.poses is not None]
        patterns = self._model.run_together(windows, pads, *([poses] if contract.takes_poses else []))
        run_time_us = (self._clock_ns() - start_ns) / 1e3
        self._queue.took(run_time_us / len(waiting))
        deviations, tractions = self._model.deviation, self._model.traction
        for row, (_, touch) in enumerate(waiting):
            doubted = results[row].state == "baseline_in_doubt"
            made = replace(
                results[row],
                state="baseline_in_doubt" if doubted else "contact",
                pattern=patterns[row].copy(),
                deviation=None if deviations is None else deviations[row].copy(),
                traction=None if doubted or tractions is None else tractions[row].copy(),
                run_time_us=run_time_us,
            )
            sensor = touch.sensor
            if not doubted:
                made = self._describe(checked(made, sensor, touch.tap, windows[row][0]), sensor)
            sensor.last = results[row] = made
            sensor.last_reading.keep(touch.window[0], touch.made_by, touch.poses)
            if doubted:
                continue  # nothing follows from it, and nothing is learned
            if sensor.advice is not None:
                sensor.advice.see(made, touch.tap)
            if sensor.follower is not None and sensor.follower.see(made, touch.window[0]):
                sensor.learn(contract)
        return results

    def _meet(self, scan: Scan) -> Sensor:
        name = scan.sensor
        baseline = self._baselines.get(name)
        mounting = self._mountings.get(name)
        notes = notes_on_missing(name, self._mounted, self._baselines)
        self._sensors[name] = sensor = Sensor(
            name,
            self._geometry,
            self._new_tracker(),
            self._estimator,
            notes,
            mounting,
            self._unix_time_s,
            self._options,
        )
        per_newton = self._counts_per_newton
        sensor.counts_per_newton = per_newton.get(name) if isinstance(per_newton, Mapping) else per_newton
        sensor.pad = self._pad.get(name) if isinstance(self._pad, Mapping) else self._pad
        if self._trust is not None:
            sensor.check = PatternCheck(self._trust, self._model.contract)
        sensor.take_pad(self._model.contract)
        if self._model.contract.takes_poses:
            sensor.poses = TapPoses(self._model.contract, self._options.taps or 1, sensor.report)
            sensor.advice = TapAdvice(self._model.contract.reach_mm, self._taps)
        if self._contacts is not None:
            measured = sensor.pad if self._measured is None else self._measured.get(name)
            sensor.follower = GainFollower(self._contacts, measured, sensor.pad)
        if baseline is not None:
            age_s = baseline.age_s(self._unix_time_s())
            # A baseline from the future means that one of the two clocks was wrong.
            sensor.use(baseline, age_s if age_s >= 0 else None, scan.time_ns)
        return sensor

    def _new_tracker(self) -> TapTracker:
        grid_shape = (self._geometry.rows, self._geometry.cols)
        return TapTracker(self._model.contract.taps, self._options, grid_shape)
