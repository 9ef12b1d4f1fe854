"""The sink for ROS 2, and subscribers in processes of their own whose types are made of ROS's .msg files."""

import json
import math
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from ros2_samples import ENVIRONMENT, TAG, contact, keep_published, sink, without_pattern

pytest.importorskip("cyclonedds", reason="of the extra `ros2`")

import ros2_messages
from edge_samples import ROOT, make_contract, make_wrench_result

from edge.perception.event import Event
from edge.sinks.registry import open_sink
from edge.sinks.ros2 import cdr_messages as ros_messages
from edge.sinks.ros2 import dds_domain as ros2_domain
from edge.sinks.ros2.dds_types import TYPE_HASHES, dds_type
from edge.sinks.ros2.diagnostics import Level, diagnose
from edge.sinks.ros2.sink import Ros2Sink
from firmware_bridge.scans.scan import VendorReading

__all__ = ["sink"]
LISTENERS_CONFIGURATION = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex><Peers><Peer address="localhost"/></Peers></Discovery>'
    f"</Domain></CycloneDDS>,{TAG}"
)
PATIENCE_S = 20
IMAGE, WRENCH = "sensor_msgs/msg/Image", "geometry_msgs/msg/WrenchStamped"
TOPICS = {
    "skin/s4/pattern": IMAGE,
    "skin/s4/deviation": IMAGE,
    "skin/s4/wrench": WRENCH,
    "skin/left/s4/pattern": IMAGE,
    "skin/left/s4/wrench": WRENCH,
    "skin/events": "std_msgs/msg/String",
    "diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}


class Listener:
    """A subscriber; its lines are kept as they come."""

    def __init__(self, topics, *words):
        environment = os.environ | {
            "CYCLONEDDS_URI": LISTENERS_CONFIGURATION,
            "PYTHONPATH": f"{ROOT}:{ROOT / 'tests/support'}",
        }
        command = [sys.executable, str(ROOT / "tests/support/ros2_listener.py"), ENVIRONMENT["ROS_DOMAIN_ID"]]
        self.process = subprocess.Popen(
            [*command, json.dumps(topics), *words], env=environment, stdout=subprocess.PIPE, text=True
        )
        self.heard = []
        self._lines = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            self._lines.put(json.loads(line))

    def of(self, topic):
        self._keep()
        return [line["message"] for line in self.heard if line["topic"] == topic]

    def _keep(self):
        while not self._lines.empty():
            self.heard.append(self._lines.get())

    def until(self, satisfied, act=lambda: None):
        """Go on acting until the messages that were received suffice."""
        end_s = time.monotonic() + PATIENCE_S
        while not satisfied():
            assert time.monotonic() < end_s, f"heard only {[line['topic'] for line in self.heard]}"
            assert self.process.poll() is None
            act()
            time.sleep(0.01)

    def __enter__(self):
        self.until(lambda: self._keep() or self.heard)
        return self

    def __exit__(self, *exc_info):
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()


def pixels(image):
    return np.frombuffer(bytes.fromhex(image["data"]), "<f4").reshape(image["height"], image["width"])


def stamp_ns(message):
    return message["header"]["stamp"]["sec"] * 10**9 + message["header"]["stamp"]["nanosec"]


class Talker:
    """Writes contacts of two sensors, and keeps what it wrote by its stamp."""

    def __init__(self, sink, **changes):
        self.sink, self.number, self.wrote = sink, 0, {}
        self._changes = changes

    def __call__(self):
        self.number += 1
        for sensor, force_n in (("4", 1.5), ("left/4", None)):
            result = contact(self.number, sensor=sensor, force_n=force_n, **self._changes)
            self.sink.write(result, {"dropped": 7})
            self.wrote[sensor, result.scan.time_ns + self.sink._unix_offset_ns] = result


def test_subscribers_get_patterns_bit_for_bit_and_hear_when_they_hold_no_more(sink):
    """One session, for processes are dear: two sensors, contact, its end, an outage, and the end of it all."""
    with Listener(TOPICS) as listener:
        talker = Talker(sink)
        wanted = TOPICS.keys() - {"skin/events", "skin/left/s4/wrench"}
        listener.until(lambda: all(len(listener.of(topic)) >= 3 for topic in wanted - {"diagnostics"}), talker)
        for topic, sensor, name in (
            ("skin/s4/pattern", "4", "pattern"),
            ("skin/s4/deviation", "4", "deviation"),
            ("skin/left/s4/pattern", "left/4", "pattern"),
        ):
            for image in listener.of(topic):
                written = getattr(talker.wrote[sensor, stamp_ns(image)], name)
                assert pixels(image).tobytes() == written.tobytes()
                header = {key: image[key] for key in ("encoding", "is_bigendian", "step")}
                assert header == {"encoding": "32FC1", "is_bigendian": 0, "step": 160}
                assert image["header"]["frame_id"] == sensor
        for message in listener.of("skin/s4/wrench"):
            force, torque = message["wrench"]["force"], message["wrench"]["torque"]
            assert force["z"] == 1.5 and all(map(math.isnan, (force["x"], force["y"], *torque.values())))

        # The end of a contact is reported once, by zeros; lost readings by NaN.
        four = contact(1000)
        sink.write(without_pattern(four, state="dropped"), {})
        for _ in range(3):
            sink.write(without_pattern(four, state="idle", contact=False), {})
        sink.tell(Event(time.monotonic_ns(), "lost", None, "the plug is out"), {})
        sink.tell(Event(time.monotonic_ns(), "lost", None, "again"), {})
        ends = {"4": "skin/s4/pattern", "left/4": "skin/left/s4/pattern"}
        listener.until(lambda: len(listener.of("skin/events")) == 2)

        def extraordinary(sensor):
            return [image for image in listener.of(ends[sensor]) if (sensor, stamp_ns(image)) not in talker.wrote]

        listener.until(lambda: all(map(extraordinary, ends)))
        (zeros,), (unknown,) = extraordinary("4"), extraordinary("left/4")
        assert not pixels(zeros).any() and np.isnan(pixels(unknown)).all()
        assert np.isnan(pixels(listener.of("skin/s4/deviation")[-1])).all()
        assert stamp_ns(unknown) > stamp_ns(zeros)
        events = [json.loads(message["data"]) for message in listener.of("skin/events")]
        assert [(event["event"], event["note"]) for event in events] == [("lost", "the plug is out"), ("lost", "again")]

        sink.write(contact(2000, source="emulated"), {})
        sink.close()
        listener.until(lambda: [a for a in listener.of("diagnostics") if a["status"][0]["message"] == "ended"])
        statuses = {status["hardware_id"]: status for status in listener.of("diagnostics")[-1]["status"]}
        assert {name: status["name"] for name, status in statuses.items()} == {"4": "skin: 4", "left/4": "skin: left/4"}
        assert {status["level"] for status in statuses.values()} == {Level.STALE}
        assert np.isnan(pixels(listener.of("skin/s4/pattern")[-1])).all(), "left standing by a program that has ended"
        last = listener.of("skin/s4/wrench")[-1]["wrench"]["force"]
        assert all(map(math.isnan, last.values())), "of a contact that has ended"
        assert not listener.of("skin/left/s4/wrench"), "no newtons are known of it"


def test_who_joins_late_stops_or_dies_holds_up_nobody(sink):
    topics = {"skin/s4/pattern": IMAGE}
    with Listener(topics) as stopped, Listener(topics) as dead:
        talker = Talker(sink)
        stopped.until(lambda: stopped.of("skin/s4/pattern") and dead.of("skin/s4/pattern"), talker)
        stopped.process.send_signal(signal.SIGSTOP)
        dead.process.kill()
        joined_ns = time.time_ns()
        with Listener(topics, "best-effort") as late:
            late.until(lambda: len(late.of("skin/s4/pattern")) >= 5, talker)
            for _ in range(300):  # two megabytes, to one who takes none of it
                talker()
            newest = max(stamp for sensor, stamp in talker.wrote if sensor == "4")
            late.until(lambda: max(map(stamp_ns, late.of("skin/s4/pattern"))) >= newest, talker)
            assert min(map(stamp_ns, late.of("skin/s4/pattern"))) > joined_ns, "an old pattern for one who joined late"
        assert sink.unwritten == 0


def test_of_another_source_than_a_sensor_the_frame_and_the_diagnostics_tell(sink):
    result = contact(1, source="emulated")
    sink.write(result, {})
    assert sink._sensors["4"].frame == "emulated/4"
    said = diagnose(result, {}, {}, 0.0, None)
    assert said.level == Level.WARN and said.text == "EMULATED, not a sensor"


def test_forces_of_the_vendor_have_three_axes_and_counts_are_no_newtons(sink):
    published = []
    keep_published(sink, published, WRENCH)
    newtons = np.zeros((3, 4, 4), dtype=np.float32)
    newtons[:, 1, 1] = 0.25, -0.5, 2.0
    result = contact(1)
    scan = replace(result.scan, vendor=VendorReading(newtons=newtons))
    sink.write(replace(result, scan=scan, force_n=2.0), {})
    sink.write(replace(result, scan=scan, force_n=1.9), {})
    sink.write(result, {})
    forces = [message["wrench"]["force"] for message in published]
    assert forces[0] == {"x": 0.25, "y": -0.5, "z": 2.0}
    assert math.isnan(forces[1]["x"]) and forces[1]["z"] == 1.9, "z of one calibration beside x and y of another"
    assert len(forces) == 3 and math.isnan(forces[2]["z"]), "counts in place of newtons"
    assert diagnose(result, {}, {}, 0.0, None).values["force"].startswith("counts only")


def test_subscribers_get_force_and_torque_of_a_model_with_traction_until_they_hold_no_more(sink):
    result, free = make_wrench_result(), make_wrench_result(press_counts=0)
    assert result.wrench is not None
    torque_n_m = [torque / 1000 for torque in result.wrench.torque_n_mm]
    with Listener({"skin/s4/wrench": WRENCH}) as listener:
        listener.until(lambda: listener.of("skin/s4/wrench"), lambda: sink.write(result, {}))
        for message in listener.of("skin/s4/wrench"):
            assert list(message["wrench"]["force"].values()) == list(result.wrench.force_n)
            assert list(message["wrench"]["torque"].values()) == torque_n_m
        sink.write(free, {})
        listener.until(lambda: math.isnan(listener.of("skin/s4/wrench")[-1]["wrench"]["force"]["z"]))
        assert all(map(math.isnan, listener.of("skin/s4/wrench")[-1]["wrench"]["torque"].values()))


def test_two_sinks_share_the_domain_and_one_outlives_the_other(sink):
    other = open_sink_in(ENVIRONMENT, "ros2:other/skin")
    other.write(contact(1), {})
    other.close()
    with Listener({"skin/s4/pattern": IMAGE}) as listener:
        listener.until(lambda: listener.of("skin/s4/pattern"), Talker(sink))
    assert int(ENVIRONMENT["ROS_DOMAIN_ID"]) in ros2_domain._OPEN
    sink.close()
    assert int(ENVIRONMENT["ROS_DOMAIN_ID"]) not in ros2_domain._OPEN, "threads and sockets are left behind"


def open_sink_in(environment, text):
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        return open_sink(text, make_contract())


def test_a_force_that_is_known_no_more_is_taken_back_once():
    published = []
    sink = Ros2Sink("skin", ENVIRONMENT, source="emulated")
    keep_published(sink, published)

    def taken_back():
        forces = [one["wrench"]["force"] for one in published if "wrench" in one]
        published.clear()
        return [math.isnan(force["z"]) for force in forces]

    idle = without_pattern(contact(1, force_n=0.1), state="idle", contact=False)
    lost = Event(time.monotonic_ns(), "lost", None, "the plug is out")
    sink.write(idle, {})
    assert taken_back() == [False]
    sink.tell(lost, {})
    (said,) = (json.loads(one["data"]) for one in published if one.keys() == {"data"})
    assert (said["event"], said["source"]) == ("lost", "emulated")
    assert taken_back() == [True]
    sink.tell(lost, {})
    assert taken_back() == []
    sink.write(idle, {})
    sink.write(replace(idle, state="dropped", force_n=None), {})  # of a newer scan it is available
    assert taken_back() == [False]
    for _ in range(2):
        sink.write(replace(idle, state="incomplete", contact=None, force_n=None), {})
    assert taken_back() == [True]
    sink.write(idle, {})
    sink.close()
    assert taken_back() == [False, True]


KINDS = (ros_messages.IMAGE, ros_messages.WRENCH_STAMPED, ros_messages.DIAGNOSTIC_ARRAY, ros_messages.STRING)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_types_are_called_described_and_hashed_as_ros_does(kind):
    ours, theirs = dds_type(kind), ros2_messages.dds_type(kind.name)
    assert ours.__idl__.idl_transformed_typename == theirs.__idl__.idl_transformed_typename
    assert ours.__idl__.get_type_info() == theirs.__idl__.get_type_info(), "names and types of all fields"
    assert TYPE_HASHES.keys() == {one.name for one in KINDS}
    assert TYPE_HASHES[kind.name] == ros2_messages.type_hash(kind.name)


def test_bytes_on_the_wire_are_plain_cdr(sink):
    published = []
    sink._publish = lambda writer, message: published.append(message)
    result = contact(3, force_n=1.25, events=(Event(3, "refused", "4", "not done, ä"),))
    sink.write(result, {"dropped": 1})
    sink._diagnose()
    pattern, deviation, wrench, event, diagnostics = published
    image = ros2_messages.decode(IMAGE, pattern)
    assert bytes(image.pop("data")) == result.pattern.tobytes()
    assert bytes(ros2_messages.decode(IMAGE, deviation)["data"]) == result.deviation.tobytes()
    stamp = dict(zip(("sec", "nanosec"), divmod(result.scan.time_ns + sink._unix_offset_ns, 10**9), strict=True))
    header = {"stamp": stamp, "frame_id": "4"}
    expected = {"height": 40, "width": 40, "encoding": "32FC1", "is_bigendian": 0, "step": 160}
    assert image == {"header": header, **expected}
    decoded = ros2_messages.decode(WRENCH, wrench)
    assert decoded["header"] == header and decoded["wrench"]["force"]["z"] == 1.25
    said = json.loads(ros2_messages.decode("std_msgs/msg/String", event)["data"])
    assert (said["event"], said["sensor"], said["note"]) == ("refused", "4", "not done, ä")
    assert said["counters"] == {"dropped": 1}
    (status,) = ros2_messages.decode("diagnostic_msgs/msg/DiagnosticArray", diagnostics)["status"]
    values = {pair["key"]: pair["value"] for pair in status["values"]}
    assert status["level"] == Level.WARN and status["message"] == "1 dropped"
    assert (values["state"], values["pattern_unit"], values["force_n"]) == ("contact", "mm", "1.25")


def test_messages_are_the_bytes_that_cyclonedds_makes_of_the_same_values(sink):
    """The types are made of ROS's .msg files, so the definitions of the sink have no part in them."""
    published = []
    sink._publish = lambda writer, message: published.append(message)
    sink.write(contact(3, force_n=1.25, events=(Event(3, "refused", "4", "not done, ä"),)), {"dropped": 1})
    sink._diagnose()
    names = (IMAGE, IMAGE, WRENCH, "std_msgs/msg/String", "diagnostic_msgs/msg/DiagnosticArray")
    for name, sent in zip(names, published, strict=True):
        again = ros2_messages.dds_type(name).deserialize(sent).serialize(use_version_2=False)
        assert again[: len(sent)] == sent and not any(again[len(sent) :]) and len(again) - len(sent) < 4


def test_recordings_hold_the_same_bytes(sink):
    published = []
    sink._publish = lambda writer, message: published.append(message)
    result = contact(3, force_n=1.25)
    sink.write(result, {})
    unix_ns = result.scan.time_ns + sink._unix_offset_ns
    recorded = [ros_messages.image(values, "4", unix_ns) for values in (result.pattern, result.deviation)]
    assert published == [*recorded, ros_messages.wrench(result, unix_ns)]
