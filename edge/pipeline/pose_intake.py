"""Way of poses into the runtime, with their counts, and detection of a source of them that falls silent."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from edge.inference.bundled import POSED_MODEL
from edge.perception.event import Event
from edge.perception.runtime import Runtime
from edge.pipeline.pose_queue import PoseError, PoseQueue
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.silence import POSES_SILENT_NS

REPEATED_NS: Final = 10_000_000_000
"""Time after which the same reason is reported again, in [ns]: a stream of bad poses must not flood."""


@dataclass(slots=True)
class _Course:
    """Poses of one sensor: when the last one was taken, in [ns], whether it holds, and whether silence is reported."""

    last_ns: int
    holds: bool
    silent: bool = False


class PoseIntake:
    """Intake of poses, in the thread of the loop, between two scans.

    Attributes:
        used: poses that the runtime has taken.
    """

    def __init__(
        self,
        runtime: Runtime,
        queue: PoseQueue,
        *,
        recorded: bool = False,
        unused_by: str | None = None,
        no_sensor: Callable[[str], str | None] = lambda name: None,
    ) -> None:
        """Begin without a pose; to recorded scans no pose of now belongs.

        `unused_by` names the model where neither it nor any sink uses poses; `no_sensor` returns why none has a name.
        """
        self.used = 0
        self._runtime = runtime
        self._queue = queue
        self._recorded = recorded
        self._unused_by = unused_by
        self._no_sensor = no_sensor
        self._played: set[str | None] = set()
        self._courses: dict[str | None, _Course] = {}
        self._reported_ns: dict[str, int] = {}
        self._events: list[Event] = []

    def take(self, recorded: Sequence[TimedPose], first_scan_ns: int | None, now_ns: int) -> list[TimedPose]:
        """Pass on the poses that wait and those of the source, and return those that the runtime has taken.

        They hold from the first scan after them, or else from now, the time of a recording's newest scan.
        """
        waiting = self._queue.take()
        if recorded:
            self._played.update(one.sensor for one in recorded)
        if waiting and (self._recorded or self._played):
            waiting = [one for one in waiting if not self._refused_for_recording(one)]
        taken: list[TimedPose] = []
        for timed in (*recorded, *waiting):
            if timed.sensor is not None and (why := self._no_sensor(timed.sensor)) is not None:
                self._queue.refuse(PoseError("sensor", why))
            elif self._runtime.pose(timed.pose, timed.time_ns, timed.sensor, holds=timed.holds):
                taken.append(replace(timed, used_from_ns=now_ns if first_scan_ns is None else first_scan_ns))
            else:
                earlier = f"that of the pose{_of(timed.sensor)} before"
                text = f"its time, {timed.time_ns} ns, is not after {earlier}: send them in order"
                self._queue.refuse(PoseError("order", text))
        if waiting and self._unused_by is not None:
            text = f"poses come, but model {self._unused_by} takes none, so that each pattern is of one tap"
            self._queue.warn("model", f"{text}: give --model {POSED_MODEL} for more")
        self.used += len(taken)
        for timed in taken:
            self._follow(timed, now_ns)
        return taken

    def look(self, now_ns: int) -> list[Event]:
        """Return events: of poses that stopped or came back since the last call, and of poses that are refused."""
        for sensor, course in self._courses.items():
            away_ns = now_ns - course.last_ns
            if not (course.silent or course.holds) and away_ns > POSES_SILENT_NS:
                course.silent = True
                text = (
                    f"no pose{_of(sensor)} for {away_ns / 1e9:.1f} s, so patterns are of one tap: check what sends "
                    'them; a pad at rest needs no more of them after one with "holds": true'
                )
                self._events.append(Event(now_ns, "poses_silent", sensor, text))
        for reason, text in self._queue.take_reasons().items():
            if now_ns - self._reported_ns.get(reason, now_ns - REPEATED_NS) >= REPEATED_NS:
                self._reported_ns[reason] = now_ns
                self._events.append(Event(now_ns, "poses_trouble", None, text))
        events, self._events = self._events, []
        return events

    def _refused_for_recording(self, timed: TimedPose) -> bool:
        if self._recorded:
            why = "of another time than now: add --paced"
        elif self._played & {timed.sensor, None}:
            why = f"which has poses{_of(timed.sensor)} of its own"
        else:
            return False
        self._queue.refuse(PoseError("recorded", f"its scans are of a recording, {why}"))
        return True

    def _follow(self, timed: TimedPose, now_ns: int) -> None:
        before = self._courses.get(timed.sensor)
        self._courses[timed.sensor] = _Course(now_ns, timed.holds)
        if before is not None and before.silent:
            away_s = (now_ns - before.last_ns) / 1e9
            text = f"poses{_of(timed.sensor)} are back after {away_s:.1f} s"
            self._events.append(Event(now_ns, "poses_back", timed.sensor, text))


def _of(sensor: str | None) -> str:
    return "" if sensor is None else f" of sensor {sensor}"
