"""The sink for ROS 2, and subscribers in processes of their own whose types are made of ROS's .msg files."""

import json
import math
import signal
import time
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from ros2_samples import ENVIRONMENT, TAG, Listener, contact, keep_published, sink, speaker, without_pattern

pytest.importorskip("cyclonedds", reason="of the extra `ros2`")

from edge_samples import fake_source, make_contract, make_wrench_result, wait_for
from sink_samples import every_kind

from edge.api import Command, Commands, Event, patches
from edge.sinks.registry import open_sink
from edge.sinks.ros2 import dds_domain as ros2_domain
from edge.sinks.ros2 import messages as ros_messages
from edge.sinks.ros2.sink import NUMBERS, Ros2Sink
from firmware_bridge.pad_geometry import pad_of
from firmware_bridge.scans.scan import VendorReading
from firmware_bridge.sensor_file.model import PadFrame

__all__ = ["sink"]
IMAGE, WRENCH, STRING = "sensor_msgs/msg/Image", "geometry_msgs/msg/WrenchStamped", "std_msgs/msg/String"
CLOUD, FLOAT, FRAMES = "sensor_msgs/msg/PointCloud2", "std_msgs/msg/Float64", "tf2_msgs/msg/TFMessage"
TOPICS = {
    "skin/s4/taxels": IMAGE,
    "skin/s4/pattern": IMAGE,
    "skin/s4/deviation": IMAGE,
    "skin/s4/points": CLOUD,
    "skin/s4/contacts": CLOUD,
    "skin/s4/wrench": WRENCH,
    "skin/s4/state": STRING,
    "skin/s4/trusted": "std_msgs/msg/Int8",
    "skin/s4/area_m2": FLOAT,
    "skin/s4/centroid": "geometry_msgs/msg/PointStamped",
    "skin/left/s4/pattern": IMAGE,
    "skin/left/s4/wrench": WRENCH,
    "skin/events": STRING,
}


def pixels(image):
    return np.frombuffer(bytes.fromhex(image["data"]), "<f4").reshape(image["height"], image["width"])


def stamp_ns(message):
    return message["header"]["stamp"]["sec"] * 10**9 + message["header"]["stamp"]["nanosec"]


NEWTONS = np.zeros((3, 4, 4), dtype=np.float32)
NEWTONS[:, 1, 3] = 0.25, -0.5, 2.0  # at x 1.5 pitches, y -.5 pitches
VENDOR = VendorReading(newtons=NEWTONS)


class Talker:
    """Writes contacts of two sensors, and keeps what it wrote by its stamp."""

    def __init__(self, sink):
        self.sink, self.number, self.wrote = sink, 0, {}

    def __call__(self):
        self.number += 1
        for sensor, vendor in (("4", VENDOR), ("left/4", None)):
            force_n = None if vendor is None else 2.0
            result = contact(self.number, sensor=sensor, force_n=force_n)
            # Stamped by the device a little before it arrived.
            scan = replace(result.scan, vendor=vendor, device_ns=result.scan.time_ns - 3_000_000)
            result = replace(result, scan=scan, area_mm2=40.0, centroid_mm=(1.5, -2.0), trusted=True)
            self.sink.write(result, {"dropped": 7})
            self.wrote[sensor, result.scan.device_ns + self.sink.unix_offset_ns] = result


def test_subscribers_get_exact_patterns_and_hear_of_their_end(sink):
    """One session, for processes are dear: two sensors, contact, its end, an outage, and the end of it all."""
    with Listener(TOPICS) as listener:
        talker = Talker(sink)
        wanted = TOPICS.keys() - {"skin/events", "skin/left/s4/wrench"}
        listener.until(lambda: all(len(listener.of(topic)) >= 3 for topic in wanted), talker)
        for topic, sensor, name in (
            ("skin/s4/pattern", "4", "pattern"),
            ("skin/s4/deviation", "4", "deviation"),
            ("skin/left/s4/pattern", "left/4", "pattern"),
        ):
            for image in listener.of(topic):
                written = getattr(talker.wrote[sensor, stamp_ns(image)], name)
                np.testing.assert_allclose(pixels(image), written / 1e3, rtol=1e-6)  # metres, of millimetres
                header = {key: image[key] for key in ("encoding", "is_bigendian", "step")}
                assert header == {"encoding": "32FC1", "is_bigendian": 0, "step": 160}
                assert image["header"]["frame_id"] == sensor
        for image in listener.of("skin/s4/taxels"):
            counts = talker.wrote["4", stamp_ns(image)].scan.counts
            assert (pixels(image).reshape(3, 4, 4) == counts).all()
        for cloud in listener.of("skin/s4/points"):
            check_points(cloud, talker.wrote["4", stamp_ns(cloud)])
        for cloud in listener.of("skin/s4/contacts"):
            check_contacts(cloud, talker.wrote["4", stamp_ns(cloud)])
        for message in listener.of("skin/s4/wrench"):
            x, y = 1.5 * 4.7e-3, -0.5 * 4.7e-3
            assert message["wrench"]["force"] == {"x": 0.25, "y": -0.5, "z": 2.0}
            assert [*message["wrench"]["torque"].values()] == pytest.approx([y * 2, -x * 2, x * -0.5 - y * 0.25])
        assert {message["data"] for message in listener.of("skin/s4/state")} == {"contact"}
        assert {message["data"] for message in listener.of("skin/s4/trusted")} == {1}
        assert {message["data"] for message in listener.of("skin/s4/area_m2")} == {4e-5}
        assert listener.of("skin/s4/centroid")[-1]["point"] == {"x": 0.0015, "y": -0.002, "z": 0.0}

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
        listener.until(lambda: np.isnan(pixels(listener.of("skin/s4/deviation")[-1])).all())
        listener.until(lambda: listener.of("skin/s4/points")[-1]["width"] == 0)
        listener.until(lambda: listener.of("skin/s4/contacts")[-1]["width"] == 0)
        listener.until(lambda: listener.of("skin/s4/state")[-1]["data"] == "lost")
        listener.until(lambda: math.isnan(listener.of("skin/s4/area_m2")[-1]["data"]))
        listener.until(lambda: listener.of("skin/s4/trusted")[-1]["data"] == -1)
        assert stamp_ns(unknown) > stamp_ns(zeros)
        events = [json.loads(message["data"]) for message in listener.of("skin/events")]
        assert [(event["event"], event["note"]) for event in events] == [("lost", "the plug is out"), ("lost", "again")]

        sink.write(contact(2000, source="emulated"), {})
        sink.close()
        listener.until(lambda: listener.of("skin/s4/state")[-1]["data"] == "ended")
        listener.until(lambda: np.isnan(pixels(listener.of("skin/s4/pattern")[-1])).all())
        for message in listener.of("skin/s4/wrench"):
            assert np.isfinite([*message["wrench"]["force"].values(), *message["wrench"]["torque"].values()]).all()
        assert not listener.of("skin/left/s4/wrench"), "no newtons are known of it"


def check_points(cloud, result):
    """The cloud of a result, read by nothing but the fields that the message names."""
    assert (cloud["height"], cloud["width"], cloud["is_bigendian"]) == (40, 40, False)
    kinds = [(field["name"], field["datatype"], field["count"], field["offset"]) for field in cloud["fields"]]
    names = ("x", "y", "z", "fx", "fy", "fz", "sigma")
    assert kinds == [(name, 7, 1, 4 * index) for index, name in enumerate(names)]  # 7: FLOAT32
    assert (cloud["point_step"], cloud["row_step"], cloud["is_dense"]) == (28, 1120, result.traction is not None)
    points = np.frombuffer(bytes.fromhex(cloud["data"]), [(name, "<f4") for name in names]).reshape(40, 40)
    places_m = (np.arange(40) - 19.5) * 0.47e-3
    np.testing.assert_allclose(points["x"], np.tile(places_m, (40, 1)), atol=1e-8)
    np.testing.assert_allclose(points["y"], np.tile(places_m, (40, 1)).T, atol=1e-8)
    np.testing.assert_allclose(points["z"], result.pattern / 1e3, rtol=1e-6)
    np.testing.assert_allclose(points["sigma"], result.deviation / 1e3, rtol=1e-6)
    if result.traction is None:
        assert all(np.isnan(points[axis]).all() for axis in ("fx", "fy", "fz"))
        return
    sums = [points[axis].astype(np.float64).sum() for axis in ("fx", "fy", "fz")]
    np.testing.assert_allclose(sums, result.wrench.force_n, rtol=1e-4, atol=1e-4)


def check_contacts(cloud, result):
    """By the fields that the message names, against those of `edge.api.patches`, in SI units."""
    names = [field["name"] for field in cloud["fields"]]
    rows = np.frombuffer(bytes.fromhex(cloud["data"]), [(name, "<f4") for name in names])
    expected = patches(result, make_contract())
    assert len(rows) == len(expected) == cloud["width"] > 0
    for row, one in zip(rows, expected, strict=True):
        assert [row["x"], row["y"], row["z"]] == pytest.approx([*(place / 1e3 for place in one.centre_mm), 0], rel=1e-5)
        assert [row["nx"], row["ny"], row["nz"]] == pytest.approx(one.normal, rel=1e-5)
        assert (row["area"], row["length"]) == pytest.approx((one.area_mm2 / 1e6, one.size_mm[0] / 1e3), rel=1e-5)
        assert math.degrees(row["long_axis"]) == pytest.approx(one.long_axis_deg, rel=1e-5)
        force_n = [math.nan] * 3 if one.force_n is None else one.force_n
        assert [row["fx"], row["fy"], row["fz"]] == pytest.approx(force_n, rel=1e-5, nan_ok=True)


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
            for _ in range(150):  # a megabyte, to one who takes none of it
                talker()
            newest = max(stamp for sensor, stamp in talker.wrote if sensor == "4")
            late.until(lambda: max(map(stamp_ns, late.of("skin/s4/pattern"))) >= newest, talker)
            assert min(map(stamp_ns, late.of("skin/s4/pattern"))) > joined_ns, "an old pattern for one who joined late"
        assert sink.unwritten == 0


def test_each_kind_of_result_is_told(sink):
    published = keep_published(sink)
    for result in every_kind():
        published.clear()
        sink.write(result, {})
        data = [one["data"] for one in published if one.keys() == {"data"} and type(one["data"]) is not float]
        known = {None: -1, False: 0, True: 1}[result.trusted]
        assert data[:2] == [known, result.state] or (result.state == "dropped" and data == [])
        frame = result.scan.sensor if result.source == "device" else f"{result.source}/{result.scan.sensor}"
        images = [one for one in published if "encoding" in one]
        assert {one["header"]["frame_id"] for one in images} == {frame}
        assert (np.isnan(pixels(images[0]).reshape(3, 4, 4)) == ~result.scan.fresh).all(), "no reading is no number"
    sink.write(contact(0), {})
    published.clear()
    sink.write(without_pattern(contact(1), state="baseline_in_doubt", contact=None), {})
    images = [pixels(one) for one in published if one.get("height") == 40]
    assert len(images) == 2 and np.isnan(images).all()


def test_a_force_of_which_a_part_is_not_known_is_no_wrench(sink):
    """Controllers refuse NaN, and counts are no newtons."""
    published, result = keep_published(sink, WRENCH, FLOAT), contact(1)
    vendors = replace(result, scan=replace(result.scan, vendor=VENDOR), force_n=2.0)
    for one, wrenches in (
        (vendors, 1),
        (replace(vendors, force_n=1.9), 0),  # x and y of another calibration than z
        (result, 0),  # counts in place of newtons
    ):
        published.clear()
        sink.write(one, {})
        floats = [message["data"] for message in published if "data" in message]
        assert floats[list(NUMBERS).index("force_z_n")] == pytest.approx(one.force_n or math.nan, nan_ok=True)
        assert sum("wrench" in message for message in published) == wrenches
    assert ros_messages.force_and_torque(vendors, pad_of(3, 3)) is None, "no places"


def test_force_torque_and_numbers_of_a_model_with_traction(sink):
    published, result = keep_published(sink, WRENCH, CLOUD, FLOAT), make_wrench_result()
    result = replace(result, deviation=result.pattern / 10)
    sink.write(result, {})
    (wrench,) = [one["wrench"] for one in published if "wrench" in one]
    assert list(wrench["force"].values()) == list(result.wrench.force_n)
    assert list(wrench["torque"].values()) == [torque / 1000 for torque in result.wrench.torque_n_mm]
    points, contacts = [one for one in published if "fields" in one]
    check_points(points, result)
    check_contacts(contacts, result)
    numbers = dict(zip(NUMBERS, [one["data"] for one in published if type(one.get("data")) is float], strict=True))
    known = {"force_counts": result.force_counts, "force_z_n": result.wrench.force_n[2]}
    known |= {"uncertainty_m": result.interval_mm / 1e3, "shear_ratio": result.wrench.shear_ratio}
    assert numbers == known | {"area_m2": result.area_mm2 / 1e6}


def test_frames_reach_late_readers_and_commands_come_back():
    frames = {"left": PadFrame("tool0", (0.0, 12.5, 50.0), (0.0, 1.0, 0.0, 0.0)), "far": PadFrame("base")}
    commands, asked = Commands(), []
    sink = Ros2Sink("skin", make_contract(), fake_source(frames=frames), commands, environment=ENVIRONMENT)
    for _ in range(2):
        sink.write(contact(1, sensor="left", source="emulated"), {})
    with Listener({"tf_static": FRAMES}) as listener:
        listener.until(lambda: listener.of("tf_static"))
        (placed,) = listener.of("tf_static")[-1]["transforms"]
        assert (placed["header"]["frame_id"], placed["child_frame_id"]) == ("tool0", "emulated/left")
        assert placed["transform"] == {
            "translation": {"x": 0.0, "y": 0.0125, "z": 0.05},
            "rotation": {"x": 0.0, "y": 1.0, "z": 0.0, "w": 0.0},
        }

    with speaker(("skin/zero", STRING), ("skin/reset", STRING)) as say:

        def heard(topic, word, command):
            say(topic, STRING, {"data": word})
            asked.extend(commands.poll())
            return command in asked or (command is None and commands.refused)

        wait_for(lambda: heard("skin/zero", "left", Command("zero", "left")))
        wait_for(lambda: heard("skin/zero", "", Command("zero")))
        wait_for(lambda: heard("skin/reset", "", Command("reset")))
        wait_for(lambda: heard("skin/zero", "a\nb", None))
    sink.close()
    assert commands.poll() == [], "asked of a sink that is closed"


@pytest.mark.parametrize(("text", "listens"), [("ros2:skin", False), ("ros2:skin?commands", True)])
def test_commands_are_taken_only_where_that_was_asked_for(text, listens, monkeypatch):
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    commands, asked = Commands(), []
    commands.ask = asked.append
    open_sink(text, make_contract(), fake_source(), commands=commands).close()
    assert bool(asked) is listens


def test_a_node_that_describes_types_as_fast_dds_does_is_heard():
    """Cyclone DDS compares descriptions, and those of Fast DDS differ; here another Cyclone DDS stands for it."""
    fast_dds = "<IgnoreTypeInformation>1.15</IgnoreTypeInformation>"  # by the vendor's id in the protocol
    assert fast_dds in ros2_domain.configuration({})
    cyclone_dds = f"<Compatibility>{fast_dds.replace('1.15', '1.16')}</Compatibility>"
    there = f",<CycloneDDS><Domain>{cyclone_dds}</Domain></CycloneDDS>"
    environment = ENVIRONMENT | {"CYCLONEDDS_URI": TAG + there}
    with closing(Ros2Sink("skin", make_contract(), fake_source("device"), environment=environment)) as sink:
        talker = Talker(sink)
        with Listener({"skin/s4/pattern": IMAGE}, "signed-bytes", more=there) as listener:
            listener.until(lambda: listener.of("skin/s4/pattern"), talker)
            message = listener.of("skin/s4/pattern")[-1]
            np.testing.assert_allclose(pixels(message), talker.wrote["4", stamp_ns(message)].pattern / 1e3, rtol=1e-6)


def test_a_wrench_ends_with_its_contact_and_is_never_nan(sink):
    published = keep_published(sink)

    def forces():
        found = [one["wrench"]["force"]["z"] for one in published if "wrench" in one]
        published.clear()
        return found

    pressed = make_wrench_result()
    idle = without_pattern(contact(1), state="idle", contact=False)
    lost = Event(time.monotonic_ns(), "lost", None, "the plug is out")
    z_n = pressed.wrench.force_n[2]
    newer_waits = replace(idle, state="dropped")
    for result, shown in ((pressed, [z_n]), (newer_waits, []), (idle, [0.0]), (idle, []), (pressed, [z_n])):
        sink.write(result, {})
        assert forces() == shown
    sink.tell(lost, {})
    (said,) = (json.loads(one["data"]) for one in published if str(one.get("data")).startswith("{"))
    assert (said["event"], said["source"]) == ("lost", "device")
    assert forces() == [], "nothing is known, and there is no number for that"
    sink.write(replace(idle, state="incomplete", contact=None), {})
    sink.close()
    assert forces() == []
