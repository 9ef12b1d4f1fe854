"""Stream of the results of a source, one for every scan."""

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from numbers import Real

from edge.errors import UsageError
from edge.perception.event import Event
from edge.perception.result import Result
from edge.perception.runtime import Runtime
from edge.pipeline.commands import Commands, obey
from edge.pipeline.deadline import Deadline
from edge.pipeline.gain_keeper import GainKeeper
from edge.pipeline.pose_fields import PoseError, pose_of_fields
from edge.pipeline.pose_intake import PoseIntake
from edge.pipeline.pose_queue import PoseQueue
from edge.pipeline.run_statistics import Statistics
from edge.pipeline.scan_reader import Source
from edge.pipeline.silence import Silence
from edge.validation import check_positive
from firmware_bridge.links.base import Notice
from firmware_bridge.poses.pad_pose import PLACE_ERROR_MM, TURN_ERROR_DEG
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.scans.scan import Scan
from firmware_bridge.silence import POLL_S


class Stream:
    """Iterator over the results of a source, until it ends, `stop` is set or `duration_s` is over.

    Of the scans that wait, the newest of each sensor gets a pattern; the older ones get their result without one.
    Everything happens in the thread that iterates: between two results the runtime may be asked to zero or to reset.
    Any thread may state poses. A sensor that has a baseline or counts per newton, and of which no scan arrives, is
    reported as an event. A loop that was left may be continued by another, from the next result on.

    Attributes:
        statistics: of the results so far.
    """

    def __init__(
        self,
        source: Source,
        runtime: Runtime,
        *,
        on_event: Callable[[Event], object] = lambda event: None,
        on_poses: Callable[[Sequence[TimedPose]], object] = lambda poses: None,
        on_wait: Callable[[], object] = lambda: None,
        stop: threading.Event | None = None,
        duration_s: float | None = None,
        commands: Commands | None = None,
        statistics: Statistics | None = None,
        clock_s: Callable[[], float] = time.monotonic,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Prepare to iterate.

        Args:
            source: open.
            runtime: makes the results.
            on_event: called with each event, in its place between results.
            on_poses: called with the poses that the runtime has taken, before the results that are made with them.
            on_wait: called several times a second while no scan comes.
            stop: ends the stream after the scans in hand.
            duration_s: longest time to run, from the first step on, in [s]; for a recording that is read as fast as
                results are made, measured in the time of the recording.
            commands: polled between scans.
            statistics: filled on the way, so that they are available however the stream ends.
            clock_s: monotonic, in [s].
            clock_ns: clock of the scans, in [ns].

        Raises:
            UsageError: the duration is out of range.
        """
        if duration_s is not None:
            check_positive("duration_s", duration_s)
        self.statistics = Statistics() if statistics is None else statistics
        self._source = source
        self._runtime = runtime
        self._on_event = on_event
        self._on_poses = on_poses
        self._on_wait = on_wait
        self._stop = threading.Event() if stop is None else stop
        self._duration_s = duration_s
        self._commands = commands
        self._poses = PoseQueue() if commands is None else commands.poses
        self._intake = PoseIntake(runtime, self._poses, recorded=source.patient)
        self._silence = Silence(runtime.expected, recorded=source.kind == "replay")
        self._deadlines: dict[str, Deadline] = {}
        self._now_ns = 0
        self._clock_s = clock_s
        self._clock_ns = clock_ns
        path = None if source.kind == "replay" else source.sensor_file.path
        self._keeper = None if path is None else GainKeeper(path, emulated=source.kind == "emulated")
        self._running = self._run()

    @property
    def counters(self) -> dict[str, int]:
        """Counters of the source up to now, maybe ahead of the last result, and of the stream up to that result."""
        statistics = self.statistics
        counters = self._source.counters()
        counters["dropped"] = statistics.dropped
        counters["overruns"] = statistics.overruns
        counters["late"] = statistics.late
        counters["missed"] = statistics.missed
        counters["poses"] = statistics.poses
        counters["poses_refused"] = statistics.poses_refused
        counters["poses_dropped"] = statistics.poses_dropped
        return counters

    def pose(
        self,
        x_mm: float,
        y_mm: float,
        turn_deg: float = 0.0,
        *,
        error_mm: float = PLACE_ERROR_MM,
        error_deg: float = TURN_ERROR_DEG,
        time_ns: int | None = None,
        sensor: str | None = None,
        holds: bool = False,
    ) -> None:
        """State where the pad of a sensor is; any thread may call it, and it applies from the next scans on.

        Args:
            x_mm: place of the pad's middle in the object's plane, along x, in [mm].
            y_mm: along y.
            turn_deg: turn of the pad from x to y, in [deg].
            error_mm: standard deviation of the place along x and along y, in [mm].
            error_deg: standard deviation of the turn, in [deg].
            time_ns: when it was there, by `time.monotonic_ns`, later than the pose before; None for now.
            sensor: name of the sensor; None for every sensor without poses of its own.
            holds: the pad rests there until the next pose. Without it poses must come several times a second.

        Raises:
            UsageError: a value is out of range, or the source is a recording, whose scans are not of now.
        """
        if self._source.patient:
            raise UsageError(
                f"{self._source.name} is a recording: give `runtime.pose` a PadPose and a time of its scans"
            )
        now_ns = self._clock_ns()
        numbers = {"x_mm": x_mm, "y_mm": y_mm, "turn_deg": turn_deg, "error_mm": error_mm, "error_deg": error_deg}
        fields = {name: float(value) if isinstance(value, Real) else value for name, value in numbers.items()}
        fields |= {"sensor": sensor, "holds": holds, "time_ns": now_ns if time_ns is None else time_ns}
        try:
            self._poses.put(pose_of_fields(fields, now_ns))
        except PoseError as error:
            raise UsageError(f"a pose: {error}") from error

    def __iter__(self) -> Iterator[Result]:
        """Return the results, from the next one on; raises as `__next__` does."""
        return self._running

    def __next__(self) -> Result:
        """Return the next result as soon as it is made.

        Raises:
            LinkLostError: after every scan before it got its result.
            ModelError: the model gave a pattern that is not finite, or a deviation that is not finite and above zero.
        """
        return next(self._running)

    def _run(self) -> Iterator[Result]:
        try:
            yield from self._made()
        finally:
            if self._keeper is not None:
                self._keeper.close()
                if self._keeper.trouble is not None:
                    detail = f"learned gains are not kept: {self._keeper.trouble}"
                    self._tell(Event(self._clock_ns(), "note", None, detail))

    def _made(self) -> Iterator[Result]:
        for taken in self._taken():
            if self._commands is not None:
                obey(self._commands, self._runtime)
                self.statistics.commands_refused = self._commands.refused
            self._take_poses(taken)
            scans: list[Scan] = []
            for one in taken:
                if isinstance(one, Scan):
                    scans.append(one)
                    continue
                if isinstance(one, TimedPose):
                    continue
                yield from self._results(scans)
                self._heed(one)
                scans = []
            yield from self._results(scans)
            for event in self._silence.look():
                self._tell(event)
            if not taken:
                self._on_wait()

    def _take_poses(self, taken: Sequence[Scan | Notice | TimedPose]) -> None:
        """Pass poses on to the runtime: those from outside, and those of the source."""
        recorded = [one for one in taken if isinstance(one, TimedPose)]
        if not (recorded or self._poses.begun or self._intake.used):
            return
        times_ns = [one.time_ns for one in taken if isinstance(one, Scan)]
        first_ns = min(times_ns, default=None)
        if not self._source.patient:
            self._now_ns = self._clock_ns()
        elif first_ns is not None:
            self._now_ns = first_ns
        intake, statistics = self._intake, self.statistics
        poses = intake.take(recorded, first_ns, self._now_ns)
        statistics.poses, statistics.poses_refused = intake.used, intake.refused
        statistics.poses_dropped = intake.dropped
        if poses:
            self._on_poses(poses)
        for event in intake.look(self._now_ns):
            self._tell(event)

    def _taken(self) -> Iterator[list[Scan | Notice | TimedPose]]:
        """Yield the scans, notices and poses of the source, until it ends, `stop` is set, or the time is over.

        A patient source's time is that of its scans.
        """
        length_s = math.inf if self._duration_s is None else self._duration_s
        begun_s = self._clock_s()
        first_ns: int | None = None
        while not self._stop.is_set() and (self._source.patient or self._clock_s() - begun_s < length_s):
            taken = self._source.take(POLL_S)
            self.statistics.overruns = self._source.overruns
            if taken is None:
                return
            for one in taken if self._source.patient else ():  # one scan at most
                if isinstance(one, Scan):
                    first_ns = one.time_ns if first_ns is None else first_ns
                    if one.time_ns - first_ns >= length_s * 1e9:
                        return
            yield taken

    def _results(self, scans: Sequence[Scan]) -> Iterator[Result]:
        if not scans:
            return
        newest = {scan.sensor: scan for scan in scans}
        results = self._runtime.push_together([(scan, newest[scan.sensor] is scan) for scan in scans])
        done_ns = self._clock_ns()
        for name, pad in self._runtime.take_learned().items():
            if self._keeper is not None:
                self._keeper.keep(name, pad)
        for result in results:
            yield self._follow(result, done_ns)

    def _follow(self, result: Result, done_ns: int) -> Result:
        """Count a result that was ready at `done_ns`."""
        scan, statistics = result.scan, self.statistics
        deadline = self._deadlines.get(scan.sensor)
        if deadline is None:
            deadline = self._deadlines[scan.sensor] = Deadline(self._source.rate_hz)
        if not scan.unread_ns:  # scans that waited unread came at no pace
            deadline.follow(scan.time_ns)
        back = self._silence.follow(scan, deadline.period_ns)
        if result.pattern is not None and not self._source.patient:  # its scans have another clock
            statistics.late += deadline.check(scan.time_ns, done_ns)
            result = replace(result, latency_us=(done_ns - scan.time_ns) / 1e3)
        statistics.add(result)
        statistics.missed = self._silence.missed
        if back is not None:
            self._tell(back)
        return result

    def _heed(self, notice: Notice) -> None:
        """Forget readings and taps from before an outage, and report the notice as an event."""
        if notice.kind in ("lost", "silent", "back"):
            self._runtime.lose_touch(notice.sensors)
            self._silence.begin_anew(notice.time_ns, notice.sensors)
        self._tell(Event.of(notice))

    def _tell(self, event: Event) -> None:
        self.statistics.tell(event)
        self._on_event(event)
