"""Snapshot of a run for its viewers, who read it now and then.

The loop writes and never waits; viewers read meanwhile. A value is replaced as a whole or appended to a bounded deque,
and a deque is copied in one step, so no reader sees half of anything, and no lock is needed.
"""

import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from edge.mapping.sink import MapState
from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.cadence import Rate
from edge.pipeline.sink import Sink

TRACE_S: Final = 60.0
TRACE_POINTS: Final = 1200
"""Most points of the last TRACE_S: one in 50 ms, which on a page some hundred pixels wide looks like all of them."""
RECENT_SCANS: Final = 256
EVENTS: Final = 20
MAX_FPS: Final = 25  # most result frames a second of one sensor: more is not visible to the eye
_PERIOD_NS: Final = round(1e9 / MAX_FPS)


class Point(NamedTuple):
    """Values of one scan that are drawn against time; `number` counts the sensor's results, from 1."""

    number: int
    time_ns: int
    force_counts: float | None
    area_mm2: float | None
    force_n: float | None
    shear_ratio: float | None


class Newest(NamedTuple):
    """Newest result of a sensor, numbered from 1, with its time of arrival; no rate before the second scan."""

    number: int
    result: Result
    counters: Mapping[str, int]
    received_ns: int
    rate_hz: float | None


class NumberedEvent(NamedTuple):
    """Event of the run, numbered from 1, with its time of arrival."""

    number: int
    event: Event
    counters: Mapping[str, int]
    received_ns: int


class RunSnapshot(Sink):
    """Newest result and trace of every sensor, and the latest events, in memory that does not grow with the run.

    Attributes:
        newest: by sensor.
        first_ns: time of the run's first scan, in [ns]; None before.
        map: newest state of the map; None where none is made.
        wake: called when there is something to show, MAX_FPS times a second at most; it never waits. So viewers are
            served after a scan's last work and not by a clock of their own, while the loop sleeps.
    """

    def __init__(self, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.newest: dict[str, Newest] = {}
        self.first_ns: int | None = None
        self.map: MapState | None = None
        self.wake: Callable[[], object] = lambda: None
        self._clock_ns = clock_ns
        self._traces: dict[str, _Trace] = {}
        self._events: deque[NumberedEvent] = deque(maxlen=EVENTS)
        self._events_count = 0
        self._due_ns = 0
        self._unseen = False

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Add a result."""
        scan = result.scan
        if self.first_ns is None:
            self.first_ns = scan.time_ns
        trace = self._traces.get(scan.sensor)
        if trace is None:
            trace = _Trace()
            # Replaced, not added to, so that a reader can iterate over the old one.
            self._traces = {**self._traces, scan.sensor: trace}
        trace.add(result)
        for event in result.events:
            self._add_event(event, counters)
        received_ns = self._clock_ns()
        newest = Newest(trace.number, result, counters, received_ns, trace.rate.rate_hz)
        if scan.sensor in self.newest:
            self.newest[scan.sensor] = newest
        else:
            self.newest = {**self.newest, scan.sensor: newest}
        self._news(received_ns)

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Add an event."""
        self._add_event(event, counters)
        self._news(self._clock_ns())

    def wait(self) -> None:
        """Show the newest result, once no scan follows it."""
        if self._unseen:
            self._news(self._clock_ns())

    def events(self, since: int) -> list[NumberedEvent]:
        """Return the latest events after number `since`."""
        return [one for one in self._events.copy() if one.number > since]

    def points(self, sensor: str, since: int) -> list[Point]:
        """Return the points of a sensor after number `since`: all, or if these are too many, one in 50 ms."""
        return self._traces[sensor].points(since)

    def _add_event(self, event: Event, counters: Mapping[str, int]) -> None:
        self._events_count += 1
        self._events.append(NumberedEvent(self._events_count, event, counters, self._clock_ns()))

    def _news(self, now_ns: int) -> None:
        self._unseen = now_ns < self._due_ns
        if not self._unseen:
            # Every fourth of a hundred scans a second, even if they come a little early or late.
            behind = now_ns - self._due_ns < _PERIOD_NS
            self._due_ns = (self._due_ns if behind else now_ns) + _PERIOD_NS
            self.wake()


class _Trace:
    """Values of one sensor against time."""

    def __init__(self) -> None:
        self.number = 0
        self.rate = Rate()
        self._recent: deque[Point] = deque(maxlen=RECENT_SCANS)
        self._past: deque[Point] = deque(maxlen=TRACE_POINTS - 1)

    def add(self, result: Result) -> None:
        self.number += 1
        time_ns = result.scan.time_ns
        self.rate.add(time_ns)
        shear = None if result.wrench is None else result.wrench.shear_ratio
        point = Point(self.number, time_ns, result.force_counts, result.area_mm2, result.force_n, shear)
        self._recent.append(point)
        past = self._past
        step_ns = round(TRACE_S / TRACE_POINTS * 1e9)
        if not past or time_ns // step_ns != past[-1].time_ns // step_ns:
            past.append(point)
        elif (result.force_counts or 0.0) > (past[-1].force_counts or 0.0):
            past[-1] = point  # the highest of its 50 ms, so that a short tap is seen, too

    def points(self, since: int) -> list[Point]:
        recent = [point for point in self._recent.copy() if point.number > since]
        if not recent or recent[0].number == since + 1:
            return recent
        newest = recent[-1]
        from_ns = newest.time_ns - TRACE_S * 1e9
        past = [point for point in self._past.copy() if since < point.number < newest.number]
        return [point for point in past if point.time_ns > from_ns] + [newest]
