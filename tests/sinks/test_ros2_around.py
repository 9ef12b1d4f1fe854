"""Around the ROS 2 sink: diagnostics, names of topics, environments, and files for ROS itself."""

import pytest

pytest.importorskip("cyclonedds", reason="of the extra `ros2`")

import re
import shlex
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import yaml
from edge_samples import BASELINE, ROOT, make_contract, make_scan, make_wrench_result
from hypothesis import given
from hypothesis import strategies as st
from ros2_samples import ENVIRONMENT, contact, keep_published, sink

from edge.cli.run_options import parser
from edge.errors import SinkError, UsageError
from edge.perception.event import Event, Note
from edge.perception.result import Result
from edge.pipeline.sink import RunFacts
from edge.sinks.registry import check_sink, open_sink
from edge.sinks.ros2.diagnostics import Level
from edge.sinks.ros2.sink import Ros2Sink
from edge.sinks.ros2.topic_names import LONGEST_TOPIC, base_topic, sensor_topic
from firmware_bridge.links.base import Notice

__all__ = ["sink"]


class Clock:
    def __init__(self):
        self.now_ns = 10**12

    def __call__(self):
        return self.now_ns


def test_diagnostics_come_once_a_second_and_tell_of_silence_and_what_it_was():
    clock, published = Clock(), []
    sink = Ros2Sink("skin", ENVIRONMENT, clock_ns=clock, unix_ns=lambda: 1_700_000_000_123_456_789)
    keep_published(sink, published)

    def statuses():
        taken = [status for message in published for status in message.get("status", ())]
        published.clear()
        return [(status["level"], status["message"]) for status in taken]

    scan = make_scan(1, time_ns=clock.now_ns)
    idle = Result(scan, "device", "m", "idle", contact=False, baseline=BASELINE, baseline_age_s=3.0)
    for _ in range(250):
        clock.now_ns += 10_000_000
        sink.write(replace(idle, scan=replace(scan, time_ns=clock.now_ns)), {"dropped": 2})
    assert statuses() == [(Level.WARN, "2 dropped"), (Level.OK, "idle")]
    sink.tell(Event(clock.now_ns, "trouble", None, "bus-off"), {"dropped": 2})
    clock.now_ns += 1_500_000_000
    sink.wait()
    sink.wait()
    assert statuses() == [(Level.STALE, "no scan for 2 s; bus-off")]
    sink.tell(Event(clock.now_ns, "well", None, "well again"), {"dropped": 2})
    sink.tell(Event(clock.now_ns, "silent", "5", "another is silent"), {"dropped": 2})
    clock.now_ns += 1_000_000_000
    sink.write(replace(idle, scan=replace(scan, time_ns=clock.now_ns), dead={3: "stuck"}), {"dropped": 2})
    assert statuses() == [(Level.WARN, "without taxel 3 (stuck)")]
    clock.now_ns += 1_000_000_000
    doubtful = {"state": "contact", "trusted": False, "untrusted_reason": "unexplained"}
    sink.write(replace(idle, scan=replace(scan, time_ns=clock.now_ns), **doubtful), {"dropped": 2})
    (status,) = statuses()
    assert status[0] == Level.WARN
    assert status[1].startswith("pattern not to be believed: the pattern does not explain its readings")
    clock.now_ns += 1_000_000_000
    doubt = {"state": "baseline_in_doubt", "contact": None, "notes": (Note("baseline_in_doubt", "why"),)}
    sink.write(replace(idle, scan=replace(scan, time_ns=clock.now_ns), **doubt), {"dropped": 2})
    assert statuses() == [(Level.ERROR, "why")]
    published.clear()
    sink.tell(Event(clock.now_ns, "lost", None, "the plug is out"), {})
    sink.close()
    began_ns = 1_700_000_000_123_456_789
    stamp = published[-1]["header"]["stamp"]
    passed_ns = clock.now_ns - 10**12
    assert stamp["sec"] * 10**9 + stamp["nanosec"] == began_ns + passed_ns, "wall time, from the start's on"


DAYS_NS = 3 * 86_400 * 10**9


def test_what_is_not_of_now_has_the_times_of_its_recording_and_is_not_called_silent():
    """Recorded on a machine that was up for three days more than this one."""
    recorded_ns, offset_ns = time.monotonic_ns() + DAYS_NS, 1_600_000_000 * 10**9
    published, later_ns = [], time.monotonic_ns() + 60 * 10**9
    with pytest.MonkeyPatch.context() as patch:
        for name, value in ENVIRONMENT.items():
            patch.setenv(name, value)
        sink = open_sink("ros2:skin", make_contract(), RunFacts(unix_offset_ns=offset_ns, source="replay"))
    sink._clock_ns = lambda: later_ns
    keep_published(sink, published)
    result = contact(1, source="replay", force_n=1.0)
    sink.write(replace(result, scan=replace(result.scan, time_ns=recorded_ns)), {})
    sink.close()
    stamps = [one["header"]["stamp"] for one in published if "header" in one]
    assert {stamp["sec"] * 10**9 + stamp["nanosec"] for stamp in stamps} == {recorded_ns + offset_ns}
    said = [status for one in published for status in one.get("status", ())]
    assert [status["message"] for status in said] == ["REPLAY, not a sensor", "ended"]
    assert "scan_age_s" not in {pair["key"] for status in said for pair in status["values"]}


def test_an_outage_of_one_link_takes_nothing_from_the_sensors_of_another():
    clock, published = Clock(), []
    sink = Ros2Sink("skin", ENVIRONMENT, clock_ns=clock)
    for name in ("left/4", "right/4"):
        sink.write(contact(1, sensor=name), {})
    keep_published(sink, published)
    for kind, link in (("lost", "left"), ("trouble", "left"), ("well", "right")):
        sink.tell(Event.of(Notice(clock.now_ns, kind, f"{link}: {kind}", f"{link}/")), {})
    assert [one["data"] for one in published if one.get("data") in ("lost", "silent")] == ["lost"]
    clock.now_ns += 1_000_000_000
    sink.wait()
    (left, right) = (status["message"] for one in published for status in one.get("status", ()))
    assert left.endswith("left: lost; left: trouble") and "trouble" not in right
    sink.close()


ROS_TOPIC = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
NAMES = st.text(st.sampled_from("s4x_/é a0Z"), min_size=1, max_size=8)


@given(NAMES, NAMES)
def test_every_sensor_has_topics_of_its_own_that_ros_can_hold(one, other):
    topics = [sensor_topic("skin", name, "pattern") for name in (one, other)]
    assert all(map(ROS_TOPIC.fullmatch, topics)) and "__" not in "".join(topics)
    assert (topics[0] == topics[1]) == (one == other)


@pytest.mark.parametrize(
    ("sensor", "topic"),
    [("4", "s4"), ("left/4", "left/s4"), ("left_1", "left_1"), ("s4", "x_7334"), ("x_1", "x_785f31"), ("/", "x_0/x_0")],
)
def test_sensors_names_as_topics(sensor, topic):
    assert sensor_topic("skin", sensor, "pattern") == f"skin/{topic}/pattern"


def test_names_that_ros_cannot_hold_are_refused():
    assert base_topic("/gripper/skin_1") == "gripper/skin_1"
    with pytest.raises(SinkError, match=rf"ROS holds {LONGEST_TOPIC - 1}: name sensor"):
        sensor_topic("skin", "ä" * 64, "pattern")


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"ROS_DOMAIN_ID": "-1"}, r"ROS_DOMAIN_ID is '-1', expected a whole number from 0 to 232"),
        ({"ROS_DOMAIN_ID": "233"}, r"ROS_DOMAIN_ID is '233'"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "off"}, r"is OFF, which hides edge-sr from other nodes"),
    ],
)
def test_an_environment_that_ros_would_not_take_is_refused(environment, said):
    with pytest.raises(UsageError, match=said):
        Ros2Sink("skin", environment)


def test_a_configuration_that_is_none_is_told(capfd):
    with pytest.raises(SinkError, match=r"cannot join DDS domain 7 .*CYCLONEDDS_URI"):
        nonsense = "<CycloneDDS><Domain><Nonsense/></Domain></CycloneDDS>"
        Ros2Sink("skin", {"ROS_DOMAIN_ID": "7", "CYCLONEDDS_URI": nonsense})


def test_without_the_package_one_line_says_how_to_get_it():
    script = (
        "import sys; sys.modules['cyclonedds'] = None\n"
        "from edge.sinks.registry import open_sink\n"
        "try: open_sink('ros2:skin', None)\n"
        "except ValueError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout == f"ros2:skin needs Cyclone DDS: pip install '{ROOT}[ros2]'\n", done.stderr


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
    assert [check_sink(one) for one in options.sink] == [("ros2", "skin?commands")]
    (node,) = launch.iter("node")
    assert (FILES / node.get("args").removeprefix("-d $(dirname)/")).is_file()


def test_rviz_shows_topics_that_are_published(sink):
    shown = yaml.safe_load((FILES / "skin.rviz").read_text())["Visualization Manager"]
    published = set()
    sink._publish = lambda writer, message: published.add(writer.topic.name.removeprefix("rt"))
    sink._is_read = lambda writer: True
    result = make_wrench_result()
    sink.write(result, {})
    sink.close()  # which withdraws the points
    topics = {one["Topic"]["Value"] for one in shown["Displays"] if "Topic" in one}
    assert topics == {"/skin/s4/points", "/skin/s4/wrench", "/skin/s4/pattern"} and topics <= published
    assert shown["Global Options"]["Fixed Frame"] == result.scan.sensor
    qos = yaml.safe_load((FILES / "play_qos.yaml").read_text())["/tf_static"]
    assert (qos["durability"], qos["reliability"]) == ("transient_local", "reliable")
