"""Poses from messages through a queue to the runtime: any thread puts, and a slow loop loses the oldest."""

import json
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from edge.inference.bundled import POSED_MODEL
from edge.perception.event import Event
from edge.perception.runtime import Runtime
from edge.validation import as_float, check_kind
from firmware_bridge.poses import AHEAD_NS, PLACE_ERROR_MM, TURN_ERROR_DEG, PadPose, TimedPose
from firmware_bridge.scans.scan import is_sensor_name
from firmware_bridge.schedule import SENSOR_SILENT_NS

FURTHEST_AHEAD_NS: Final = 1_000_000_000  # of now that a pose may lie: all others until then would come too late
LONGEST_BYTES: Final = 4096  # bytes of one message: ten times those of a pose
WAITING_POSES: Final = 1024  # a second at 1000 poses/s: four times as long as the loop ever waits for a scan
REPEATED_NS: Final = 10_000_000_000  # until the same reason is reported again: a stream of bad poses must not flood


def json_object(message: str | bytes) -> dict[str, Any] | None:
    """Return the object of JSON in a stranger's message; None where it is another thing, or too long."""
    try:
        parsed = json.loads(message) if len(message) <= LONGEST_BYTES else None
    except (ValueError, RecursionError):
        return None
    return parsed if isinstance(parsed, dict) else None


class PoseError(ValueError):
    """A pose that cannot be taken, with a line for the user and a short name of the reason."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


def pose_of_fields(fields: Mapping[str, Any], now_ns: int) -> TimedPose:
    """Return the pose in parsed JSON, of its arrival without a time, or raise a PoseError where a field is wrong."""
    errors = {"error_mm": PLACE_ERROR_MM, "error_deg": TURN_ERROR_DEG}
    numbers = {"x_mm": None, "y_mm": None, "turn_deg": 0.0} | errors
    defaults = {"cmd": "pose", **numbers, "sensor": None, "time_ns": now_ns, "holds": False}
    given = {**defaults, **fields}
    if unknown := sorted(map(str, given.keys() - defaults.keys())):
        raise PoseError("unknown", f"it has {_shown(unknown[0])}, expected some of {', '.join(defaults)}")
    values: dict[str, Any] = {name: as_float(given[name]) for name in numbers}
    sensor, time_ns, holds = given["sensor"], given["time_ns"], given["holds"]
    is_name = sensor is None or (isinstance(sensor, str) and is_sensor_name(sensor))
    is_time = isinstance(time_ns, int) and not isinstance(time_ns, bool) and 0 <= time_ns < 2**63
    for name, fits, expected in (
        ("cmd", given["cmd"] == "pose", "pose: only poses are taken here"),
        *((name, value is not None, "a number") for name, value in values.items()),
        ("sensor", is_name, "the name of a sensor, or null"),
        ("holds", isinstance(holds, bool), "true or false"),
        ("time_ns", is_time, "a whole number of nanoseconds"),
    ):
        if not fits:
            got = "missing" if name in numbers and given[name] is None else _shown(given[name])
            raise PoseError(name, f"{name} is {got}, expected {expected}")
    try:
        pose = PadPose(**values)
    except ValueError as error:
        raise PoseError("range", str(error)) from error
    ahead_ns = time_ns - now_ns
    if ahead_ns > FURTHEST_AHEAD_NS:
        raise PoseError(
            "time_ns",
            f"time_ns is {ahead_ns / 1e9:.3g} s ahead of now, expected CLOCK_MONOTONIC of this machine, as in "
            "records: leave it out for the time of arrival",
        )
    return TimedPose(pose, time_ns, sensor, holds)


def _shown(value: object) -> str:
    """Return a value of a stranger in a few printable characters."""
    try:
        return ascii(value)[:40]
    except ValueError:
        return "a number of too many digits"


class PoseQueue:
    """Queue of poses from all sources of them, bounded; and of the reasons for which others are refused."""

    def __init__(self) -> None:
        self.begun = False  # True once there was a pose, or a reason to report; most runs have none, and follow none
        self.refused = 0  # poses that could not be taken
        self.dropped = 0  # poses that waited too long, behind too many others
        self._lock = threading.Lock()
        self._waiting: deque[TimedPose] = deque()
        self._reasons: dict[str, str] = {}

    def put(self, pose: TimedPose) -> None:
        """Put a pose; if too many wait, the oldest is dropped."""
        check_kind("pose", pose, "used_from_ns", "a TimedPose")
        with self._lock:
            if len(self._waiting) >= WAITING_POSES:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(pose)
            self.begun = True

    def put_fields(self, fields: Mapping[str, Any], now_ns: int) -> None:
        """Put the pose in parsed JSON that arrived at `now_ns` [ns], or refuse it."""
        try:
            self.put(pose_of_fields(fields, now_ns))
        except PoseError as error:
            self.refuse(error)

    def refuse(self, error: PoseError) -> None:
        """Count a pose that cannot be taken."""
        self.warn(error.reason, f"a pose is refused: {error}", refused=1)

    def warn(self, reason: str, text: str, *, refused: int = 0) -> None:
        """Put a line on poses, which may be taken all the same; `reason` is a short name of it."""
        with self._lock:
            self.refused += refused
            self.begun = True
            self._reasons.setdefault(reason, text)

    def take(self) -> list[TimedPose]:
        """Return the poses that wait, in the order in which they came."""
        with self._lock:
            poses, self._waiting = list(self._waiting), deque()
        return poses

    def take_reasons(self) -> dict[str, str]:
        """Return a line for each reason since the last call, by its short name."""
        with self._lock:
            reasons, self._reasons = self._reasons, {}
        return reasons


@dataclass(slots=True)
class _Course:
    """Poses of one sensor: when the last one was taken, in [ns], whether it holds, and whether silence is reported."""

    last_ns: int
    holds: bool
    silent: bool = False


class PoseIntake:
    """Intake of poses, in the thread of the loop, between two scans."""

    def __init__(
        self, runtime: Runtime, queue: PoseQueue, *, refused: str | None = None, unused_by: str | None = None
    ) -> None:
        """Begin without a pose; `refused` is why others than the source's are, `unused_by` a model that uses none."""
        self.used = 0  # poses that the runtime has taken
        self._runtime, self._queue = runtime, queue
        self._refused, self._unused_by = refused, unused_by
        self._courses: dict[str | None, _Course] = {}
        self._reported_ns: dict[str, int] = {}
        self._events: list[Event] = []

    def take(
        self,
        recorded: Sequence[TimedPose],
        first_scan_ns: int | None,
        now_ns: int,
        no_sensor: Callable[[str], str | None] = lambda name: None,
    ) -> list[TimedPose]:
        """Pass on the poses that wait and those of the source, and return those that the runtime has taken.

        They hold from the first scan after them, or from now where none has come.
        """
        waiting = self._queue.take()
        if self._refused is not None:
            for _ in waiting:
                self._queue.refuse(PoseError("recorded", self._refused))
            waiting = []
        ahead_ns = max((timed.time_ns for timed in waiting), default=0) - now_ns
        if ahead_ns > AHEAD_NS:
            text = f"poses come {ahead_ns / 1e9:.2f} s before the time that they state, and older ones serve until then"
            self._queue.warn("ahead", f"{text}: is it by CLOCK_MONOTONIC of this machine?")
        taken: list[TimedPose] = []
        for timed in (*recorded, *waiting):
            if timed.sensor is not None and (why := no_sensor(timed.sensor)) is not None:
                self._queue.refuse(PoseError("sensor", why))
            elif self._runtime.pose(timed.pose, timed.time_ns, timed.sensor, holds=timed.holds):
                taken.append(replace(timed, used_from_ns=now_ns if first_scan_ns is None else first_scan_ns))
                self._follow(timed, now_ns)
            else:
                earlier = f"that of the pose{_of(timed.sensor)} before"
                text = f"its time, {timed.time_ns} ns, is not after {earlier}: send them in order"
                self._queue.refuse(PoseError("order", text))
        if waiting and self._unused_by is not None:
            text = f"poses come, but model {self._unused_by} takes none, so that each pattern is of one tap"
            self._queue.warn("model", f"{text}: give --model {POSED_MODEL} for more")
        self.used += len(taken)
        return taken

    def look(self, now_ns: int) -> list[Event]:
        """Return events: of poses that stopped or came back since the last call, and of poses that are refused."""
        for sensor, course in self._courses.items():
            away_ns = now_ns - course.last_ns
            if not (course.silent or course.holds) and away_ns > SENSOR_SILENT_NS:
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

    def _follow(self, timed: TimedPose, now_ns: int) -> None:
        before = self._courses.get(timed.sensor)
        self._courses[timed.sensor] = _Course(now_ns, timed.holds)
        if before is not None and before.silent:
            text = f"poses{_of(timed.sensor)} are back after {(now_ns - before.last_ns) / 1e9:.1f} s"
            self._events.append(Event(now_ns, "poses_back", timed.sensor, text))


def _of(sensor: str | None) -> str:
    return "" if sensor is None else f" of sensor {sensor}"
