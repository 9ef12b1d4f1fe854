"""Contract of every sink: each kind of result and event comes back, it fails alone, and ends cleanly."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from edge_samples import ROOT, ListSink, make_contract, make_scan
from mcap_samples import messages_of
from sink_samples import RUN, make_sure_results

from edge.errors import SinkClosedError, SinkError, UsageError
from edge.perception.event import Event, Note
from edge.perception.result import Result
from edge.pipeline.sink import Sink
from edge.sinks.fan_out import Fan
from edge.sinks.json_encoding import COUNTED_NS
from edge.sinks.jsonl import JsonLinesSink
from edge.sinks.registry import FORMS, check_sink, open_sink
from edge.sinks.ros2.cdr_messages import RESULT
from edge.sinks.ros2.map_messages import image_map
from edge.sinks.ros2.ros_types import LOG
from edge.sinks.status_line import StatusSink
from firmware_bridge.poses.pad_pose import PadPose
from firmware_bridge.poses.timed_pose import TimedPose

CONTRACT = make_contract(interval_factor=1.6)
PERIOD_NS = 10_000_000
SENSORS = ("4", "6", "7", "8")
EVENTS = (
    Event(5, "lost", None, "the cable is out"),
    Event(7, "sink", None, "disk full"),
    Event(9, "zeroed", "4", "again, \u00fcber"),
)


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
    return Back(*(record[name] for name in Back._fields[:-1]), highest)


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
        self.sink = open_sink(f"jsonl:{self.path}", CONTRACT, source="emulated")

    def lines(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.path.read_text().splitlines()]

    def results(self) -> list[Back]:
        return [of_record(one, one["pattern"]) for one in self.lines() if one["state"] != "event"]

    def events(self) -> list[tuple[str, str]]:
        return [(one["event"], one["note"]) for one in self.lines() if one["state"] == "event"]


class Mcap(Opened):
    """A recording, read by the public package."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "out.mcap"
        self.sink = open_sink(f"mcap:{self.path}", CONTRACT, unix_offset_ns=0)

    def results(self) -> list[Back]:
        by_topic = messages_of(self.path)
        found = []
        for sensor in SENSORS:
            patterns = {at: image_map(data) * 1e3 for at, data in by_topic[f"/s{sensor}/pattern"]}
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
        self.sink = open_sink(f"shm:{self.name}", CONTRACT)
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
        self.sink = open_sink(f"zenoh:grip?connect={endpoint}", CONTRACT, source="emulated")
        self._heard: list[Any] = []

    def end(self) -> None:
        self._heard, _ = self._consumer.until_gone()
        self._consumer.stop()

    def results(self) -> list[Back]:
        from edge.sinks.binary_message import unpack

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

        self.sink = Ros2Sink("/skin", ENVIRONMENT)
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


@pytest.fixture(params=KINDS, ids=lambda kind: kind.__name__.lower())
def opened(request, tmp_path):
    """A sink with its reader, of each kind."""
    made = request.param(tmp_path)
    yield made
    made.close()


def test_each_kind_of_result_and_event_comes_back(opened):
    results = every_kind()
    sink: Sink = opened.sink
    sink.pose([TimedPose(PadPose(1, 2), 3)])
    for result in results:
        sink.write(result, RUN)
        opened.look()
    for event in EVENTS[:2]:
        sink.tell(event, RUN)
    sink.wait()
    assert sink.unwritten == 0
    opened.close()
    found, expected = opened.results(), [told(result) for result in results]
    if isinstance(opened, Ros2):
        expected = [one._replace(scan=None, force_counts=None) for one in expected if one.state != "dropped"]
    for got, wanted in zip(found, expected, strict=True):
        near = (got.highest, got.force_counts) == pytest.approx((wanted.highest, wanted.force_counts), abs=0.051)
        assert near and got[:5] == wanted[:5]
    events = opened.events()
    assert events is None or events == [(event.kind, event.text) for event in EVENTS[:2]]


def test_one_that_ends_without_a_result_leaves_nothing_behind(opened, tmp_path):
    opened.sink.wait()
    opened.close()
    assert [path.name for path in tmp_path.iterdir() if path.stat().st_size] == []


@pytest.mark.parametrize("kind", [Jsonl, Mcap])
def test_counters_come_once_a_second_and_with_the_record_in_which_one_changes(kind, tmp_path):
    opened, (first, *_) = kind(tmp_path), make_sure_results(1)
    losses = (0, 0, 2, 2, 2, 2, 2)
    times_ns = (0, PERIOD_NS, 2 * PERIOD_NS, 3 * PERIOD_NS, COUNTED_NS, COUNTED_NS + 2 * PERIOD_NS, 5)  # played again
    for number, (lost, time_ns) in enumerate(zip(losses, times_ns, strict=True)):
        scan = replace(first.scan, number=number, time_ns=time_ns)
        opened.sink.write(replace(first, scan=scan), {"scans": number, "dropped": lost})
    opened.close()
    if kind is Jsonl:
        said = opened.lines()
    else:
        said = [json.loads(RESULT.decode(data)["record"]) for _, data in messages_of(opened.path)["/s4/result"]]
    counted = {one["scan"]: one["counters"]["dropped"] for one in said if "counters" in one}
    assert counted == {0: 0, 2: 2, 5: 2, 6: 2}


FULL = """
import resource, signal, sys
from pathlib import Path
from edge.errors import SinkError
from dataclasses import replace
from test_every_sink import CONTRACT, RUN, every_kind
from edge.sinks.registry import open_sink
sink, contact = open_sink(sys.argv[1], CONTRACT), every_kind()[3]
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
try:
    for number in range(2400):
        sink.write(replace(contact, scan=replace(contact.scan, number=number)), RUN)
    sink.close()
except SinkError as error:
    print(error)
"""


@pytest.mark.parametrize(
    ("form", "words"),
    [("jsonl:out.jsonl", "cannot write records to out.jsonl: File too large"),
     ("mcap:out.mcap", "recording into out.mcap stopped: File too large; its ")],
)  # fmt: skip
def test_a_disk_that_fills_up_is_told_and_what_was_written_is_whole(form, words, tmp_path):
    where = os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests/support'}:{Path(__file__).parent}"}
    done = subprocess.run(
        [sys.executable, "-c", FULL, form], cwd=tmp_path, env=where, capture_output=True, text=True, timeout=60
    )
    assert done.stdout.startswith(words) and done.stdout.count("\n") == 1, done.stderr
    if form.startswith("jsonl"):
        lines = (tmp_path / "out.jsonl").read_text().splitlines()
        assert [json.loads(line)["scan"] for line in lines] == list(range(len(lines))) != []
        return
    from firmware_bridge.recording.formats import load_recording

    scans = sum(len(track.counts) for track in load_recording(tmp_path / "out.mcap").tracks)
    assert f"its {scans} scans can be played" in done.stdout


def gone(tmp_path: Path) -> Sink:
    """Return a sink whose reader has left."""
    os.mkfifo(tmp_path / "fifo")
    reader = os.open(tmp_path / "fifo", os.O_RDONLY | os.O_NONBLOCK)
    sink = JsonLinesSink(str(tmp_path / "fifo"))
    os.close(reader)
    return sink


@pytest.mark.parametrize("bad", [lambda path: JsonLinesSink("/dev/full"), gone], ids=["full", "gone"])
def test_a_sink_that_fails_leaves_the_others_going_and_each_hears_of_it(opened, bad, tmp_path):
    events: list[Event] = []
    fan, good, failing = Fan(events.append, lambda: 11), ListSink(), bad(tmp_path)
    for sink in (failing, opened.sink, good):
        fan.add(sink)
    results = every_kind()
    for result in results:
        fan.write(result, RUN)
        opened.look()
    if isinstance(failing, JsonLinesSink) and not fan.failures:
        fan.close()
    else:
        with pytest.raises(SinkError, match="No space left"):
            fan.close()
    opened.sink.close = lambda: None
    opened.close()
    assert good.results == results and good.closed and len(opened.results()) >= len(results) - 1
    (event,) = events
    assert event.kind == "sink" and event.text.endswith("; the other sinks continue") and good.events == events


def test_the_failure_of_the_last_one_ends_the_run_and_a_reader_that_goes_is_an_ordinary_end(tmp_path):
    for failing, kind in ((JsonLinesSink("/dev/full"), SinkError), (gone(tmp_path), SinkClosedError)):
        fan = Fan(lambda event: None)
        fan.add(failing)
        with pytest.raises(SinkError) as ended:
            fan.write(every_kind()[0], RUN)
        assert type(ended.value) is kind


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("jsonl:none/out.jsonl", SinkError, "none/out.jsonl: No such file"),
        ("jsonl:fifo", SinkError, "nobody reads fifo: start its reader first"),
        ("mcap:none/out.mcap", SinkError, "cannot record into none/out.mcap: No such file"),
        ("mcap:taken.mcap", SinkError, "taken.mcap exists: give another name, or delete it first"),
        *((f"mcap:{name}", UsageError, "a file whose name ends in .mcap") for name in ("a", "/dev/full", "a.npz")),
        ("npz:a.npz", UsageError, "record by --sink mcap:a.mcap, then edge-sr convert a.mcap a.npz"),
        *((f"shm:{name}", SinkError, "cannot be a name") for name in ("a/b", "../x", ".x", "a b", "x" * 101)),
        *((f"ros2:{name}", UsageError, "is not a ROS topic") for name in ("4", "a//b", "a/", "a b", "\u00e4", "~/a")),
        ("ros2:skin?comands", UsageError, "'comands' after its topic, expected ros2:TOPIC or ros2:TOPIC?commands"),
        ("zenoh:a//b", UsageError, "'a//b' for a key"),
        ("zenoh:a/*", UsageError, "'a/*' for a key"),
        ("zenoh:@/a", UsageError, "'@/a' for a key"),
        ("zenoh:a?listen=x", UsageError, "'listen=x' after its key: expected zenoh:KEY, zenoh:KEY?connect="),
        ("zenoh:a?connect=here", UsageError, "'connect=here' after its key"),
        ("zenoh:a?", UsageError, "'' after its key"),
        *((text, UsageError, ", ".join(FORMS)) for text in ("", "jsonl", "jsonl:", "npz:", "csv:a", "status:x", "x")),
    ],
)
def test_what_cannot_be_opened_is_refused_in_one_line_and_nothing_is_lost(text, error, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("taken.mcap").write_text("mine")
    os.mkfifo("fifo")
    with pytest.raises(error) as refused:
        open_sink(text, CONTRACT)
    assert words in str(refused.value) and str(refused.value).isprintable()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fifo", "taken.mcap"]
    assert Path("taken.mcap").read_text() == "mine"
    if error is UsageError:  # known before anything is opened
        with pytest.raises(UsageError):
            check_sink(text)


@pytest.mark.parametrize("form", ["mcap:out.mcap", "ros2:skin"])
def test_metres_need_a_model_whose_unit_is_known(form, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match="patterns are in 'counts', expected mm: use another sink"):
        open_sink(form, replace(CONTRACT, output_unit="counts"))
    assert not list(tmp_path.iterdir())


def test_status_is_a_sink_without_a_target():
    assert isinstance(open_sink("status", CONTRACT), StatusSink)
