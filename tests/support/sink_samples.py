"""Sinks of files, each with its reader, and a result of each kind to write."""

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from edge_samples import BASELINE, FakeModel, fake_source, make_contract, make_scan
from mcap_samples import messages_of

from edge.perception.event import Event, Note
from edge.perception.result import Result
from edge.perception.runtime import Runtime
from edge.sinks.registry import open_sink
from edge.sinks.ros2.map_messages import recorded_map
from edge.sinks.ros2.messages import LOG, RESULT

RUN = {"dropped": 2, "overruns": 1, "torn_wire": 3, "torn_source": 4}
COUNTED = RUN | {"unwritten": 0}
CONTRACT = make_contract(interval_factor=1.6)
PERIOD_NS = 10_000_000
EVENTS = (
    Event(5, "lost", None, "the cable is out"),
    Event(7, "sink", None, "disk full"),
    Event(9, "zeroed", "4", "again, \u00fcber"),
)


def make_results(count=6, model=None):
    """Return idle and contact in turn, of two sensors, some torn; sensor 6 has no baseline and stays in zeroing."""
    runtime = Runtime(model or FakeModel(), source="emulated", baselines={"4": BASELINE})
    results = []
    for number in range(count):
        for sensor in ("4", "6"):
            absent = (3, 7) if number % 4 == 2 else ()
            press = 3000 + 40 * (3 - number % 4) if number % 4 > 1 else 0
            scan = make_scan(number, sensor=sensor, press_counts=press, absent=absent, noise=3)
            results.append(runtime.push(scan))
    return results


def make_sure_results(count=6):
    """Return such results of a model that gives deviations."""
    return make_results(count, FakeModel(CONTRACT))


class Terminal(io.StringIO):
    def isatty(self):
        return True


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


class Jsonl:
    """A file of records."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "out.jsonl"
        self.sink = open_sink(f"jsonl:{self.path}", CONTRACT, fake_source("emulated"))

    def lines(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.path.read_text().splitlines()]

    def results(self) -> list[dict[str, Any]]:
        return [one for one in self.lines() if one["state"] != "event"]

    def events(self) -> list[tuple[str, str]]:
        events = [one for one in self.lines() if one["state"] == "event"]
        assert all((one["sensor"], one["source"], one["counters"]) == (None, "emulated", COUNTED) for one in events)
        return [(one["event"], one["note"]) for one in events]


class Mcap:
    """A recording, read by the public package."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "out.mcap"
        self.sink = open_sink(f"mcap:{self.path}", CONTRACT, fake_source(unix_offset_ns=0))

    def results(self) -> list[dict[str, Any]]:
        found, by_topic = {}, messages_of(self.path)
        for topic in [topic for topic in by_topic if topic.endswith("/result")]:
            patterns = dict(by_topic[topic.replace("result", "pattern")])
            for at, data in by_topic[topic]:
                pattern = recorded_map(patterns[at]) * 1e3 if at in patterns else None
                found[at] = json.loads(RESULT.decode(data)["record"]) | {"pattern": pattern}
        return [found[at] for at in sorted(found)]

    def events(self) -> list[tuple[str, str]]:
        events = [LOG.decode(data) for _, data in messages_of(self.path)["/events"]]
        return [(one["function"], one["msg"]) for one in events if one["name"] == "edge-sr"]
