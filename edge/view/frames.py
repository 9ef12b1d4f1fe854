"""Snapshot of a run, the frames that it is packed into, and the viewers: what each has seen, is sent and asks for.

The loop writes and never waits; viewers read meanwhile. A value is replaced as a whole or appended to a bounded deque,
and a deque is copied in one step, so no reader sees half of anything, and no lock is needed.
"""

import secrets
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from edge.mapping.sink import MapState
from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.cadence import Cadence
from edge.pipeline.commands import FORMS, WAITING, Commands, runtime_command
from edge.pipeline.pose_queue import json_object
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink
from edge.sinks.json_records import event_record, pack, record
from firmware_bridge.errors import harmless
from firmware_bridge.links.base import SourceKind
from firmware_bridge.schedule import SENSOR_SILENT_NS

TRACE_S: Final = 60.0
TRACE_POINTS: Final = 1200
"""Most points of the last TRACE_S: one in 50 ms, which on a page some hundred pixels wide looks like all of them."""
RECENT_SCANS: Final = 256
EVENTS: Final = 20
MAX_FPS: Final = 25  # most result frames a second of one sensor: more is not visible to the eye
MOST_VIEWERS: Final = 8
LATE_S: Final = 0.5
"""Age of an unanswered ping, in [s], from which nothing more is sent: the frames on their way are old already."""
_PERIOD_NS: Final = round(1e9 / MAX_FPS)
Truth = Callable[[Result], NDArray[np.float32] | None]  # true pattern (H, W) of a result, where a simulation states it


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


class RunSnapshot(Sink):
    """Newest result and trace of every sensor, and the latest events, in memory that does not grow with the run.

    After a scan's last work it calls `wake`, MAX_FPS times a second at most: viewers are served while the loop sleeps.
    """

    def __init__(self, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.sensors: dict[str, SensorTrace] = {}
        self.first_ns: int | None = None  # time of the run's first scan
        self.map: MapState | None = None  # its newest state, where one is made
        self.truth_of: Truth = lambda result: None
        self.wake: Callable[[], object] = lambda: None
        self._clock_ns = clock_ns
        self._events: deque[tuple[int, int, Event, Mapping[str, int]]] = deque(maxlen=EVENTS)
        self._events_count = 0
        self._due_ns = 0
        self._unseen = False

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Add a result."""
        scan, received_ns = result.scan, self._clock_ns()
        if self.first_ns is None:
            self.first_ns = scan.time_ns
        trace = self.sensors.get(scan.sensor) or SensorTrace()
        trace.add(result, counters, received_ns)
        if scan.sensor not in self.sensors:  # replaced, not added to, so that a reader can iterate over the old one
            self.sensors = {**self.sensors, scan.sensor: trace}
        for event in result.events:
            self._add_event(event, counters)
        self._news(received_ns)

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Add an event."""
        self._add_event(event, counters)
        self._news(self._clock_ns())

    def wait(self) -> None:
        """Show the newest result, once no scan follows it."""
        if self._unseen:
            self._news(self._clock_ns())

    def events(self, since: int) -> list[tuple[int, int, Event, Mapping[str, int]]]:
        """Return the latest events after number `since`: each one's number, time of arrival, and counters then."""
        return [numbered for numbered in self._events.copy() if numbered[0] > since]

    def _add_event(self, event: Event, counters: Mapping[str, int]) -> None:
        self._events_count += 1
        self._events.append((self._events_count, self._clock_ns(), event, counters))

    def _news(self, now_ns: int) -> None:
        self._unseen = now_ns < self._due_ns
        if not self._unseen:
            # Every fourth of a hundred scans a second, even if they come a little early or late.
            behind = now_ns - self._due_ns < _PERIOD_NS
            self._due_ns = (self._due_ns if behind else now_ns) + _PERIOD_NS
            self.wake()


class SensorTrace:
    """Trace of one sensor: its newest result, and its values against time."""

    newest: Newest

    def __init__(self) -> None:
        self._number = 0
        self._cadence = Cadence()
        self._recent: deque[Point] = deque(maxlen=RECENT_SCANS)
        self._past: deque[Point] = deque(maxlen=TRACE_POINTS - 1)

    def add(self, result: Result, counters: Mapping[str, int], received_ns: int) -> None:
        """Add a result that was received at a time in [ns]."""
        self._number += 1
        time_ns = result.scan.time_ns
        self._cadence.follow(result.scan)
        shear = None if result.wrench is None else result.wrench.shear_ratio
        point = Point(self._number, time_ns, result.force_counts, result.area_mm2, result.force_n, shear)
        self._recent.append(point)
        past = self._past
        step_ns = round(TRACE_S / TRACE_POINTS * 1e9)
        if not past or time_ns // step_ns != past[-1].time_ns // step_ns:
            past.append(point)
        elif (result.force_counts or 0.0) > (past[-1].force_counts or 0.0):
            past[-1] = point  # the highest of its 50 ms, so that a short tap is seen, too
        self.newest = Newest(self._number, result, counters, received_ns, self._cadence.rate_hz)

    def points(self, since: int) -> list[Point]:
        """Return the points after number `since`: all, or if these are too many, one in 50 ms."""
        recent = [point for point in self._recent.copy() if point.number > since]
        if not recent or recent[0].number == since + 1:
            return recent
        newest = recent[-1]
        from_ns = newest.time_ns - TRACE_S * 1e9
        past = [point for point in self._past.copy() if since < point.number < newest.number]
        return [point for point in past if point.time_ns > from_ns] + [newest]


class Frames:
    """Frames of one moment, in [ns]; viewers at the same state get the same bytes."""

    def __init__(self, snapshot: RunSnapshot, now_ns: int, source: SourceKind | None) -> None:
        self._now_ns, self._source, self._snapshot = now_ns, source, snapshot
        self.newest = {name: trace.newest for name, trace in snapshot.sensors.items()}
        self.map = snapshot.map
        self._packed: dict[tuple[str, int], bytes] = {}
        self._map: bytes | None = None

    def result(self, sensor: str, since: int) -> bytes:
        """Return the newest result of a sensor, with the trace after number `since`."""
        if (sensor, since) not in self._packed:
            self._packed[sensor, since] = self._pack(sensor, since)
        return self._packed[sensor, since]

    def events(self, since: int) -> Iterator[tuple[int, bytes]]:
        """Yield the latest events after number `since`, with their numbers."""
        for number, received_ns, event, counters in self._snapshot.events(since):
            fields = event_record(event, counters, self._source)
            yield number, _event(fields, self._now_ns - received_ns, {"number": number})

    def silent(self) -> dict[str, float]:
        """Return the silent sensors, and for how long each has been silent, in [s]."""
        away_ns = {sensor: self._now_ns - newest.received_ns for sensor, newest in self.newest.items()}
        return {sensor: round(ns / 1e9, 1) for sensor, ns in away_ns.items() if ns > SENSOR_SILENT_NS}

    def of_map(self, state: MapState) -> bytes:
        """Return the map, which is this state of it."""
        if self._map is None:
            header = {"kind": "map", "size_mm": state.size_mm, "centre_mm": state.centre_mm, "counts": state.counts}
            pads = {name: [pose.x_mm, pose.y_mm, pose.turn_deg] for name, pose in state.pads.items()}
            self._map = pack(header | {"pads": pads}, {"contact": state.contact})
        return self._map

    def _pack(self, sensor: str, since: int) -> bytes:
        newest = self.newest[sensor]
        result = newest.result
        first_ns = self._snapshot.first_ns or 0
        header: dict[str, Any] = {
            **record(result, newest.counters),
            "kind": "result",
            "note_kinds": [note.kind for note in result.notes],
            "untrusted_text": result.untrusted_text,
            "rate_hz": None if newest.rate_hz is None else round(newest.rate_hz, 2),
            "age_s": _seconds(self._now_ns - newest.received_ns),
            # The loop may have added points since; they belong to the next frame, which begins after this one.
            "trace": [
                _drawn(point, first_ns)
                for point in self._snapshot.sensors[sensor].points(since)
                if point.number <= newest.number
            ],
        }
        maps = {"zeroed": result.zeroed, "pattern": result.pattern, "deviation": result.deviation}
        maps["truth"] = None if result.pattern is None else self._snapshot.truth_of(result)
        return pack(header, {name: values for name, values in maps.items() if values is not None})


def hello(source: Source, model: str, contract: Contract) -> bytes:
    """Return the first frame that a viewer gets; one that reconnects notices by its `run` that this is another run."""
    height, width = contract.pattern_shape
    header = {
        "kind": "hello",
        "run": secrets.token_hex(8),
        "name": harmless(source.name),
        "source": source.kind,
        "model": model,
        "taps": contract.taps,
        "pattern_unit": contract.output_unit,
        "full_scale": contract.output_full_scale,
        "pixel_pitch_mm": contract.pitch_mm / contract.scale,
        "taxel_pitch_mm": contract.pitch_mm,
        "rows": contract.rows,
        "cols": contract.cols,
        "height": height,
        "width": width,
        "nominal_counts_per_newton": contract.nominal_counts_per_newton,
        "wrench": contract.traction_scale is not None,
        "checks": bool(contract.trust),
        "length_s": source.length_s,
    }
    return pack(header, {})


def state(viewers: int, silent: dict[str, float]) -> bytes:
    """Return the frame of the number of viewers, and of how long sensors have been silent, in [s]."""
    return pack({"kind": "state", "viewers": viewers, "silent": silent}, {})


def refused(time_ns: int, why: str, source: SourceKind | None) -> bytes:
    """Return the answer to a message that is no command: without a number, since it is no event of the run."""
    return _event(event_record(Event(time_ns, "refused", None, why), {}, source), 0, {})


def _event(fields: Mapping[str, Any], age_ns: int, number: Mapping[str, int]) -> bytes:
    return pack({**fields, **number, "kind": "event", "age_s": _seconds(age_ns)}, {})


def _drawn(point: Point, first_ns: int) -> list[float | None]:
    values = (point.force_counts, 1), (point.area_mm2, 2), (point.force_n, 4), (point.shear_ratio, 3)
    return [_seconds(point.time_ns - first_ns), *(None if value is None else round(value, n) for value, n in values)]


def _seconds(ns: int) -> float:
    return round(ns / 1e9, 3)


class Viewer:
    """Viewer of the page; every frame holds the newest values, however long ago the frame before was sent."""

    def __init__(self) -> None:
        self.pinged_s: float | None = None  # time since which a ping is unanswered
        self._seen: dict[str, int] = {}
        self._sent_number = 0
        self._seen_map: MapState | None = None

    def keeps_up(self, now_s: float) -> bool:
        """Return whether the viewer has read what it was sent, as an answered ping shows."""
        return self.pinged_s is None or now_s - self.pinged_s < LATE_S

    def due(self, frames: Frames) -> list[bytes]:
        """Return the frames that are new since the last call: events, one frame a sensor and one of the map."""
        due: list[bytes] = []
        for number, frame in frames.events(self._sent_number):
            self._sent_number = number
            due.append(frame)
        for sensor, newest in frames.newest.items():
            seen = self._seen.get(sensor, 0)
            if newest.number > seen:
                due.append(frames.result(sensor, seen))
                self._seen[sensor] = newest.number
        if frames.map is not None and frames.map is not self._seen_map:
            due.append(frames.of_map(frames.map))
            self._seen_map = frames.map
        return due


def execute(message: str | bytes, commands: Commands) -> str | None:
    """Queue the command in a viewer's message, JSON as on stdin; return the reason if it is refused."""
    parsed = json_object(message) if isinstance(message, str) else None
    command = None if parsed is None else runtime_command(parsed)
    if command is not None and not commands.full:
        commands.put(command)
        return None
    commands.refuse()
    if command is not None:
        return f"{WAITING} commands are waiting: repeat it when the run has executed them"
    return f"{message[:60]!r} is not a command: expected {FORMS}"
