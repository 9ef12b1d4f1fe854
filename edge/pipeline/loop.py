"""The loop from scans to results: it takes what waits, has patterns made, and gives results and events to the sinks."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, Literal

from edge.errors import UsageError
from edge.perception.event import Event
from edge.perception.result import Result
from edge.perception.runtime import Runtime
from edge.pipeline.cadence import Cadences
from edge.pipeline.commands import Commands
from edge.pipeline.pose_queue import PoseIntake
from edge.pipeline.run_statistics import Statistics
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink
from edge.validation import check_kind, check_positive
from firmware_bridge.links.base import Notice
from firmware_bridge.poses import TimedPose
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import NS_PER_S, POLL_S

if TYPE_CHECKING:
    from edge.pipeline.gain_keeper import GainKeeper

LinkState = Literal["up", "silent", "lost", "ended"]
ALL_HEARD_SCANS: Final = 10  # scans of one sensor of a link after which all sensors of that link have sent some


class Loop:
    """Maker of results from the scans, commands and poses of a source, in the thread that asks for a step."""

    def __init__(
        self,
        source: Source,
        runtime: Runtime,
        *,
        sinks: Sequence[Sink] = (),
        on_event: Callable[[Event], object] = lambda event: None,
        stop: threading.Event | None = None,
        duration_s: float | None = None,
        commands: Commands | None = None,
        statistics: Statistics | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Prepare to make results of an open source, by the settings below; raises UsageError if it has a stream.

        Sinks get every result and event, and the poses, before anything else does; `on_event` is called with each
        event, in its place between results. `stop` ends the stream after the scans that wait, `duration_s` [s] after
        the first step; of a recording that is read as fast as results are made, it is of the recording's time.
        Commands are polled between scans, and statistics filled on the way, so that they are there however it ends.
        """
        check_kind("source", source, "patient", "an open one: with open_source(...) as source")
        check_kind("runtime", runtime, "unposed", "what open_runtime returned")
        check_kind("sinks", sinks, "__iter__", "a list of sinks")
        for sink in sinks:
            check_kind("sink", sink, "uses_poses", "what open_sink returned, or a class that inherits Sink")
        if duration_s is not None:
            check_positive("duration_s", duration_s)
        self.statistics = Statistics() if statistics is None else statistics
        self._source, self._runtime = source, runtime
        self._sinks = tuple(sinks)
        self._on_event = on_event
        self._commands = Commands() if commands is None else commands
        self._poses = self._commands.poses
        self._made: deque[Result | Event] = deque()  # in their order; whoever takes them calls `on_event`
        self._newest: dict[str, Result] = {}  # of each sensor, in the order of their first ones
        self._unseen: dict[str, int] = {}  # results of each sensor up to the newest that nothing returned yet
        # State of what does not send, by a sensor's name, or by what the names of a link's sensors begin with.
        self._down: dict[tuple[str, Literal["sensor", "link"]], LinkState] = {}
        self._ended = False
        self._error: Exception | None = None
        self._turn = threading.RLock()
        self._stop = threading.Event() if stop is None else stop
        self._length_ns = math.inf if duration_s is None else duration_s * NS_PER_S
        self._begun_ns: int | None = None
        unused_by = None if any(sink.uses_poses for sink in self._sinks) else runtime.unposed
        refused = "its scans are of a recording, of another time than now: add --paced" if source.patient else None
        refused = "the scans come with poses of their own" if source.states_poses else refused
        self._intake = PoseIntake(runtime, self._poses, refused=refused, unused_by=unused_by)
        self._cadences = Cadences(runtime.expected, recorded=source.kind == "replay", rate_hz=source.rate_hz)
        self._waited_ns = self._refused_ns = -math.inf
        self._clock_ns = clock_ns
        self._latency_clock = None if source.patient else clock_ns  # a recording's scans have another clock
        self._counted_ns, self._losses, self._counters = 0, (), dict[str, int]()
        self._keeper: GainKeeper | None = None
        file = source.sensor_file
        if source.kind != "replay" and file.path is not None:
            from edge.pipeline import gain_keeper

            self._keeper = gain_keeper.GainKeeper(file.path, file.mountings, emulated=source.kind == "emulated")
        source.reserve(self)

    @property
    def ended(self) -> bool:
        """True once there are no more results to make."""
        return self._ended or self._error is not None

    @property
    def counters(self) -> dict[str, int]:
        """Counters of the source up to now, maybe ahead of the last result, and of the stream up to that result."""
        return self._count()

    def close(self) -> None:
        """End the stream, as closing its source does; its sinks, which may be closed by now, get nothing more."""
        self._sinks = ()
        with self._turn:  # unless this is a callback of a step
            self._finish()
            self._pass_over()
            self._error = UsageError(
                f"the stream of source {self._source.name} is closed: results that were left are old"
            )

    def _pass_over(self) -> None:
        """Tell what happened, and leave the results out that were made."""
        while self._made:
            made = self._made.popleft()
            if isinstance(made, Event):
                self._on_event(made)

    def _step(self, wait_s: float) -> None:
        """Make the results of what waits after at most `wait_s` [s], then raise errors; a patient source gives one."""
        with self._turn:
            if self._error is not None:
                raise self._error.with_traceback(None)  # else every call would lengthen it
            try:
                self._make(wait_s)
            except Exception as error:
                self._error = self._error or error
                self._finish()
                if not self._made:
                    raise

    def _make(self, wait_s: float) -> None:
        """Take what waits and make its results: the order of everything that happens in a turn."""
        source, runtime, cadences = self._source, self._runtime, self._cadences
        if self._begun_ns is None and not source.patient:
            self._begun_ns = self._clock_ns()
        over = self._stop.is_set()
        taken = None if over and source.patient else source.take(0.0 if over else wait_s)
        now_ns = (source.last_ns or 0) if source.patient else self._clock_ns()
        self._begun_ns = now_ns if self._begun_ns is None else self._begun_ns
        over = over or now_ns - self._begun_ns >= self._length_ns
        if taken is None or (over and source.patient):
            self._finish()
            self._ended = True
            return
        for command in self._commands.poll():
            command.carry_out(runtime)
        if self._commands.reason is not None:
            self._tell_refusal(self._commands.reason)
        if self._poses.begun or source.states_poses:
            self._take_poses(taken, now_ns)
        for arrival in taken:
            if isinstance(arrival, Scan):
                for result in runtime.take(arrival, self._latency_clock):
                    self._follow(result)
                if arrival.time_ns < cadences.waited_ns:
                    self._make_patterns()
            elif isinstance(arrival, Notice):
                self._make_patterns()
                self._take_notice(arrival)
        self._make_patterns()
        if not taken:
            self._rest(wait_s)
        for event in cadences.look():
            self._tell(event)
        source.pace = cadences.pace
        if over:
            self._finish()
            self._ended = True

    def _finish(self) -> None:
        """Keep what was learned; there are no more results."""
        if self._keeper is not None:
            keeper, self._keeper = self._keeper, None
            self._keep_learned(keeper)  # from the last contact, which no pattern followed
            if (trouble := keeper.close()) is not None:
                self._tell(Event(self._clock_ns(), "note", None, f"learned gains are not kept: {trouble}"))
        self._count()
        if self._sinks:
            troubles = [sink.trouble for sink in self._sinks if sink.trouble is not None]
            self.statistics.sink_trouble = "; ".join(troubles) or None

    def _no_sensor(self, name: str) -> str | None:
        """Return why no sensor has this name; None if one has, or if one that has it may still come."""
        heard = self.statistics.scans_of_each()
        if not isinstance(name, str):
            return f"no sensor {name!r}: a name is text, such as '4'"
        if name in heard or name in self._runtime.expected:
            return None
        prefix = max((prefix for prefix in self._source.prefixes if name.startswith(prefix)), key=len, default=None)
        if prefix is None:
            return f"no sensor {name!r}: the names begin with {', '.join(self._source.prefixes)}"
        most = max((scans for other, scans in heard.items() if other.startswith(prefix)), default=0)
        return f"no sensor {name!r}: sensors are {', '.join(sorted(heard))}" if most >= ALL_HEARD_SCANS else None

    def _tell_refusal(self, reason: str) -> None:
        now_ns = self._clock_ns()
        if now_ns - self._refused_ns >= 10 * NS_PER_S:  # a stream of refused ones must not flood
            self._refused_ns, self._commands.reason = now_ns, None
            self._tell(Event(now_ns, "refused", None, reason))

    def _rest(self, wait_s: float) -> None:
        """Let the sinks do what is due, four times a second while no scan comes."""
        now_ns = self._clock_ns()
        if wait_s or now_ns - self._waited_ns >= POLL_S * NS_PER_S:
            self._waited_ns = now_ns
            for sink in self._sinks:
                sink.wait()

    def _take_poses(self, taken: Sequence[Scan | Notice | TimedPose], now_ns: int) -> None:
        """Pass poses on to the runtime: those from outside, and those of the source."""
        recorded = [pose for pose in taken if isinstance(pose, TimedPose)]
        first_ns = min((scan.time_ns for scan in taken if isinstance(scan, Scan)), default=None)
        poses = self._intake.take(recorded, first_ns, now_ns, self._no_sensor)
        for sink in self._sinks if poses else ():
            sink.pose(poses)
        for event in self._intake.look(now_ns):
            self._tell(event)

    def _make_patterns(self) -> None:
        """Make the results of all sensors that wait for their patterns, those that have waited longest first."""
        while self._runtime.waiting:
            for result in self._runtime.infer(self._latency_clock):
                self._follow(result)
            if self._keeper is not None:
                self._keep_learned(self._keeper)

    def _keep_learned(self, keeper: "GainKeeper") -> None:
        """Begin to write what was learned since the last pattern."""
        for name, pad in self._runtime.take_learned().items():
            keeper.keep(name, pad)

    def _follow(self, result: Result) -> None:
        """Count a result, and hand it on."""
        scan, statistics = result.scan, self.statistics
        back = self._cadences.follow(result)
        statistics.add(result)
        if back is not None:
            self._tell(back)
        if self._sinks:
            # Counters are read where a scan was lost, else four times a second by the time of the scans: merging them
            # took a tenth of a scan.
            losses = statistics.dropped, self._source.overruns, self._cadences.late, self._cadences.missed
            if not (0 <= scan.time_ns - self._counted_ns < NS_PER_S / 4 and scan.whole and losses == self._losses):
                self._counted_ns, self._losses, self._counters = scan.time_ns, losses, self._count()
            for sink in self._sinks:
                sink.write(result, self._counters)
        self._newest[scan.sensor] = result
        self._unseen[scan.sensor] = self._unseen.get(scan.sensor, 0) + 1
        self._made.append(result)

    def _count(self) -> dict[str, int]:
        """Bring the statistics up to date with what is counted elsewhere, and return all counters."""
        statistics, poses = self.statistics, self._poses
        statistics.overruns = self._source.overruns
        statistics.late, statistics.missed = self._cadences.late, self._cadences.missed
        statistics.poses, statistics.poses_refused = self._intake.used, poses.refused
        statistics.poses_dropped = poses.dropped
        if self._sinks:  # those of a closed stream have told theirs
            statistics.unwritten = sum(sink.unwritten for sink in self._sinks)
        return self._source.counters() | statistics.counters()

    def _take_notice(self, notice: Notice) -> None:
        """Forget readings and taps from before an outage, and report the notice as an event."""
        if notice.kind in ("lost", "silent", "back"):
            self._runtime.lose_touch(notice.sensors)
            self._cadences.begin_anew(notice.time_ns, notice.sensors)
        self._tell(Event.of(notice))

    def _tell(self, event: Event) -> None:
        self.statistics.tell(event)
        if self._sinks:
            counters = self._count()
            for sink in self._sinks:
                sink.tell(event, counters)
        down = (event.sensors, "link") if event.sensor is None else (event.sensor, "sensor")
        if event.kind in ("silent", "lost"):
            self._down[down] = event.kind
        elif event.kind == "back":
            self._down.pop(down, None)
        self._made.append(event)
