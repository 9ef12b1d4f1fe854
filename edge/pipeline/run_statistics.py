"""Statistics of a run, in memory that does not grow with it; and advice to a person whose source gives no scan."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final

import numpy as np

from edge.perception.event import Event, EventKind
from edge.perception.result import Result
from firmware_bridge.errors import as_typed

NEWEST: Final = 10_000  # patterns whose times are kept, a hundred seconds of one sensor
MOST_STRAY_BYTES: Final = 64  # more bytes of no line of an adapter's are another device's
STAGES: Final = ("zeroing", "incomplete", "idle", "baseline_in_doubt", "dropped", "contact")
"""Stages of a sensor's scans on their way to a pattern."""
COUNTED: Final = (
    *("dropped", "overruns", "late", "missed"),
    *("poses", "poses_refused", "poses_dropped", "unwritten"),
)
"""Counts of which records have counters."""


@dataclass(slots=True)
class _Course:
    """Course of one sensor: its scans, and the newest results that were zeroed, and that came nearest to a pattern."""

    first_ns: int
    farthest: Result
    zeroed: Result | None = None
    last_ns: int = 0
    scans: int = 0

    @property
    def duration_ns(self) -> int:
        return self.last_ns - self.first_ns


@dataclass
class Statistics:
    """Statistics of a run, for its summary; there is a result for every scan."""

    source: str = ""  # kind of source of the last scan; empty before the first
    origin: str | None = None  # kind of source that a recording is of, where it states one
    scans: int = 0
    patterns: int = 0
    reused: int = 0  # results with the last pattern, since nothing had changed
    dropped: int = 0  # results in contact, but overtaken by a newer scan before the inference
    late: int = 0  # patterns that were ready later than one period after their scan
    overruns: int = 0  # scans discarded unread because nobody took them in time
    missed: int = 0  # scans that never arrived, as far as gaps show
    unwritten: int = 0  # records left out for readers that were too slow
    poses: int = 0
    poses_refused: int = 0
    poses_dropped: int = 0
    sink_trouble: str | None = None  # trouble of the sinks at the end; None while all is well
    events: dict[EventKind, int] = field(default_factory=dict)
    run_time_us: deque[float] = field(default_factory=partial(deque, maxlen=NEWEST))
    latency_us: deque[float] = field(default_factory=partial(deque, maxlen=NEWEST))
    _sensors: dict[str, _Course] = field(default_factory=dict)

    def counters(self) -> dict[str, int]:
        """Return the counts of which records have counters."""
        return {name: getattr(self, name) for name in COUNTED}

    def add(self, result: Result) -> None:
        """Count one result."""
        scan = result.scan
        self.source = result.source
        self.scans += 1
        self.dropped += result.state == "dropped"
        self.patterns += result.pattern is not None
        self.reused += result.reused_from is not None
        if result.run_time_us is not None:
            self.run_time_us.append(result.run_time_us)
        if result.latency_us is not None:
            self.latency_us.append(result.latency_us)
        course = self._sensors.get(scan.sensor)
        if course is None:
            course = self._sensors[scan.sensor] = _Course(scan.time_ns, result)
        course.scans += 1
        course.last_ns = scan.time_ns
        if result.baseline is not None:
            course.zeroed = result
        if STAGES.index(result.state) >= STAGES.index(course.farthest.state):
            course.farthest = result

    def tell(self, event: Event) -> None:
        """Count one event."""
        self.events[event.kind] = self.events.get(event.kind, 0) + 1

    def scans_of_each(self) -> dict[str, int]:
        """Return the number of scans of each sensor; any thread may call it."""
        return {name: course.scans for name, course in list(self._sensors.items())}

    def rate_hz(self) -> dict[str, float]:
        """Return the scans a second of each sensor over the whole run, for sensors with two or more."""
        return {
            name: (course.scans - 1) * 1e9 / course.duration_ns
            for name, course in self._sensors.items()
            if course.duration_ns > 0
        }

    def duration_s(self) -> float:
        """Return the longest time from the first scan to the last of any sensor, in [s]."""
        return max((course.duration_ns for course in self._sensors.values()), default=0) / 1e9

    def summary(self, *, source: str, wanted_rate_hz: float | None = None) -> str:
        """Return the run in a few lines, with the source as the user names it, and the requested rate."""
        lines = [
            f"{source}: {self.scans} scans, {self.patterns} patterns ({self.reused} reused), {self.dropped} dropped, "
            f"{self.overruns} overrun, {self.missed} missed"
        ]
        late = f", {self.late} later than a period" if self.late else ""
        for name, times, more in (("run time", self.run_time_us, ""), ("scan to pattern", self.latency_us, late)):
            if times:
                p50_us, p99_us = np.quantile(times, (0.5, 0.99))
                of = f" of the newest {NEWEST}" if len(times) == NEWEST else ""
                lines.append(f"{name}{of}: p50 {p50_us:.0f} us, p99 {p99_us:.0f} us, max {max(times):.0f} us{more}")
        lines += self._without_pattern()
        rates = [
            f"{rate_hz:.1f} Hz (sensor {name})"
            for name, rate_hz in sorted(self.rate_hz().items())
            # The first scans have waited for the model and come at once: over less time 100 Hz looks like 135.
            if self._sensors[name].duration_ns >= 1e9
        ]
        if rates:
            wanted = f", {wanted_rate_hz:g} Hz asked for" if wanted_rate_hz is not None else ""
            lines.append(f"rate held: {', '.join(rates)}{wanted}")
        lines += [
            f"sensor {name}: {result.baseline_text()}, from {result.baseline.origin}"
            for name, course in sorted(self._sensors.items())
            if (result := course.zeroed) is not None and result.baseline is not None
        ]
        received = self.poses + self.poses_refused + self.poses_dropped
        if received:
            lines.append(
                f"poses: {received} received, {self.poses} used, {self.poses_refused} refused, "
                f"{self.poses_dropped} dropped"
            )
        if self.unwritten:
            lines.append(f"records left out for slow readers: {self.unwritten}")
        if self.sink_trouble:
            lines.append(f"sinks: {self.sink_trouble}")
        return "\n".join(lines)

    def _without_pattern(self) -> list[str]:
        """Return why sensors had no pattern; one without contact is listed only if no sensor had a pattern."""
        lines: list[str] = []
        for name, course in sorted(self._sensors.items()):
            result = course.farthest
            why = {
                "zeroing": f"not zeroed, {result.note or 'too few scans'}; or pass --baseline, of the free pad",
                "incomplete": result.note or "a taxel was not received",
                "baseline_in_doubt": result.note,
                "idle": None
                if self.patterns
                else "no contact: its readings never reached --contact-on-counts over the baseline",
                "dropped": "newer scans overtook all that were in contact",
            }.get(result.state)
            believed = " to be believed" if result.state == "baseline_in_doubt" else ""
            if why is not None:
                lines.append(f"sensor {name} has no pattern{believed}: {why}")
        return lines


_ADVICE: Final = {
    "without_readings": "messages of the server name no sensor: is one plugged in, and in the server's xServ.ini?",
    "bad_sensor": "messages of the server have other counts of taxels than a pad",
    "bad_json": "messages are no JSON with a number: another server answers at this address",
    "frames": "frames are lost, or this is another kind of pad (--id-map)?",
    "error_frames": "is the bus at 1 Mbit/s?",
    "fd_frames": "another device, of CAN FD, is on this bus: is it the sensor's?",
    "skipped_bytes": "another device, or another line speed (@BAUD after the port)? See edge-sr devices, and",
}
"""What may be wrong, by the counter of what came; the doctor does not show those of a server."""


def silence_hint(sources: Sequence[str], counters: Callable[[], Mapping[str, int]]) -> str:
    """Return what came of the sources, as the user named them, what may be wrong, and what to do."""
    source = f" --source {as_typed(sources[0])}" if len(sources) == 1 else ""
    counted = counters()
    arrived = {name: counted[name] for name in ("received_bytes", "messages", *_ADVICE) if counted.get(name)}
    came = ", ".join(f"{name} {count}" for name, count in arrived.items())
    if arrived.get("skipped_bytes", 0) <= MOST_STRAY_BYTES:
        arrived.pop("skipped_bytes", None)
    seen = [name for name in _ADVICE if name in arrived]
    if "messages" in arrived:  # of which a few may be of any kind
        seen.sort(key=arrived.__getitem__, reverse=True)
    why = _ADVICE[seen[0]] if seen else "is the sensor powered and its cable in?"
    return f"{f'only {came}' if came else 'nothing'} came: {why} edge-sr doctor{source} shows what is wrong"
