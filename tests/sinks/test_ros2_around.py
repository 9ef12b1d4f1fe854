"""Around the ROS 2 sink: topics, environments, files for ROS, and bytes as ROS itself makes them."""

import pytest

pytest.importorskip("cyclonedds", reason="of the extra `ros2`")

import json
import math
import re
import shlex
import struct
import time
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import ros2_messages
import yaml
from cyclonedds.idl import make_idl_struct, types
from edge_samples import BASELINE, ROOT, Clock, fake_source, make_contract, make_scan, make_wrench_result
from hypothesis import given
from hypothesis import strategies as st
from mcap_samples import make_results, odd_scans
from ros2_samples import ENVIRONMENT, contact, keep_published, sink

from edge.api import USPA44, Event, Note, Result, SinkError, UsageError
from edge.cli.main import parser
from edge.sinks.json_records import record
from edge.sinks.registry import check_sink
from edge.sinks.ros2 import map_messages
from edge.sinks.ros2 import messages as ros_messages
from edge.sinks.ros2.dds_domain import TYPE_HASHES, dds_type
from edge.sinks.ros2.diagnostics import Level
from edge.sinks.ros2.messages import sensor_path
from edge.sinks.ros2.sink import Ros2Sink
from firmware_bridge.errors import CdrError
from firmware_bridge.links.base import Notice
from firmware_bridge.recording.cdr import MessageType

__all__ = ["sink"]


def kept(kind="device", *, unix_offset_ns=None):
    """Return a sink on a clock of its own, the messages that it publishes from now on, and the clock."""
    clock, source = Clock(), fake_source(kind, unix_offset_ns=unix_offset_ns)
    sink = Ros2Sink("skin", make_contract(), source, environment=ENVIRONMENT, clock_ns=clock)
    return sink, keep_published(sink), clock


def test_diagnostics_come_once_a_second_and_say_why_it_is_silent():
    sink, published, clock = kept()
    idle = Result(make_scan(1), "device", "m", "idle", contact=False, baseline=BASELINE, baseline_age_s=3.0)

    def written(**changes):
        clock.now_ns += 1_000_000_000
        scan = replace(idle.scan, time_ns=clock.now_ns)
        sink.write(replace(idle, scan=scan, **changes), {"dropped": 2})
        return statuses()

    def statuses():
        taken = [status for message in published for status in message.get("status", ())]
        published.clear()
        return [(status["level"], status["message"]) for status in taken]

    assert written() == [(Level.WARN, "2 dropped")]
    clock.now_ns += 990_000_000
    sink.write(replace(idle, scan=replace(idle.scan, time_ns=clock.now_ns)), {"dropped": 2})
    assert statuses() == []
    assert written() == [(Level.OK, "idle")]
    sink.tell(Event(clock.now_ns, "trouble", None, "bus-off"), {"dropped": 2})
    clock.now_ns += 1_500_000_000
    sink.wait()
    sink.wait()
    assert statuses() == [(Level.STALE, "no scan for 2 s; bus-off")]
    sink.tell(Event(clock.now_ns, "well", None, "well again"), {"dropped": 2})
    sink.tell(Event(clock.now_ns, "silent", "5", "another is silent"), {"dropped": 2})
    assert written(dead={3: "stuck"}) == [(Level.WARN, "without taxel 3 (stuck)")]
    ((level, text),) = written(state="contact", trusted=False, untrusted_reason="unexplained")
    assert level == Level.WARN and text.startswith(
        "pattern not to be believed: the pattern does not explain its readings"
    )
    doubt = {"state": "baseline_in_doubt", "contact": None, "notes": (Note("baseline_in_doubt", "why"),)}
    assert written(**doubt) == [(Level.ERROR, "why")]
    sink.tell(Event(clock.now_ns, "lost", None, "the plug is out"), {})
    sink.close()
    assert statuses()[-1] == (Level.STALE, "ended")


@pytest.mark.parametrize(("kind", "offset_ns"), [("replay", 1_600_000_000 * 10**9), ("device", None)])
def test_stamps_are_of_the_recording_or_the_clock_at_start(kind, offset_ns, monkeypatch):
    """Recorded on a machine that was up for three days more than this one; and live, while the clock is set."""
    begun_ns = time.time_ns()
    sink, published, clock = kept(kind, unix_offset_ns=offset_ns)
    scan_ns = clock.now_ns + 3 * 86_400 * 10**9
    result = contact(1, source=kind)
    monkeypatch.setattr(time, "time_ns", lambda: 0)
    sink.write(replace(result, scan=replace(result.scan, time_ns=scan_ns)), {})
    stamp = published[0]["header"]["stamp"]
    stamp_ns = stamp["sec"] * 10**9 + stamp["nanosec"]
    expected_ns = scan_ns + (begun_ns - clock.now_ns if offset_ns is None else offset_ns)
    assert abs(stamp_ns - expected_ns) < (60 * 10**9 if offset_ns is None else 1)
    sink.close()


def test_one_links_outage_takes_nothing_from_sensors_of_another():
    sink, published, clock = kept()
    for name in ("left/4", "right/4"):
        sink.write(contact(1, sensor=name), {})
    published.clear()
    for kind, link in (("lost", "left"), ("trouble", "left"), ("well", "right")):
        sink.tell(Event.of(Notice(clock.now_ns, kind, f"{link}: {kind}", f"{link}/")), {})
    assert [one["data"] for one in published if one.get("data") in ("lost", "silent")] == ["lost"]
    sink.close()


ROS_TOPIC = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
NAMES = st.text(st.sampled_from("s4x_/é a0Z"), min_size=1, max_size=8)


@given(NAMES, NAMES)
def test_every_sensor_has_topics_of_its_own_that_ros_can_hold(one, other):
    topics = [sensor_path(name) for name in (one, other)]
    assert all(map(ROS_TOPIC.fullmatch, topics)) and "__" not in "".join(topics)
    assert (topics[0] == topics[1]) == (one == other)


def test_sensors_names_as_topics_and_names_that_ros_cannot_hold():
    names = {"4": "s4", "left/4": "left/s4", "left_1": "left_1", "s4": "x_7334", "x_1": "x_785f31", "/": "x_0/x_0"}
    assert {sensor: sensor_path(sensor) for sensor in names} == names


NONSENSE = "<CycloneDDS><Domain><Nonsense/></Domain></CycloneDDS>"


@pytest.mark.parametrize(
    ("environment", "error", "said"),
    [
        ({"ROS_DOMAIN_ID": "-1"}, UsageError, r"ROS_DOMAIN_ID is '-1', expected a whole number from 0 to 232"),
        ({"ROS_DOMAIN_ID": "233"}, UsageError, r"ROS_DOMAIN_ID is '233'"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "off"}, UsageError, r"is OFF, which hides edge-sr from other nodes"),
        ({"ROS_DOMAIN_ID": "7", "CYCLONEDDS_URI": NONSENSE}, SinkError, r"cannot join DDS domain 7 .*CYCLONEDDS_URI"),
    ],
)
def test_an_environment_that_ros_would_not_take_is_refused(environment, error, said):
    with pytest.raises(error, match=said):
        Ros2Sink("skin", make_contract(), fake_source(), environment=environment)


FILES = ROOT / "examples/ros2"


def test_the_launch_file_starts_a_command_that_edge_sr_takes():
    launch = ElementTree.parse(FILES / "skin.launch.xml").getroot()
    values = {one.get("name"): one.get("default") for one in launch.iter("arg")}
    (executable,) = launch.iter("executable")
    command = executable.get("cmd")
    for name, value in (values | {"options": "--sensor s.toml"}).items():
        command = command.replace(f"$(var {name})", value)
    assert "$(" not in command and values["options"] == ""
    program, *words = shlex.split(command)
    options = parser().parse_args(words)
    assert (program, str(options.sensor)) == ("edge-sr", "s.toml")
    assert [*map(check_sink, options.sink)] == [("ros2", "skin?commands")]
    (node,) = launch.iter("node")
    assert (FILES / node.get("args").removeprefix("-d $(dirname)/")).is_file()


def test_rviz_shows_topics_that_are_published(sink):
    shown = yaml.safe_load((FILES / "skin.rviz").read_text())["Visualization Manager"]
    published = set()
    sink.publish = lambda writer, message: published.add(writer.topic.name.removeprefix("rt"))
    sink.is_read = lambda writer: True
    result = make_wrench_result()
    sink.write(result, {})
    sink.close()  # which withdraws the points
    topics = {one["Topic"]["Value"] for one in shown["Displays"] if "Topic" in one}
    assert topics == {"/skin/s4/points", "/skin/s4/wrench", "/skin/s4/pattern"} and topics <= published
    assert shown["Global Options"]["Fixed Frame"] == result.scan.sensor
    qos = yaml.safe_load((FILES / "play_qos.yaml").read_text())["/tf_static"]
    assert (qos["durability"], qos["reliability"]) == ("transient_local", "reliable")


@pytest.mark.parametrize("kind", ros_messages.TYPES.values(), ids=lambda kind: kind.name)
def test_types_are_called_described_and_hashed_as_ros_does(kind):
    """Those of recordings, which are not published, have ROS's fields as well."""
    fields = [(name, ros_kind.replace("/msg/", "/")) for name, ros_kind, _ in ros2_messages.fields(kind.name)]
    assert [(field.name, field.kind) for field in kind.fields] == fields
    if kind.name in TYPE_HASHES:
        ours, theirs = dds_type(kind).__idl__, ros2_messages.dds_type(kind.name).__idl__
        assert ours.idl_transformed_typename == theirs.idl_transformed_typename
        assert ours.get_type_info() == theirs.get_type_info(), "names and types of all fields"
        assert TYPE_HASHES[kind.name] == ros2_messages.ROS.hash_rihs01(kind.name).removeprefix("RIHS01_")


UNIX_NS = 1_700_000_000_123_456_789


@pytest.mark.parametrize(
    "changes",
    [
        {"column_count": 20},
        {"column_count": 0},
        {"row_stride": 0},
        {"fields": [{"name": "pattern", "offset": 0, "type": 8}]},
        {"fields": [{"name": "pattern", "offset": 2, "type": 7}]},
        {"data": np.zeros(39, np.uint8)},
    ],
)
def test_another_grid_is_not_taken_for_a_map(changes):
    made = map_messages.grid("pattern", np.ones((4, 4), np.float32), "4", UNIX_NS, USPA44)
    assert map_messages.recorded_map(made) == pytest.approx(np.full((4, 4), 1e-3))
    with pytest.raises(ValueError, match="a grid of "):
        other = ros_messages.GRID.encode(ros_messages.GRID.decode(made) | changes)
        map_messages.recorded_map(other)


def test_a_result_says_its_numbers_apart_and_all_of_it_as_json():
    for result in make_results(odd_scans(4)):
        said = ros_messages.RESULT.decode(ros_messages.result_message(result, record(result, {"late": 1}), UNIX_NS))
        told = json.loads(said["record"])
        assert told["counts"][2][1][1] == (result.scan.counts[2, 1, 1] if result.scan.fresh[1, 1] else None)
        assert told["counters"] == {"late": 1} and said["header"]["frame_id"] == result.scan.sensor
        assert said["force_counts"] == result.force_counts or result.force_counts is None
        assert math.isnan(said["run_time_us"]) == (result.run_time_us is None)
        assert said["contact"] == {None: -1, False: 0, True: 1}[result.contact]


NUMBERS = st.lists(st.floats(width=32, allow_nan=False, allow_subnormal=False), max_size=3)
MIXED = MessageType("x/msg/Mixed", "string a\nint8 b\nfloat64[] c\nuint8 d\nfloat64 e\nint64[2] f\nstring g")


STRUCT = {"a": str, "b": types.int8, "c": types.sequence[types.float64], "d": types.uint8, "e": types.float64}
STRUCT |= {"f": types.array[types.int64, 2], "g": str}
TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=9)


@given(TEXT, NUMBERS, TEXT)
def test_each_number_lies_where_cyclonedds_puts_it(a, c, g):
    values = {"a": a, "b": -3, "c": c, "d": 7, "e": 0.1, "f": [1, -2], "g": g}
    data = MIXED.encode(values)
    assert data == bytes(make_idl_struct("Mixed", "Mixed", STRUCT)(**values).serialize())
    got = MIXED.decode(data)
    assert (got["a"], got["g"], got["c"].tolist(), got["f"].tolist()) == (a, g, c, [1, -2])


def test_no_length_is_believed_that_the_bytes_do_not_bear_out():
    data = MIXED.encode({"a": "abc", "b": 0, "c": [1.0], "d": 0, "e": 0.0, "f": [0, 0], "g": "z"})
    for end in range(len(data)):
        with pytest.raises(CdrError):
            MIXED.decode(data[:end])
    for length in (0, 100, 0xFFFFFFFF):  # of a text: none of it, not even its end, and far too much
        with pytest.raises(CdrError, match=r"a has \d+ bytes"):
            MIXED.decode(data[:4] + struct.pack("<I", length) + data[8:])
    with pytest.raises(CdrError, match=r"begins with 00000000"):
        MIXED.decode(bytes(4) + data[4:])
    with pytest.raises(CdrError, match=r"utf-8"):
        MIXED.decode(data[:8] + b"\xff" + data[9:])
