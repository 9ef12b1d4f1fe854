"""The loop from scans to results: it takes what waits, has patterns made, and gives results and events to the sinks."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Final

from edge.errors import UsageError
from edge.perception.event import Event
from edge.perception.result import Result
from edge.perception.runtime import Runtime
from edge.pipeline.cadence import Cadences
from edge.pipeline.commands import Commands, carry_out
from edge.pipeline.gain_keeper import GainKeeper
from edge.pipeline.latest import NewestResults
from edge.pipeline.pose_queue import PoseIntake, PoseQueue
from edge.pipeline.run_statistics import COUNTED, Statistics
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink
from edge.validation import check_positive
from firmware_bridge.errors import BridgeError
from firmware_bridge.links.base import Notice
from firmware_bridge.poses import TimedPose
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import POLL_S

_UNWRITTEN: Final = attrgetter("unwritten")
_TROUBLES: Final = attrgetter(*COUNTED)
ALL_HEARD_SCANS: Final = 10  # scans of one sensor of a link after which all sensors of that link have sent some
COUNTED_NS: Final = 250_000_000  # age of the counters of a record, at most, while all is well, in [ns] of scan time


class Loop:
    """Maker of results from the scans, commands and poses of a source, in the thread that asks for a step.

    Sinks get each result and event as soon as it is made.

    Attributes:
        statistics: of the results so far.
    """

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
        patience_s: float = 0.0,
        clock_s: Callable[[], float] = time.monotonic,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Prepare to make results.

        Args:
            source: open.
            runtime: makes the results.
            sinks: open; they get every result and event, and the poses, before anything else does. Their counters are
                the stream's.
            on_event: called with each event, in its place between results.
            stop: ends the stream after the scans that wait.
            duration_s: longest time to run, from the first step on, in [s]; for a recording that is read as fast as
                results are made, measured in the time of the recording.
            commands: polled between scans.
            statistics: filled on the way, so that they are available however the stream ends.
            patience_s: longest time for which results may wait while all sensors are at rest, in [s].
            clock_s: monotonic, in [s].
            clock_ns: clock of the scans, in [ns].

        Raises:
            UsageError: the duration is out of range; SourceTakenError if the source has another stream.
        """
        if duration_s is not None:
            check_positive("duration_s", duration_s)
        self.statistics = Statistics() if statistics is None else statistics
        self._source = source
        self._runtime = runtime
        self._sinks = tuple(sinks)
        self._on_event = on_event
        self._poses = PoseQueue() if commands is None else commands.poses
        self._made: deque[Result | Event] = deque()  # in their order; whoever takes them calls `on_event`
        self._newest = NewestResults()
        # Patterns still to be made for scans that waited when one of several calls of inference began.
        self._left = 0
        self._error: Exception | None = None
        self._turn = threading.RLock()
        self._stop = threading.Event() if stop is None else stop
        self._length_s = math.inf if duration_s is None else duration_s
        self._begun_s: float | None = None
        self._first_ns: int | None = None
        self._commands = commands
        unused_by = None if any(sink.uses_poses for sink in self._sinks) else runtime.unposed
        self._intake = PoseIntake(runtime, self._poses, recorded=source.patient, unused_by=unused_by)
        recorded, rate_hz = source.kind == "replay", source.rate_hz
        self._cadences = Cadences(runtime.expected, recorded=recorded, rate_hz=rate_hz, patience_s=patience_s)
        self._now_ns = 0
        self._waited_s = self._refused_s = -math.inf
        self._clock_s = clock_s
        self._clock_ns = clock_ns
        self._latency_clock = None if source.patient else clock_ns  # a recording's scans have another clock
        self._counted: tuple[int, tuple[int, ...], dict[str, int]] = (0, (), {})
        path = None if source.kind == "replay" else source.sensor_file.path
        self._keeper = None if path is None else GainKeeper(path, emulated=source.kind == "emulated")
        source.reserve(self)

    @property
    def ended(self) -> bool:
        """True once there are no more results to make."""
        return self._newest.ended or self._error is not None

    @property
    def counters(self) -> dict[str, int]:
        """Counters of the source up to now, maybe ahead of the last result, and of the stream up to that result."""
        self.statistics.unwritten = sum(map(_UNWRITTEN, self._sinks))
        return self._source.counters() | self.statistics.counters()

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
        """Make the results of all that waits, after waiting at most `wait_s` [s]; of a patient source, of every scan.

        Where the source is lost, or a sink or the model fails, the error waits until the results before it are taken.
        """
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
        """Take what waits, and make its results: the order of everything that happens in a turn."""
        source, runtime = self._source, self._runtime
        if self._begun_s is None:
            self._begun_s = self._clock_s()
        over = self._stop.is_set() or (not source.patient and self._clock_s() - self._begun_s >= self._length_s)
        try:
            taken = source.take(0.0 if over or runtime.waiting else wait_s) if not (over and source.patient) else None
        except BridgeError:
            self._make_patterns()
            raise
        self.statistics.overruns = source.overruns
        if taken is None or (source.patient and self._is_too_long(taken)):
            self._make_patterns()
            self._end()
            return
        if (commands := self._commands) is not None:
            carry_out(commands, runtime, self._may_come)
            self.statistics.commands_refused = commands.refused
            if commands.reason is not None:
                self._tell_refusal(commands, commands.reason)
        if self._poses.begun or source.states_poses:
            self._take_poses(taken)
        for one in taken:
            if isinstance(one, Scan):
                for result in runtime.take(one, self._latency_clock):
                    self._follow(result)
                if one.time_ns < self._cadences.waited_ns:
                    self._make_patterns()
            elif isinstance(one, Notice):
                self._make_patterns()
                self._take_notice(one)
        # Scans that come while patterns are made join those that wait, but do not prolong what a caller waits for.
        self._left = min(self._left or len(runtime.waiting), len(runtime.waiting))
        self._left -= self._infer() if runtime.waiting else 0
        if over or source.patient:
            self._make_patterns()
        elif self._left > 0:
            return
        if over:
            self._end()
            return
        self._left = 0
        for event in self._cadences.look():
            self._tell(event)
        source.pace = self._cadences.pace
        if not taken:
            self._rest(wait_s)

    def _is_too_long(self, taken: Sequence[Scan | Notice | TimedPose]) -> bool:
        """Return whether the time of a patient source, which is that of its scans, is over."""
        times_ns = [one.time_ns for one in taken if isinstance(one, Scan)]
        if not times_ns:
            return False
        self._first_ns = times_ns[0] if self._first_ns is None else self._first_ns
        return times_ns[-1] - self._first_ns >= self._length_s * 1e9

    def _end(self) -> None:
        self._finish()
        self._newest.ended = True

    def _finish(self) -> None:
        """Keep what was learned; there are no more results."""
        self._left = 0
        if self._keeper is not None:
            keeper, self._keeper = self._keeper, None
            keeper.close()
            if keeper.trouble is not None:
                self._tell(Event(self._clock_ns(), "note", None, f"learned gains are not kept: {keeper.trouble}"))

    def _no_sensor(self, name: str) -> str | None:
        """Return why no sensor has this name; None if one has, or if one that has it may still come.

        The sensors of a link send their scans in turn: once one has sent many, all have sent some.
        """
        heard = self.statistics.scans_of_each()
        if name in heard or name in self._runtime.expected:
            return None
        prefix = max((prefix for prefix in self._source.prefixes if name.startswith(prefix)), key=len, default=None)
        if prefix is None:
            return f"no sensor {name!r}: the names begin with {', '.join(self._source.prefixes)}"
        most = max((scans for other, scans in heard.items() if other.startswith(prefix)), default=0)
        return f"no sensor {name!r}: sensors are {', '.join(sorted(heard))}" if most >= ALL_HEARD_SCANS else None

    def _may_come(self, name: str) -> bool:
        return name not in self.statistics.scans_of_each() and self._no_sensor(name) is None

    def _tell_refusal(self, commands: Commands, reason: str) -> None:
        now_s = self._clock_s()
        if now_s - self._refused_s >= 10:  # a stream of refused ones must not flood
            self._refused_s, commands.reason = now_s, None
            self._tell(Event(self._clock_ns(), "refused", None, reason))

    def _rest(self, wait_s: float) -> None:
        """Let the sinks do what is due, four times a second while no scan comes."""
        now_s = self._clock_s()
        if wait_s or now_s - self._waited_s >= POLL_S:
            self._waited_s = now_s
            for sink in self._sinks:
                sink.wait()

    def _take_poses(self, taken: Sequence[Scan | Notice | TimedPose]) -> None:
        """Pass poses on to the runtime: those from outside, and those of the source."""
        recorded = [one for one in taken if isinstance(one, TimedPose)]
        first_ns = min((one.time_ns for one in taken if isinstance(one, Scan)), default=None)
        if not self._source.patient:
            self._now_ns = self._clock_ns()
        elif first_ns is not None:
            self._now_ns = first_ns
        intake, statistics = self._intake, self.statistics
        poses = intake.take(recorded, first_ns, self._now_ns, self._no_sensor)
        statistics.poses, statistics.poses_refused = intake.used, self._poses.refused
        statistics.poses_dropped = self._poses.dropped
        for sink in self._sinks if poses else ():
            sink.pose(poses)
        for event in intake.look(self._now_ns):
            self._tell(event)

    def _make_patterns(self) -> None:
        """Make the results of all sensors that wait for their patterns."""
        while self._runtime.waiting:
            self._infer()

    def _infer(self) -> int:
        """Make the results of those that have waited longest, in one call; return their number."""
        results = self._runtime.infer(self._latency_clock)
        if self._keeper is not None:
            for name, pad in self._runtime.take_learned().items():
                self._keeper.keep(name, pad)
        for result in results:
            self._follow(result)
        return len(results)

    def _follow(self, result: Result) -> None:
        """Count a result, and hand it on."""
        cadences, statistics = self._cadences, self.statistics
        back = cadences.follow(result)
        statistics.add(result)
        statistics.late, statistics.missed = cadences.late, cadences.missed
        if back is not None:
            self._tell(back)
        if self._sinks:
            # Counters are read where they are due, and where something was lost: merging them took a tenth of a scan.
            statistics.unwritten = sum(map(_UNWRITTEN, self._sinks))
            counted_ns, troubles, counters = self._counted
            time_ns = result.scan.time_ns
            if not (0 <= time_ns - counted_ns < COUNTED_NS and result.scan.whole and troubles == _TROUBLES(statistics)):
                counters = self._count(time_ns)
            for sink in self._sinks:
                sink.write(result, counters)
        self._newest.add(result)
        self._made.append(result)

    def _count(self, time_ns: int) -> dict[str, int]:
        counters = self.counters
        self._counted = (time_ns, _TROUBLES(self.statistics), counters)
        return counters

    def _take_notice(self, notice: Notice) -> None:
        """Forget readings and taps from before an outage, and report the notice as an event."""
        if notice.kind in ("lost", "silent", "back"):
            self._runtime.lose_touch(notice.sensors)
            self._cadences.begin_anew(notice.time_ns, notice.sensors)
        self._tell(Event.of(notice))

    def _tell(self, event: Event) -> None:
        self.statistics.tell(event)
        if self._sinks:
            counters = self.counters
            for sink in self._sinks:
                sink.tell(event, counters)
        self._newest.tell(event)
        self._made.append(event)
