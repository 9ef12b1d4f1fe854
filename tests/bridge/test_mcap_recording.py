"""Recordings in MCAP: read by public packages, played again bit for bit, whole whatever ended their writer."""

import hashlib
import json
import threading
import time
from dataclasses import replace
from functools import partial, reduce
from pathlib import Path, PosixPath
from types import SimpleNamespace

import numpy as np
import pytest
from edge_samples import BASELINE, ROOT, FakeModel, fake_source, make_scan, make_wrench_result, wait_for
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_samples import (
    OFFSET_NS,
    SURE,
    TURNED,
    content,
    make_results,
    messages_alone,
    messages_of,
    odd_scans,
    record_into,
)

from edge import api
from edge.api import open_recording, open_runtime, open_source
from edge.perception.event import Event
from edge.perception.runtime import Runtime
from edge.pipeline.result_stream import Stream
from edge.sinks import mcap
from edge.sinks.mcap import McapSink
from edge.sinks.registry import open_sink
from edge.sinks.ros2 import messages as ros_messages
from edge.sinks.ros2.map_messages import in_si, recorded_map
from firmware_bridge.errors import RecordingError
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.pad_geometry import SensorGeometry
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.scan_messages import SENSOR, decode_baseline, decode_scan
from firmware_bridge.recording.tracks import mounting_text
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.sensor_file.model import PadFrame, SensorEntry, SensorFile
from firmware_bridge.sensor_file.toml_writer import save_sensor_file


class HangingDisk(PosixPath):
    """Path of a file that takes nothing until the disk is mended, or so long."""

    hangs_s: float | None = None

    def open(self, *how, **settings):
        self.mended, file = threading.Event(), super().open(*how, **settings)

        def write(data):
            self.mended.wait(self.hangs_s)
            return file.write(data)

        return SimpleNamespace(write=write, close=file.close, fileno=file.fileno)


class TestSink:
    def test_the_public_package_finds_all_that_was_said(self, tmp_path):
        scans = odd_scans()
        results = make_results(scans, counts_per_newton=1000.0)
        path = record_into(tmp_path / "out.mcap", results)
        by_topic = messages_of(path)
        for sensor, topic in (("4", "/s4"), ("left/6", "/left/s6")):
            own = [result for result in results if result.scan.sensor == sensor]
            for (at, data), one in zip(by_topic[f"{topic}/scan"], own, strict=True):
                assert at == one.scan.time_ns + OFFSET_NS and (decode_scan(data).counts == one.scan.counts).all()
            for name in ("pattern", "deviation"):
                maps = [recorded_map(data).tobytes() for _, data in by_topic[f"{topic}/{name}"]]
                made = [in_si(name, getattr(one, name)).tobytes() for one in own if one.pattern is not None]
                assert maps == made != []
            said = [json.loads(ros_messages.RESULT.decode(data)["record"]) for _, data in by_topic[f"{topic}/result"]]
            assert [one["scan"] for one in said] == [one.scan.number for one in own]
            assert [one["counters"]["dropped"] for one in said if "counters" in one] == [2]
            assert any(one.force_n is not None for one in own) and f"{topic}/wrench" not in by_topic, "x, y unknown"
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            assert reader.get_header().profile == "ros2"
            metadata = {one.name: one.metadata for one in reader.iter_metadata()}
        assert summary.statistics.message_count == sum(map(len, by_topic.values()))
        assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}, "ros2 bag wants one"
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        assert json.loads(metadata["contract"]["counts_per_unit"]) == [500.0, 500.0, 1000.0]
        facts = json.loads(SENSOR.decode(by_topic["/s4/sensor"][0][1])["facts"])
        assert json.loads(facts["geometry"]["pitch_mm"]) == 4.7 and facts["source"] == {"kind": "device"}

    def test_a_baseline_is_recorded_from_its_first_use_and_noted(self, tmp_path):
        results = make_results([make_scan(number, noise=3) for number in range(6)])
        other = replace(BASELINE.moved(np.full((3, 4, 4), 0.1)), origin="demand", id="other")
        results = [*results[:3], *(replace(one, baseline=other, baseline_age_s=None) for one in results[3:])]
        path = record_into(tmp_path / "out.mcap", results)
        said = messages_of(path)["/s4/baseline"]
        assert [at - OFFSET_NS for at, _ in said] == [results[0].scan.time_ns, results[3].scan.time_ns]
        for (_, data), baseline in zip(said, (BASELINE, other), strict=True):
            got = decode_baseline(data)
            assert got.counts.tobytes() == baseline.counts.tobytes()
            assert (got.id, got.created_unix_s, got.scans) == (baseline.id, 1000.0, 100)
        link = ReplayLink([path])
        (note,) = link.notices()
        assert f"zeroed again while it was recorded ({BASELINE.id}, then other)" in note.text
        assert note.kind == "note" and not link.notices()

    def test_a_clock_that_is_set_moves_no_record(self, tmp_path, monkeypatch):
        now_ns = time.monotonic_ns()
        results = make_results([make_scan(number, time_ns=now_ns + number) for number in range(2)])
        before_ns = time.time_ns()
        sink = open_sink(f"mcap:{tmp_path}/out.mcap", SURE, fake_source())
        sink.write(results[0], {})
        monkeypatch.setattr(time, "time_ns", lambda: 0)
        sink.write(results[1], {})
        wait_for(lambda: sink.wait() or sink.scans)
        assert len(load_recording(tmp_path / "out.mcap").tracks[0].counts) == 2, "on the disk though no scan follows"
        sink.close()
        first, second = (at for at, _ in messages_of(tmp_path / "out.mcap")["/s4/scan"])
        assert second == first + 1 and abs(first - before_ns) < 60 * 10**9

    @pytest.mark.parametrize("lossless", [True, False])
    def test_a_disk_that_hangs_is_waited_for_by_the_lossless_alone(self, tmp_path, limits, lossless):
        limits(mcap, MOST_WAITING_BYTES=20_000, MOST_CHUNK_BYTES=2_000)
        path = HangingDisk(tmp_path / "out.mcap")
        path.hangs_s = 0.05 if lossless else None
        results = make_results([make_scan(number) for number in range(50)])
        sink = McapSink(path, SURE, fake_source("replay" if lossless else "device"))
        for result in results:
            sink.write(result, {})
        left_out = sink.unwritten
        assert (left_out == 0) == lossless and left_out < 50
        path.mended.set()
        sink.close()
        [track] = load_recording(tmp_path / "out.mcap").tracks
        np.testing.assert_array_equal(track.counts, [result.scan.counts for result in results[: 50 - left_out]])


class TestReplay:
    def test_scans_come_back_bit_for_bit_at_their_times(self, tmp_path):
        scans = odd_scans()
        path = record_into(tmp_path / "out.mcap", make_results(scans), mountings={"4": TURNED})
        link = ReplayLink([path], paced=False)
        (recording,) = link.recordings
        assert recording.unix_offset_ns == link.unix_offset_ns == OFFSET_NS
        assert dict(recording.mountings) == {"4": TURNED} and recording.notes == ()
        assert {name: one.id for name, one in recording.baselines.items()} == {"4": BASELINE.id, "left/6": BASELINE.id}
        got = []
        with link:
            while not link.ended:
                read = link.read(0.1)
                assert len(read) == 1, "one for each read: nothing is overtaken"
                got += read
        assert list(map(content, got)) == list(map(content, scans))

    @pytest.mark.parametrize("named", ["", "left="])
    def test_it_sits_as_it_sat_however_it_is_played(self, tmp_path, named):
        scans = [make_scan(number, press_counts=3000, noise=1) for number in range(3)]
        results = make_results(scans, mountings={"4": TURNED})
        path = record_into(tmp_path / "turned.mcap", results, mountings={"4": TURNED})
        sensor = f"{named.replace('=', '/')}4"
        with open_source(f"{named}replay:{path}", rate_hz=1000) as source:
            baselines = {sensor: replace(BASELINE, sensor=sensor)}
            runtime = open_runtime(FakeModel(SURE), source, baselines=baselines, every_scan=True)
            again = list(Stream(source, runtime))
        assert [one.zeroed.tobytes() for one in again] == [one.zeroed.tobytes() for one in results]
        assert {note.kind for one in again for note in one.notes} <= {"not_checked", "late"}
        save_sensor_file(tmp_path / "other.toml", SensorFile(sensors={sensor: SensorEntry(Mounting(signs=(-1, 1, 1)))}))
        with open_source(f"{named}replay:{path}", sensor=tmp_path / "other.toml") as source:
            assert source.sensor_file.mountings == {sensor: Mounting(signs=(-1, 1, 1))}, "the file goes before"


# In other people's programs: public readers, and the layouts of viewers.


FRAMES = {"4": PadFrame("tool0", (0, 0, 50.5))}


def decoded(path):
    """Return the last message and the metadata of each topic, by the definitions in the file alone."""
    with path.open("rb") as file:
        found = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        return {channel.topic: (message, channel.metadata) for _, channel, _, message in found}


def test_public_readers_find_units_frames_and_marks(tmp_path):
    results = [replace(one, source="emulated") for one in make_results(odd_scans())]
    scans = [replace(one.scan, device_ns=one.scan.time_ns - 2_000_000) for one in results]
    results = [replace(one, scan=scan) for one, scan in zip(results, scans, strict=True)]
    found = decoded(record_into(tmp_path / "press.mcap", results, frames=FRAMES))
    messages = {topic: message for topic, (message, _) in found.items()}
    units = [found[topic][1].get("unit") for topic in ("/s4/pattern", "/left/s6/deviation", "/s4/scan")]
    assert units == ["m", "m", None]
    for what in ("scan", "result", "pattern", "deviation", "baseline"):
        for sensor in ("4", "left/6"):
            message = messages[f"/{'s4' if sensor == '4' else 'left/s6'}/{what}"]
            frame = message.frame_id if what in ("pattern", "deviation") else message.header.frame_id
            assert frame == f"emulated/{sensor}", "a scan of no sensor that is not marked"
    (transform,) = messages["/tf_static"].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("tool0", "emulated/4")
    assert transform.transform.translation.z == 0.0505 and transform.transform.rotation.w == 1
    newest = [one for one in results if one.scan.sensor == "4" and one.pattern is not None][-1]
    pattern = messages["/s4/pattern"]
    assert np.frombuffer(bytes(pattern.data), "<f4").max() == np.float32(newest.pattern.max()) * np.float32(1e-3)
    rows, pitch_m = len(pattern.data) // pattern.row_stride, pattern.cell_size.x
    assert rows * pitch_m == pattern.column_count * pitch_m == pytest.approx(4 * 4.7e-3), "on the whole face, in metres"
    assert pattern.pose.position.x == pattern.pose.position.y == pytest.approx(-2 * 4.7e-3), "about its middle"
    stamp_ns = pattern.timestamp.sec * 10**9 + pattern.timestamp.nanosec
    assert stamp_ns == newest.scan.device_ns + OFFSET_NS, "of arrival, though the device states a time"


def test_the_layout_for_foxglove_shows_what_a_recording_holds(tmp_path):
    layout = json.loads((ROOT / "examples/viewers/foxglove.json").read_text())
    sink = McapSink(tmp_path / "press.mcap", SURE, fake_source(frames=FRAMES))
    result = make_wrench_result()
    sink.write(replace(result, deviation=result.pattern / 10), {})
    sink.tell(Event(time.monotonic_ns(), "note", None, "hello"), {})
    sink.close()
    recorded = decoded(tmp_path / "press.mcap")
    panels = layout["configById"]

    maps = {topic: shown for panel in panels.values() for topic, shown in panel.get("topics", {}).items()}
    assert maps.keys() == {"/s4/pattern", "/s4/deviation"}
    for topic, shown in maps.items():
        assert [field.name for field in recorded[topic][0].fields] == [shown["colorField"]]
        assert shown["maxValue"] < 1e-3, "in metres"
    paths = [line["value"] for panel in panels.values() for line in panel.get("paths", ())]
    assert len(paths) == 7
    for path in paths:
        topic, *fields = path.split(".")
        assert isinstance(reduce(getattr, fields, recorded[topic][0]), float), path
    assert panels["RosOut!events"]["topicToRender"] in recorded and "/tf_static" in recorded


# Recordings that a tool has copied in part: messages alone, some of their topics, or those from some time on.


PERIOD_NS = 50_000_000


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """Three seconds of a sensor that sits turned, and of one that does not."""
    scans = [
        make_scan(number, sensor=name, time_ns=(number + 1) * PERIOD_NS, press_counts=3000, noise=2)
        for number in range(60)
        for name in ("4", "left/6")
    ]
    results = make_results(scans, mountings={"4": TURNED})
    return record_into(tmp_path_factory.mktemp("turned") / "turned.mcap", results, mountings={"4": TURNED})


def patterns(path):
    with open_recording(path) as source:
        runtime = open_runtime(FakeModel(SURE), source, every_scan=True)
        results = list(Stream(source, runtime))
    return [(one.scan.time_ns, one.zeroed.tobytes()) for one in results]


@pytest.mark.parametrize("start_ns", [0, OFFSET_NS + 21 * PERIOD_NS + 1])
def test_messages_alone_give_the_same_patterns(turned, tmp_path, start_ns):
    part = messages_alone(turned, tmp_path / "part.mcap", start_ns=start_ns)
    recording = load_recording(part)
    assert recording.origin == "device" and recording.notes == () and dict(recording.mountings) == {"4": TURNED}
    assert {name: one.id for name, one in recording.baselines.items()} == {"4": BASELINE.id, "left/6": BASELINE.id}
    assert patterns(part) == [one for one in patterns(turned) if one[0] + OFFSET_NS >= start_ns]


def test_a_baseline_of_later_is_none_of_the_beginning(tmp_path):
    results = make_results([make_scan(number, time_ns=(number + 1) * PERIOD_NS) for number in range(60)])
    taken = replace(BASELINE, created_unix_s=(OFFSET_NS + 30 * PERIOD_NS) / 1e9)
    results = [replace(one, baseline=taken if number >= 30 else None) for number, one in enumerate(results)]
    assert load_recording(record_into(tmp_path / "zeroed.mcap", results)).baselines == {}


@pytest.mark.parametrize(
    ("kind", "copy"),
    [
        *(("device", Path.rename), ("emulated", Path.rename), ("emulated", messages_alone)),
        ("emulated", partial(messages_alone, topics="/s4/scan")),
    ],
)
def test_an_emulated_sensor_stays_one_in_every_generation(tmp_path, kind, copy):
    path = record_into(tmp_path / "first.mcap", make_results([make_scan()], source=kind))
    for generation in range(3):
        path = copy(path, tmp_path / f"{generation}-copy.mcap")
        recording = load_recording(path)
        assert recording.origin == kind
        assert (f"{path} was recorded from an emulated sensor" in recording.notes) == (kind == "emulated")
        with open_recording(path) as source:
            path = tmp_path / f"{generation}.mcap"
            sink = api.open_sink(f"mcap:{path}", SURE, source)
            for result in Stream(source, Runtime(FakeModel(SURE), source=source.kind)):
                assert result.source == "replay"
                sink.write(result, {})
            sink.close()


def test_another_pad_is_known_without_metadata(tmp_path):
    geometry, grid = SensorGeometry("mine", 5, 5, 5.0, 30.0, 30.0), (5, 5)
    baseline = replace(BASELINE, counts=np.full((3, *grid), 30_000.0, np.float32))
    sink = McapSink(tmp_path / "a.mcap", SURE, fake_source(unix_offset_ns=OFFSET_NS, geometry=geometry))
    result = make_results([make_scan()])[0]
    counts, fresh = np.full((3, *grid), 30_000, np.int32), np.ones(grid, bool)
    scan = replace(result.scan, counts=counts, fresh=fresh, renewed=fresh)
    sink.write(replace(result, scan=scan, baseline=baseline, pattern=None), {})
    sink.close()
    recording = load_recording(messages_alone(tmp_path / "a.mcap", tmp_path / "b.mcap"))
    assert recording.tracks[0].geometry == geometry


def test_two_mountings_of_one_sensor_are_refused(turned, tmp_path):
    straight = record_into(tmp_path / "straight.mcap", make_results([make_scan()]), mountings={"4": Mounting()})
    with pytest.raises(RecordingError, match="two mountings of sensor '4'"):
        load_recording(messages_alone(turned, tmp_path / "both.mcap", more=straight))


def test_recordings_of_before_stay_readable(tmp_path):
    """The reader takes the messages of a recording by the text of their definition, comments and all."""
    path = record_into(tmp_path / "press.mcap", make_results([make_scan(0)]))
    with path.open("rb") as file:
        schemas = make_reader(file).get_summary().schemas.values()
    texts = {schema.name.rpartition("/")[2]: hashlib.sha256(schema.data).hexdigest()[:12] for schema in schemas}
    recorded = {"Scan": "6a35e40d3860", "Baseline": "e3ede75454cb", "Sensor": "54829f0a30b8"}
    assert recorded.items() <= texts.items()


def test_the_mounting_and_the_origin_in_metadata_are_read(turned, tmp_path):
    """As the first release made it: what is known of its sensors in metadata, not in messages."""
    topics, text = ("/s4/scan", "/s4/baseline"), mounting_text(TURNED)
    records = {"mounting": {"sensor": "4", "mounting": text}, "source": {"kind": "emulated"}}
    recording = load_recording(messages_alone(turned, tmp_path / "first.mcap", topics, metadata=records))
    assert (recording.origin, dict(recording.mountings)) == ("emulated", {"4": TURNED})
    assert not any("is not in the file" in note for note in recording.notes)
    records["mounting"]["mounting"] = json.dumps(json.loads(text) | {"gains": [1.0] * 47 + [0.9]})
    gained = messages_alone(turned, tmp_path / "gained.mcap", topics, metadata=records)
    with pytest.raises(RecordingError, match="no mounting of sensor '4': it has gains, which this release does not"):
        load_recording(gained)


def test_a_baseline_of_an_undated_recording_has_no_age_today(tmp_path):
    sink = McapSink(tmp_path / "undated.mcap", SURE, fake_source(unix_offset_ns=0))
    for result in make_results([make_scan(number, time_ns=(number + 1) * PERIOD_NS) for number in range(3)]):
        sink.write(result, {})
    sink.close()
    for paced in (True, False):
        source = open_recording(tmp_path / "undated.mcap", paced=paced)
        baseline = source.sensor_file.baselines["4"]
        assert (baseline.id, np.isnan(baseline.created_unix_s)) == (BASELINE.id, paced)
