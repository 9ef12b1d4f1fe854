"""Sinks of every kind, each with its reader, and a result of each kind to write."""

import io
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from edge_samples import BASELINE, FakeModel, fake_source, make_contract, make_scan, unpack
from mcap_samples import messages_of

from edge.perception.event import Event, Note
from edge.perception.result import Result
from edge.perception.runtime import Runtime
from edge.pipeline.sink import Sink
from edge.sinks.registry import open_sink
from edge.sinks.ros2.map_messages import recorded_map
from edge.sinks.ros2.messages import LOG, RESULT

RUN = {"dropped": 2, "overruns": 1, "torn_wire": 3, "torn_source": 4}
COUNTED = RUN | {"unwritten": 0}
CONTRACT = make_contract(interval_factor=1.6)
PERIOD_NS = 10_000_000
SENSORS = ("4", "6", "7", "8")
EVENTS = (
    Event(5, "lost", None, "the cable is out"),
    Event(7, "sink", None, "disk full"),
    Event(9, "zeroed", "4", "again, \u00fcber"),
)


def make_results(count=6, runtime=None, **settings):
    """Return idle and contact in turn, of two sensors, some torn; sensor 6 has no baseline and stays in zeroing."""
    settings = {"source": "emulated", "baselines": {"4": BASELINE}, "unix_time_s": lambda: 1012.34} | settings
    runtime = runtime or Runtime(FakeModel(), **settings)
    results = []
    for number in range(count):
        for sensor in ("4", "6"):
            absent = (3, 7) if number % 4 == 2 else ()
            press = 3000 + 40 * (3 - number % 4) if number % 4 > 1 else 0
            scan = make_scan(number, sensor=sensor, press_counts=press, absent=absent, noise=3)
            results.append(runtime.push(scan))
    return results


def make_sure_results(count=6, **settings):
    """Return such results of a model that gives deviations."""
    settings = {"source": "emulated", "baselines": {"4": BASELINE}} | settings
    return make_results(count, Runtime(FakeModel(CONTRACT), **settings))


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Back(NamedTuple):
    """Values of a result that a reader finds; None for those that its sink does not hold."""

    sensor: str
    scan: int | None
    source: str
    state: str
    trusted: bool | None
    force_counts: float | None
    highest: float | None


def every_kind() -> list[Result]:
    """Return a result of each kind, in ascending time."""
    made = make_sure_results(4)
    idle = next(one for one in made if one.state == "idle")
    contact = next(one for one in made if one.pattern is not None)
    doubt = {"state": "baseline_in_doubt", "contact": None, "trusted": False, "untrusted_reason": "baseline"}
    kinds = [
        *(made[0], made[1], idle, contact),
        replace(contact, trusted=True),
        replace(contact, trusted=False, untrusted_reason="unfamiliar", notes=(Note("late", "old"),)),
        replace(contact, **doubt),
        replace(idle, state="dropped"),
        replace(idle, state="incomplete", contact=None, scan=make_scan(absent=(3, 7))),
        replace(idle, dead={3: "stuck"}, filled="neighbours", events=EVENTS[2:]),
        replace(contact, source="device", scan=replace(contact.scan, sensor="7")),
        replace(idle, source="replay", scan=replace(idle.scan, sensor="8")),
    ]
    scans = (replace(one.scan, number=number, time_ns=number * PERIOD_NS) for number, one in enumerate(kinds))
    return [replace(one, scan=scan) for one, scan in zip(kinds, scans, strict=True)]


def told(result: Result) -> Back:
    highest = None if result.pattern is None else round(float(result.pattern.max()), 6)
    scan = result.scan
    return Back(scan.sensor, scan.number, result.source, result.state, result.trusted, result.force_counts, highest)


def of_record(record: dict[str, Any], pattern: Any) -> Back:
    highest = None if pattern is None else round(float(np.max(pattern)), 6)
    return Back._make([*(record[name] for name in Back._fields[:-1]), highest])


class Opened:
    """A sink with its reader."""

    sink: Sink
    _closed = False

    def look(self) -> None:
        """Read what is there after a result, of sinks that keep the newest alone."""

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self.sink.close()
            self.end()

    def end(self) -> None:
        """Let the reader take what is under way, and end."""


class Jsonl(Opened):
    """A file of records."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "out.jsonl"
        self.sink = open_sink(f"jsonl:{self.path}", CONTRACT, fake_source("emulated"))

    def lines(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.path.read_text().splitlines()]

    def results(self) -> list[Back]:
        return [of_record(one, one["pattern"]) for one in self.lines() if one["state"] != "event"]

    def events(self) -> list[tuple[str, str]]:
        events = [one for one in self.lines() if one["state"] == "event"]
        assert all((one["sensor"], one["source"], one["counters"]) == (None, "emulated", COUNTED) for one in events)
        return [(one["event"], one["note"]) for one in events]


class Mcap(Opened):
    """A recording, read by the public package."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "out.mcap"
        self.sink = open_sink(f"mcap:{self.path}", CONTRACT, fake_source(unix_offset_ns=0))

    def results(self) -> list[Back]:
        by_topic = messages_of(self.path)
        found = []
        for sensor in SENSORS:
            patterns = {at: recorded_map(data) * 1e3 for at, data in by_topic[f"/s{sensor}/pattern"]}
            for at, data in by_topic[f"/s{sensor}/result"]:
                found.append(of_record(json.loads(RESULT.decode(data)["record"]), patterns.get(at)))
        return sorted(found, key=lambda one: one.scan or 0)

    def events(self) -> list[tuple[str, str]]:
        events = [LOG.decode(data) for _, data in messages_of(self.path)["/events"]]
        return [(one["function"], one["msg"]) for one in events if one["name"] == "edge-sr"]


class Shm(Opened):
    """Shared memory, read after each result."""

    def __init__(self, folder: Path) -> None:
        pytest.importorskip("shm_samples")
        from shm_samples import fields, values
        from shm_samples import shm_read as reading

        self._fields, self._newest, self._values = fields, reading.newest, values
        self.name = f"every-sink-test-{os.getpid()}"
        self.sink = open_sink(f"shm:{self.name}", CONTRACT, fake_source())
        self._memory = reading.attach(self.name)
        self._found: list[Back] = []

    def look(self) -> None:
        halves = self._newest(self._memory)  # whatever its age and state, which a robot looks at first
        name, half = max(halves.items(), key=lambda one: self._fields(one[1])["time_ns"])
        said = self._fields(half)
        states = (None, "zeroing", "incomplete", "idle", "contact", "dropped", "baseline_in_doubt")
        force, pattern = said["force_counts"], self._values(half, "pattern")
        self._found.append(
            Back(
                name,
                said["scan"],
                ("", "device", "replay", "emulated")[said["source"]],
                str(states[said["state"]]),
                {-1: None, 0: False, 1: True}[said["trusted"]],
                None if np.isnan(force) else force,
                round(float(pattern.max()), 6) if said["has_pattern"] else None,
            )
        )

    def results(self) -> list[Back]:
        return self._found

    def events(self) -> None: ...


class Zenoh(Opened):
    """Messages that a process of its own receives."""

    def __init__(self, folder: Path) -> None:
        pytest.importorskip("zenoh")
        from zenoh_samples import Consumer, free_endpoint

        endpoint = free_endpoint()
        self._consumer = Consumer(endpoint)
        self.sink = open_sink(f"zenoh:grip?connect={endpoint}", CONTRACT, fake_source())
        self._heard: list[Any] = []

    def end(self) -> None:
        self._heard, _ = self._consumer.until_gone()
        self._consumer.stop()

    def results(self) -> list[Back]:
        heard = self._heard
        packed = [unpack(data) for key, *_, data in heard if key.endswith("/pattern")]
        patterns = {header["scan"]: maps["pattern"] for header, maps in packed}
        scans = [json.loads(data) for key, *_, data in heard if key.endswith("/scan")]
        return [of_record(one, patterns.get(one["scan"])) for one in scans]

    def events(self) -> list[tuple[str, str]]:
        events = [json.loads(data) for key, *_, data in self._heard if key.endswith("/event")]
        return [(one["event"], one["note"]) for one in events]


class Ros2(Opened):
    """Messages as they go to Cyclone DDS, decoded by ROS's own definitions."""

    def __init__(self, folder: Path) -> None:
        pytest.importorskip("cyclonedds", reason="of the extra `ros2`")
        from ros2_samples import ENVIRONMENT, keep_published

        from edge.sinks.ros2.sink import Ros2Sink

        self.sink = Ros2Sink("/skin", CONTRACT, fake_source("device"), environment=ENVIRONMENT)
        self._kept: list[Any] = []
        self._found: list[Back] = []
        self._events: list[tuple[str, str]] = []
        keep_published(self.sink, self._kept)

    def look(self) -> None:
        texts = [one["data"] for one in self._kept if isinstance(one.get("data"), str)]
        said = [json.loads(text) for text in texts if text.startswith("{")]
        self._events += [(one["event"], one["note"]) for one in said if one["sensor"] is None]
        states = [text for text in texts if not text.startswith("{")]
        frames = [one["header"]["frame_id"] for one in self._kept if one.get("encoding") and one["height"] == 12]
        if frames and states:  # nothing is said of a scan that was dropped
            source, _, sensor = frames[0].rpartition("/")
            trusted = [one["data"] for one in self._kept if type(one.get("data")) is int]
            known = {-1: None, 0: False, 1: True}[trusted[0]]
            images = [one["data"] for one in self._kept if one.get("encoding") and one["height"] == 40]
            values = np.frombuffer(bytes(images[0]), "<f4") if images else np.zeros(1)
            highest = round(float(values.max()) * 1e3, 6) if values.any() and not np.isnan(values).any() else None
            self._found.append(Back(sensor, None, source or "device", states[0], known, None, highest))
        self._kept.clear()

    def results(self) -> list[Back]:
        return self._found

    def events(self) -> list[tuple[str, str]]:
        self.look()
        return self._events


KINDS = [Jsonl, Mcap, Shm, Zenoh, Ros2]
