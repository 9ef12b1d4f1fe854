"""Recordings in MCAP: read with the public package, played again bit for bit, whole whatever ended their writer."""

import itertools
import json
import os
import re
import resource
import signal
import struct
import subprocess
import sys
import threading
import time
import tracemalloc
import zlib
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from bridge_samples import write_recording
from edge_samples import BASELINE, ROOT, FakeModel, make_contract, make_scan, write_model
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap_samples import OFFSET_NS, make_results, messages_of, odd_scans, record_into, same_scan

from edge import api
from edge.api import open_recording, open_runtime, open_source
from edge.cli import main as cli
from edge.doctor.watch import Watch
from edge.errors import SinkError
from edge.perception.event import Event
from edge.perception.runtime import Runtime
from edge.pipeline.result_stream import Stream
from edge.sinks import mcap_writer as mcap_file
from edge.sinks.mcap import McapSink
from edge.sinks.mcap_writer import CHUNK_S, McapFile
from edge.sinks.registry import open_sink
from edge.sinks.ros2 import cdr_messages as ros_messages
from firmware_bridge.errors import RecordingError
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.scan_messages import decode_baseline, decode_scan
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from firmware_bridge.zeroing.baseline import save_baselines

EDGE_SR = [sys.executable, "-m", "edge.cli.main"]
SURE = make_contract(interval_factor=1.6)
TURNED = Mounting(order=tuple(reversed(range(16))), swap_xy=True, signs=(1, -1, 1))


def edge_sr(*arguments, **settings):
    settings = {"capture_output": True, "text": True, "timeout": 60, "stdin": subprocess.DEVNULL} | settings
    return subprocess.run([*EDGE_SR, *map(str, arguments)], cwd=ROOT, env=environment(), **settings)


def environment():
    return os.environ | {"PYTHONPATH": str(ROOT)}


def scans_of(source):
    while (taken := source.take(1.0)) is not None:
        yield from (heard for heard in taken if isinstance(heard, Scan))


def scans_on_disk(path):
    """As the public package reads a file that has no end yet, from front to back."""
    seen = []
    with suppress(FileNotFoundError, EndOfFile), path.open("rb") as file:
        for record in StreamReader(file).records:
            if isinstance(record, Message) and record.channel_id == 1:
                seen.append(decode_scan(record.data))
    return seen


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
                maps = [ros_messages.image_map(data).tobytes() for _, data in by_topic[f"{topic}/{name}"]]
                assert maps == [getattr(one, name).tobytes() for one in own if one.pattern is not None] != []
            said = [json.loads(ros_messages.RESULT.decode(data)["record"]) for _, data in by_topic[f"{topic}/result"]]
            assert [one["scan"] for one in said] == [one.scan.number for one in own]
            assert {one["counters"]["dropped"] for one in said} == {2}
            forces = [ros_messages.WRENCH_STAMPED.decode(data) for _, data in by_topic[f"{topic}/wrench"]]
            assert [one["wrench"]["force"]["z"] for one in forces] == [
                one.force_n for one in own if one.force_n is not None
            ]
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            assert reader.get_header().profile == "ros2"
            metadata = {one.name: one.metadata for one in reader.iter_metadata()}
        data = path.read_bytes()
        start, _, crc = struct.unpack("<QQI", data[-28:-8])
        assert crc == zlib.crc32(data[start:-12]), "which the package writes, and does not look at"
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

    def test_events_are_on_a_topic_of_their_own(self, tmp_path):
        sink = McapSink(tmp_path / "out.mcap", SURE, unix_offset_ns=OFFSET_NS)
        sink.tell(Event(5, "lost", None, "the link is gone"), {})
        sink.write(replace(make_results([make_scan()])[0], events=(Event(9, "zeroed", "4", "baseline b"),)), {})
        sink.close()
        said = [(at, ros_messages.LOG.decode(data)) for at, data in messages_of(tmp_path / "out.mcap")["/events"]]
        assert [(one["name"], one["function"], one["msg"]) for _, one in said] == [
            ("edge-sr", "lost", "the link is gone"),
            ("4", "zeroed", "sensor 4 zeroed on demand: baseline b"),
        ]
        assert said[0][0] == OFFSET_NS + 5

    def test_names_that_ros_cannot_tell_apart_get_topics_of_their_own(self, tmp_path):
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

    def test_a_chunk_is_closed_in_time_also_if_nothing_comes(self, tmp_path):
        now_s = [0.0]
        sink = McapSink(tmp_path / "out.mcap", SURE, clock_s=lambda: now_s[0])
        results = make_results([make_scan(number) for number in range(4)])
        sizes = []
        for at_s, step in ((0.0, 0), (CHUNK_S - 0.01, 1), (CHUNK_S, 2), (CHUNK_S + 0.01, 3), (2 * CHUNK_S, None)):
            now_s[0] = at_s
            if step is None:
                sink.wait()
                continue
            sink.write(results[step], {})
            sizes.append(len(sink._file._payload))
        assert sizes[1] > sizes[0] > 0 and sizes[2] == 0 < sizes[3]
        assert sink._file._payload, "the chunk of the fourth is younger"
        now_s[0] = 3 * CHUNK_S
        sink.wait()
        assert not sink._file._payload
        sink.close()
        assert len(messages_of(tmp_path / "out.mcap")["/s4/scan"]) == 4

    @pytest.mark.parametrize("patient", [True, False])
    def test_a_disk_that_hangs_is_waited_for_by_the_patient_alone(self, tmp_path, monkeypatch, patient):
        monkeypatch.setattr(mcap_file, "MOST_WAITING_BYTES", 20_000)
        put, mended, waited_for = McapFile._put, threading.Event(), []
        monkeypatch.setattr(McapFile, "_put", lambda file, data: mended.wait() and put(file, data))
        drain = McapFile.drain
        monkeypatch.setattr(McapFile, "drain", lambda file: (mended.set(), waited_for.append(1), drain(file)))
        path, results = tmp_path / "out.mcap", make_results([make_scan(number) for number in range(60)])
        sink = McapSink(path, SURE, patient=patient, clock_s=itertools.count(0.0, 0.1).__next__)
        for result in results[:50]:
            sink.write(result, {})
        assert bool(waited_for) == patient
        left_out = sink.unwritten
        assert (left_out == 0) == patient and left_out < 50
        mended.set()
        sink._file.drain()
        for result in results[50:]:
            sink.write(result, {})
            sink._file.drain()
        sink.close()
        assert sink.unwritten == left_out
        [track] = load_recording(path).tracks
        kept = [*results[: 50 - left_out], *results[50:]]
        np.testing.assert_array_equal(track.counts, [result.scan.counts for result in kept])

    def test_memory_does_not_grow_with_its_chunks(self, tmp_path):
        now_s = [0.0]
        file = McapFile(tmp_path / "out.mcap", "", "", lambda: now_s[0])
        channel = file.add_channel("/a", "cdr", file.add_schema("A", "ros2msg", "int8 a\n"), {})

        def write(chunks):
            for _ in range(chunks):
                file.add_message(channel, round(now_s[0] * 1e9), b"\0\1\0\0\1")
                now_s[0] += CHUNK_S
                file.look()
                file.drain()

        write(500)
        tracemalloc.start()
        before = tracemalloc.get_traced_memory()[0]
        write(2000)
        grown = tracemalloc.get_traced_memory()[0] - before
        file.close()
        closing = tracemalloc.get_traced_memory()[1] - before
        tracemalloc.stop()
        assert grown < 50_000 and closing < 400_000, "a ChunkIndex takes 80 bytes and 10 for each channel"
        with (tmp_path / "out.mcap").open("rb") as opened:
            reader = make_reader(opened, validate_crcs=True)
            assert len(reader.get_summary().chunk_indexes) == 2500
            assert [message.log_time for _, _, message in reader.iter_messages("/a", starting_at=600 * 10**9)] == [
                round(number * CHUNK_S * 1e9) for number in range(2400, 2500)
            ]
        assert list(tmp_path.iterdir()) == [tmp_path / "out.mcap"]

    def test_what_cannot_be_is_said_in_one_line_and_nothing_is_lost(self, tmp_path):
        path = record_into(tmp_path / "out.mcap", make_results([make_scan()]))
        before = path.read_bytes()
        with pytest.raises(SinkError, match=r"out\.mcap exists: give another name"):
            McapSink(path, SURE)
        assert path.read_bytes() == before
        with pytest.raises(SinkError, match=r"cannot record into .*none/out\.mcap: No such file"):
            McapSink(tmp_path / "none" / "out.mcap", SURE)
        empty = record_into(tmp_path / "empty.mcap", [])
        assert not empty.exists()


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
        now_ns = [5]
        paced = ReplayLink(
            [path], clock=lambda: now_ns[0], sleep=lambda s: now_ns.__setitem__(0, now_ns[0] + round(s * 1e9))
        )
        with paced:
            again = [scan for _ in scans for scan in paced.read(1.0)]
        moved_ns = 5 - scans[0].time_ns
        assert all(same_scan(one, scan, moved_ns) for one, scan in zip(again, scans, strict=True))

    def test_a_recording_that_lost_its_end_is_read_up_to_it(self, tmp_path):
        whole = record_into(tmp_path / "whole.mcap", make_results(odd_scans()))
        data = whole.read_bytes()
        cut = tmp_path / "cut.mcap"
        for end in (len(data) - 1, len(data) // 2, 0):
            at = data.rindex(b"ros2msg", 0, len(data) - 1) if end == 0 else end  # within the summary, or without it
            cut.write_bytes(data[:at])
            if end == len(data) // 2:
                with pytest.raises(RecordingError, match=r"no scans that edge-sr recorded; .* breaks off"):
                    load_recording(cut)  # one chunk holds all, and is not whole
            else:
                assert len(load_recording(cut).tracks[0].counts) == 12

    def test_who_zeroed_meanwhile_is_told_of(self, tmp_path):
        results = make_results([make_scan(number, noise=3) for number in range(6)])
        other = replace(BASELINE, id="other")
        results = [*results[:3], *(replace(one, baseline=other, source="emulated") for one in results[3:])]
        path = record_into(tmp_path / "out.mcap", results)
        (note,) = load_recording(path).notes
        assert f"zeroed again while it was recorded ({BASELINE.id}, then other)" in note
        link = ReplayLink([path])
        assert [(one.kind, one.text) for one in link.notices()] == [("note", note)] and not link.notices()

    def test_a_recording_of_an_emulated_sensor_says_so(self, tmp_path):
        path, results = tmp_path / "out.mcap", make_results([make_scan()], source="emulated")
        sink = McapSink(path, SURE, unix_offset_ns=OFFSET_NS)
        sink.tell(Event(5, "silent", None, "nothing comes"), {})
        sink.write(results[0], {})
        sink.close()
        assert load_recording(path).notes == (f"{path} was recorded from an emulated sensor",)

    @pytest.mark.parametrize("form", ["mcap", "npz"])
    @pytest.mark.parametrize("kind", ["emulated", "device"])
    def test_and_so_does_one_of_that_recording_in_any_generation(self, tmp_path, form, kind):
        path = record_into(tmp_path / "first.mcap", make_results([make_scan()], source=kind))
        for generation in range(3):
            with open_recording(path) as source:
                path = tmp_path / f"{generation}.{form}"
                sink = api.open_sink(f"{form}:{path}", SURE, source)
                for result in Stream(source, Runtime(FakeModel(SURE), source=source.kind)):
                    assert result.source == "replay"
                    sink.write(result, {})
                sink.close()
            said = load_recording(path)
            assert said.origin == kind
            assert list(said.notes) == [f"{path} was recorded from an emulated sensor"] * (kind == "emulated")

    @pytest.mark.parametrize("named", ["", "left="])
    def test_it_sits_as_it_sat_however_it_is_played(self, tmp_path, named):
        scans = [make_scan(number, press_counts=3000, noise=1) for number in range(3)]
        results = make_results(scans, mountings={"4": TURNED})
        path = record_into(tmp_path / "turned.mcap", results, mountings={"4": TURNED})
        sensor = f"{named.replace('=', '/')}4"
        with open_source(f"{named}replay:{path}", rate_hz=1000) as source:
            baselines = {sensor: replace(BASELINE, sensor=sensor)}
            runtime = open_runtime(FakeModel(SURE), source, baselines=baselines, every_scan=True)
            again = [runtime.push(scan) for scan in scans_of(source)]
        assert [one.zeroed.tobytes() for one in again] == [one.zeroed.tobytes() for one in results]
        assert not any(one.note for one in again)
        save_sensor_file(tmp_path / "other.toml", SensorFile(sensors={sensor: SensorEntry(Mounting(signs=(-1, 1, 1)))}))
        with open_source(f"{named}replay:{path}", sensor=tmp_path / "other.toml") as source:
            assert source.sensor_file.mountings == {sensor: Mounting(signs=(-1, 1, 1))}, "the file goes before"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A tiny model and a pressed pad: recorded by `edge-sr record`, without a baseline of its own."""
    folder = tmp_path_factory.mktemp("made")
    write_model(folder / "tiny.onnx", SURE)
    counts = np.stack([make_scan(number, noise=3).counts for number in range(160)])
    for start in (120, 140):
        counts[start : start + 10, 2, 1, 1] += 3000
    write_recording(folder / "finger.csv", counts)
    for _ in range(10):  # a machine that is busy may let all of a contact wait, and drop it
        done = edge_sr(
            *("record", folder / "press.mcap", "--model", folder / "tiny.onnx", "--rate-hz", 200),
            *("--source", f"replay:{folder}/finger.csv"),
        )
        assert done.returncode == 0, done.stderr
        assert f"recorded {folder}/press.mcap: 160 scans, 0.8 s, " in done.stderr.splitlines()[-1]
        if any(own for own, _ in patterns(folder / "press.mcap").values()):
            return folder
        (folder / "press.mcap").unlink()
    raise AssertionError("no scan of the contact got its pattern in any of ten recordings")


def replayed(made, name, *options, file="press.mcap"):
    arguments = ["replay", made / file, "--model", made / "tiny.onnx", "--sink", f"jsonl:{name}", *options]
    assert cli.main([str(one) for one in arguments]) == 0
    return [json.loads(line) for line in name.read_text().splitlines()]


def patterns(path):
    """Each scan's pattern by its number, and whether it was made for that scan."""
    by_topic = messages_of(path)
    said = {at: ros_messages.RESULT.decode(data) for at, data in by_topic["/finger/result"]}
    made_for = {at: json.loads(one["record"])["reused_from"] is None for at, one in said.items()}
    return {
        said[at]["scan"]: (made_for[at], ros_messages.image_map(data).tobytes())
        for at, data in by_topic["/finger/pattern"]
    }


class TestOffline:
    def test_the_same_again_is_the_same_and_every_scan_has_its_result(self, made, tmp_path):
        first = replayed(made, tmp_path / "a.jsonl", "--sink", f"mcap:{tmp_path}/a.mcap")
        second = replayed(made, tmp_path / "b.jsonl", "--sink", f"mcap:{tmp_path}/b.mcap")
        assert len(first) == 160 and {one["state"] for one in first} == {"zeroing", "idle", "contact"}
        for one in (*first, *second):
            assert one["latency_us"] is None and (one["pattern"] is None) == (one["state"] != "contact")
            del one["run_time_us"]
        assert first == second
        recorded = messages_of(made / "press.mcap")
        again, other = messages_of(tmp_path / "a.mcap"), messages_of(tmp_path / "b.mcap")
        for topic in ("scan", "baseline", "pattern", "deviation"):
            assert again[f"/finger/{topic}"] == other[f"/finger/{topic}"] != []
        assert again["/finger/scan"] == recorded["/finger/scan"], "and at their times on the wall"

    def test_patterns_are_those_that_were_recorded(self, made, tmp_path):
        replayed(made, tmp_path / "a.jsonl", "--sink", f"mcap:{tmp_path}/a.mcap", "--every-scan")
        again = patterns(tmp_path / "a.mcap")
        made_then = {scan: pattern for scan, (own, pattern) in patterns(made / "press.mcap").items() if own}
        assert made_then
        assert [scan for scan, pattern in made_then.items() if again[scan][1] != pattern] == []

    @pytest.mark.parametrize("suffix", ["mcap", "npz"])
    def test_it_begins_with_the_baseline_of_its_first_scan_unless_told_otherwise(self, made, tmp_path, suffix):
        """A recording that begins in contact: zeroed anew, the press would be gone."""
        path = tmp_path / f"press.{suffix}"
        scans = [make_scan(number, press_counts=3000, noise=1) for number in range(130)]
        sink = open_sink(f"{suffix}:{path}", SURE, unix_offset_ns=1_012_400_000_000)
        for result in make_results(scans, unix_time_s=lambda: 1012.4):
            sink.write(result, {})
        sink.close()
        for options, age_s in (((), 12.4), (("--paced", "--rate-hz", 2000), 12.4 if suffix == "npz" else None)):
            got = replayed(made, tmp_path / "a.jsonl", *options, file=path)
            assert {one["baseline"] for one in got} == {BASELINE.id}
            # Longer than that nobody believes a taxel that is pressed alone.
            assert {one["state"] for one in got[:18]} <= {"contact", "dropped"}
            # Played at its pace it is of now, and so is its age, where the file tells when it was made.
            assert got[0]["baseline_age_s"] > 1e9 if age_s is None else abs(got[0]["baseline_age_s"] - age_s) < 60
        got = replayed(made, tmp_path / "a.jsonl", "--zero", file=path)
        assert [one["state"] for one in got] == ["zeroing"] * 99 + ["idle"] * 31

    @pytest.mark.parametrize("age_s", [3000.0, None])
    def test_a_baseline_older_than_the_machine_is_so_in_every_generation(self, made, tmp_path, age_s):
        """An npz says how old it was, and its times are those since the machine was started."""
        path = tmp_path / "press.npz"
        sink = open_sink(f"npz:{path}", SURE)
        for result in make_results([make_scan(number, press_counts=3000, noise=1) for number in range(5)]):
            sink.write(replace(result, baseline_age_s=age_s), {})
        sink.close()
        assert age_s is None or load_recording(path).tracks[0].time_ns[-1] < age_s * 1e9
        for generation in range(3):
            again = tmp_path / f"{generation}.mcap"
            got = replayed(made, tmp_path / f"{generation}.jsonl", "--sink", f"mcap:{again}", file=path)
            assert [one["state"] for one in got] == ["contact"] * 5
            ages_s = [one["baseline_age_s"] for one in got]
            assert ages_s[0] == age_s and {one["baseline"] for one in got} == {BASELINE.id}
            path = again

    def test_another_baseline_and_a_sensor_that_sits_turned(self, made, tmp_path):
        scans = [make_scan(number, press_counts=3000, noise=1) for number in range(5)]
        results = make_results(scans, mountings={"4": TURNED, "left/6": TURNED})
        path = record_into(tmp_path / "turned.mcap", results, mountings={"4": TURNED})
        other = type(BASELINE).of("4", BASELINE.counts - 1, 1500.0, 100, "file")
        save_baselines(tmp_path / "other.json", [other], {"4": TURNED.order})
        got = replayed(made, tmp_path / "a.jsonl", file=path)
        assert [one["force_counts"] for one in got] == [round(result.force_counts, 1) for result in results]
        assert [one["centroid_mm"] for one in got] == [
            [round(value, 4) for value in result.centroid_mm] for result in results
        ]
        got = replayed(made, tmp_path / "a.jsonl", "--baseline", tmp_path / "other.json", file=path)
        assert {one["baseline"] for one in got} == {other.id}
        assert [one["force_counts"] for one in got] == [round(result.force_counts + 16, 1) for result in results]


class TestRecord:
    def test_a_file_that_exists_is_left_alone_and_one_without_an_ending_is_an_mcap(self, made, tmp_path, capsys):
        source = ["--model", f"{made}/tiny.onnx", "--source", f"replay:{made}/finger.csv", "--rate-hz", "2000"]
        (tmp_path / "old.npz").write_text("old")
        assert cli.main(["record", f"{tmp_path}/old.npz", *source]) == 5
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and "exists: give another name" in error
        assert (tmp_path / "old.npz").read_text() == "old"
        assert cli.main(["record", f"{tmp_path}/run.1", *source]) == 0
        assert len(load_recording(tmp_path / "run.1.mcap").tracks[0].counts) == 160
        capsys.readouterr()
        assert cli.main(["record", f"{tmp_path}/none/x", *source]) == 5
        assert "No such file or directory" in capsys.readouterr().err.splitlines()[-1]

    def test_what_is_no_name_of_a_recording_is_refused_before_anything_is_opened(self, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "taken").mkdir()
        for name, code, words in (
            ("taken", 5, "cannot record into taken: it is a directory"),
            ("x.csv", 2, "no .csv is recorded: expected x.mcap or x.npz"),
            ("x.JSONL", 2, "no .JSONL is recorded"),
        ):
            assert cli.main(["record", name, "--source", "slcan:/dev/none"]) == code
            error = capsys.readouterr().err
            assert error.count("\n") == 1 and words in error
        assert [path.name for path in tmp_path.iterdir()] == ["taken"]

    def test_a_killed_recorder_leaves_all_that_was_on_the_disk(self, made, tmp_path):
        """How much that is depends on the machine: docs/recordings.md tells what was measured."""
        path = tmp_path / "killed.mcap"
        process = subprocess.Popen(
            [
                *(*EDGE_SR, "record", path, "--model", made / "tiny.onnx", "--rate-hz", "20"),
                *("--source", f"replay:{made}/finger.csv"),
            ],
            cwd=ROOT,
            env=environment(),
            stderr=subprocess.DEVNULL,
        )
        while len(written := scans_on_disk(path)) < 12:
            assert process.poll() is None
            time.sleep(0.05)
        process.kill()
        process.wait()
        seen = scans_on_disk(path)
        assert [scan.number for scan in seen] == list(range(len(seen))) and len(seen) >= len(written)
        recording = load_recording(path)
        assert (recording.tracks[0].counts == np.stack([scan.counts for scan in seen])).all()
        assert "breaks off (without an end" in recording.notes[0] or "within a record" in recording.notes[0]
        done = edge_sr("replay", path, "--model", made / "tiny.onnx")
        assert done.returncode == 0 and "breaks off" in done.stderr and f"{len(seen)} scans" in done.stderr

    def test_a_full_disk_ends_it_in_one_line_and_what_was_written_can_be_played(self, made, tmp_path):
        limit = 20_000

        def small_disk():
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

        path = tmp_path / "full.mcap"
        done = edge_sr(
            *("record", path, "--model", made / "tiny.onnx", "--rate-hz", 60),
            *("--source", f"replay:{made}/finger.csv"),
            preexec_fn=small_disk,
        )
        assert done.returncode == 5
        recording = load_recording(path)
        scans = len(recording.tracks[0].counts)
        assert done.stderr.splitlines()[-1] == (
            f"edge-sr: recording into {path} stopped: File too large; its {scans} scans can be played"
        )
        assert f"recorded {path}: at most " in done.stderr
        assert 0 < len(recording.tracks[0].counts) < 160 and path.stat().st_size <= limit
        assert recording.notes == (recording.notes[0],) and "without an end" in recording.notes[0]


def test_what_the_page_says_of_reading_it_works(tmp_path, monkeypatch, capsys):
    (script,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "recordings.md").read_text(), re.DOTALL)
    results = make_results(odd_scans())
    record_into(tmp_path / "press.mcap", results)
    monkeypatch.chdir(tmp_path)
    exec(compile(script, "recordings.md", "exec"), {})
    shown = [one.pattern for one in results if one.scan.sensor == "4" and one.pattern is not None]
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(shown) > 0 and lines[0].endswith(f"(40, 40) {shown[0].max()!s}")


def test_the_doctor_goes_by_how_the_recorded_sensors_sat(tmp_path):
    sat = Mounting(signs=(1, 1, -1))
    path = record_into(tmp_path / "a.mcap", make_results(odd_scans()), mountings={"4": sat})
    watch = Watch([f"replay:{path}"], SensorFile(), references={}, rate_hz=None, stop=threading.Event())
    assert watch.known.mountings["4"] == sat
