"""Recordings in MCAP: read with the public package, played again bit for bit, whole whatever ended their writer."""

import itertools
import json
import threading
import time
from dataclasses import replace
from pathlib import PosixPath
from types import SimpleNamespace

import numpy as np
import pytest
from edge_samples import BASELINE, FakeModel, make_scan
from mcap.reader import make_reader
from mcap_samples import (
    OFFSET_NS,
    SURE,
    TURNED,
    arrays_of,
    make_results,
    messages_of,
    odd_scans,
    record_into,
    same_scan,
)

from edge.api import open_runtime, open_source
from edge.pipeline.sink import RunFacts
from edge.sinks.mcap import McapSink
from edge.sinks.mcap_writer import CHUNK_S, McapFile
from edge.sinks.registry import open_sink
from edge.sinks.ros2 import cdr_messages as ros_messages
from edge.sinks.ros2.map_messages import image_map, in_si
from firmware_bridge.errors import RecordingError
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.scan_messages import decode_baseline, decode_scan
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile
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


def scans_of(source):
    while (taken := source.take(1.0)) is not None:
        yield from (heard for heard in taken if isinstance(heard, Scan))


class TestSink:
    def test_the_public_package_finds_all_that_was_said(self, tmp_path):
        scans = odd_scans()
        results = make_results(scans, counts_per_newton=1000.0)
        path = record_into(tmp_path / "out.mcap", results)
        by_topic = messages_of(path)
        for sensor, topic in (("4", "/s4"), ("left/6", "/left/s6")):
            own = [result for result in results if result.scan.sensor == sensor]
            times = [result.scan.time_ns + OFFSET_NS for result in own]
            assert [at for at, _ in by_topic[f"{topic}/scan"]] == times
            assert all(
                (decode_scan(data).counts == one.scan.counts).all()
                for (_, data), one in zip(by_topic[f"{topic}/scan"], own, strict=True)
            )
            for name in ("pattern", "deviation"):
                maps = [image_map(data).tobytes() for _, data in by_topic[f"{topic}/{name}"]]
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
        assert json.loads(metadata["geometry"]["pitch_mm"]) == 4.7 and metadata["source"] == {"kind": "device"}

    def test_a_baseline_is_said_where_it_comes_into_use(self, tmp_path):
        results = make_results([make_scan(number, noise=3) for number in range(6)])
        other = replace(BASELINE.moved(np.full((3, 4, 4), 0.1)), origin="demand")
        results = [*results[:3], *(replace(one, baseline=other, baseline_age_s=None) for one in results[3:])]
        said = messages_of(record_into(tmp_path / "out.mcap", results))["/s4/baseline"]
        assert [at - OFFSET_NS for at, _ in said] == [results[0].scan.time_ns, results[3].scan.time_ns]
        for (_, data), baseline in zip(said, (BASELINE, other), strict=True):
            got = decode_baseline(data)
            assert got.counts.tobytes() == baseline.counts.tobytes()
            assert (got.id, got.created_unix_s, got.scans) == (baseline.id, 1000.0, 100)

    def test_names_that_ros_cannot_tell_apart_get_own_topics(self, tmp_path):
        scans = [make_scan(sensor=name) for name in ("a b", "a_b", "a.b")]
        topics = messages_of(record_into(tmp_path / "out.mcap", make_results(scans)))
        assert {"/a_b/scan", "/x_612062/scan", "/x_612e62/scan"} <= topics.keys()

    def test_a_clock_that_is_set_moves_no_record(self, tmp_path, monkeypatch):
        now_ns = time.monotonic_ns()
        results = make_results([make_scan(number, time_ns=now_ns + number) for number in range(2)])
        before_ns = time.time_ns()
        sink = open_sink(f"mcap:{tmp_path}/out.mcap", SURE)
        sink.write(results[0], {})
        monkeypatch.setattr(time, "time_ns", lambda: 0)
        sink.write(results[1], {})
        sink.close()
        first, second = (at for at, _ in messages_of(tmp_path / "out.mcap")["/s4/scan"])
        assert second == first + 1 and abs(first - before_ns) < 60 * 10**9

    def test_scans_are_on_the_disk_within_a_second(self, tmp_path):
        now_s = [0.0]
        sink = McapSink(tmp_path / "out.mcap", SURE, clock_s=lambda: now_s[0])
        sink.write(make_results([make_scan()])[0], {})
        now_s[0] = CHUNK_S
        while not sink.scans:
            sink.wait()
        assert len(load_recording(tmp_path / "out.mcap").tracks[0].counts) == 1
        sink.close()

    @pytest.mark.parametrize("lossless", [True, False])
    def test_a_disk_that_hangs_is_waited_for_by_the_lossless_alone(self, tmp_path, monkeypatch, lossless):
        monkeypatch.setattr("edge.sinks.mcap_writer.MOST_WAITING_BYTES", 20_000)
        path = HangingDisk(tmp_path / "out.mcap")
        path.hangs_s = 0.05 if lossless else None
        results = make_results([make_scan(number) for number in range(50)])
        sink = McapSink(path, SURE, RunFacts(lossless=lossless), clock_s=itertools.count(0.0, 0.1).__next__)
        for result in results:
            sink.write(result, {})
        left_out = sink.unwritten
        assert (left_out == 0) == lossless and left_out < 50
        path.mended.set()
        sink.close()
        [track] = load_recording(tmp_path / "out.mcap").tracks
        np.testing.assert_array_equal(track.counts, [result.scan.counts for result in results[: 50 - left_out]])

    def test_a_reader_seeks_by_its_chunks(self, tmp_path):
        now_s = [0.0]
        file = McapFile(tmp_path / "out.mcap", "", "", lambda: now_s[0])
        channel = file.add_channel("/a", "cdr", file.add_schema("A", "ros2msg", "int8 a\n"), {})
        for _ in range(100):
            file.add_message(channel, round(now_s[0] * 1e9), b"\0\1\0\0\1")
            now_s[0] += CHUNK_S
            file.look()
        file.close()
        with (tmp_path / "out.mcap").open("rb") as opened:
            reader = make_reader(opened, validate_crcs=True)
            assert len(reader.get_summary().chunk_indexes) == 100
            assert [message.log_time for _, _, message in reader.iter_messages("/a", starting_at=90 * 10**9)] == [
                round(number * CHUNK_S * 1e9) for number in range(90, 100)
            ]
        assert list(tmp_path.iterdir()) == [tmp_path / "out.mcap"]


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
        assert len(got) == len(scans) and all(map(same_scan, got, scans))

    def test_a_recording_that_lost_its_end_is_read_up_to_it(self, tmp_path):
        whole = record_into(tmp_path / "whole.mcap", make_results(odd_scans())).read_bytes()
        cut = tmp_path / "cut.mcap"
        for end in (len(whole) - 1, whole.rindex(b"ros2msg")):  # within the summary, or without it
            cut.write_bytes(whole[:end])
            assert len(load_recording(cut).tracks[0].counts) == 12
        cut.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(RecordingError, match=r"no scans that edge-sr recorded; .* breaks off"):
            load_recording(cut)  # one chunk holds all, and is not whole

    def test_who_zeroed_meanwhile_is_told_of(self, tmp_path):
        results = make_results([make_scan(number, noise=3) for number in range(6)])
        other = replace(BASELINE, id="other")
        results = [*results[:3], *(replace(one, baseline=other) for one in results[3:])]
        path = record_into(tmp_path / "out.mcap", results)
        (note,) = load_recording(path).notes
        assert f"zeroed again while it was recorded ({BASELINE.id}, then other)" in note
        link = ReplayLink([path])
        assert [(one.kind, one.text) for one in link.notices()] == [("note", note)] and not link.notices()

    @pytest.mark.parametrize(("named", "form"), [("", "mcap"), ("left=", "npz")])
    def test_it_sits_as_it_sat_however_it_is_played(self, tmp_path, named, form):
        scans = [make_scan(number, press_counts=3000, noise=1) for number in range(3)]
        results = make_results(scans, mountings={"4": TURNED})
        path = record_into(tmp_path / "turned.mcap", results, mountings={"4": TURNED})
        if form == "npz":
            arrays_of(path)
            path = path.with_suffix(".npz")
        sensor = f"{named.replace('=', '/')}4"
        with open_source(f"{named}replay:{path}", rate_hz=1000) as source:
            baselines = {sensor: replace(BASELINE, sensor=sensor)}
            runtime = open_runtime(FakeModel(SURE), source, baselines=baselines, every_scan=True)
            again = [runtime.push(scan) for scan in scans_of(source)]
        assert [one.zeroed.tobytes() for one in again] == [one.zeroed.tobytes() for one in results]
        assert {note.kind for one in again for note in one.notes} <= {"not_checked"}
        save_sensor_file(tmp_path / "other.toml", SensorFile(sensors={sensor: SensorEntry(Mounting(signs=(-1, 1, 1)))}))
        with open_source(f"{named}replay:{path}", sensor=tmp_path / "other.toml") as source:
            assert source.sensor_file.mountings == {sensor: Mounting(signs=(-1, 1, 1))}, "the file goes before"
