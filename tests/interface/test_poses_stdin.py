"""Poses on stdin: lines, the bounded queue, the way into a real runtime and a whole `edge-sr`; and maps of them."""

import json
import os
import signal
import subprocess
import threading
import time

import numpy as np
import pytest
from cli_samples import base_options, files, records, run, start, write_recording
from edge_samples import BASELINE, FakeLink, FakeModel, ListSink, make_scan, wait_for
from pose_samples import make_posed_contract

from edge.api import MapSink, ObjectMap, PadPose, Runtime, Source, Stream, TimedPose, open_recording, open_runtime, pump
from edge.mapping.sink import check_npz
from edge.pipeline.commands import RESET, CommandLines, Commands
from edge.pipeline.pose_queue import (
    FURTHEST_AHEAD_NS,
    REPEATED_NS,
    WAITING_POSES,
    PoseError,
    PoseIntake,
    PoseQueue,
    pose_of_fields,
)
from edge.pipeline.run_statistics import Statistics
from firmware_bridge.schedule import POSES_SILENT_NS

__all__ = ["files"]
WHOLE = (
    '{"cmd": "pose", "x_mm": 1.5, "y_mm": 0, "turn_deg": 5, "error_mm": 0.2, "error_deg": 1, "sensor": "4", '
    '"time_ns": 123, "holds": true}'
)
NOW_NS = 10**12


class TestFields:
    def test_all_fields_are_taken_and_place_alone_is_enough(self):
        expected = TimedPose(PadPose(1.5, 0.0, 5.0, 0.2, 1.0), 123, "4", True)
        assert pose_of_fields(json.loads(WHOLE), NOW_NS) == expected
        assert pose_of_fields({"cmd": "pose", "x_mm": 1, "y_mm": -2.0}, NOW_NS) == TimedPose(PadPose(1, -2), NOW_NS)
        assert pose_of_fields({"x_mm": 0, "y_mm": 0, "time_ns": NOW_NS + FURTHEST_AHEAD_NS}, NOW_NS)  # a little ahead

    @pytest.mark.parametrize(
        ("fields", "words"),
        [
            ({"y_mm": 0}, "x_mm is missing"),
            ({"x_mm": 0, "y_mm": "1"}, "y_mm is '1'"),
            ({"x_mm": 0, "y_mm": True}, "y_mm is True"),
            ({"x_mm": float("nan"), "y_mm": 0}, "x_mm is nan"),
            ({"x_mm": 10**400, "y_mm": 0}, "x_mm is 1000"),
            ({"x_mm": 0, "y_mm": 0, "error_mm": -1}, "error_mm is -1"),
            ({"x_mm": 0, "y_mm": 0, "turn": 3}, "it has 'turn'"),
            ({"x_mm": 0, "y_mm": 0, "sensor": 4}, "sensor is 4"),
            ({"x_mm": 0, "y_mm": 0, "sensor": "\x1b[2J"}, "sensor is"),
            ({"x_mm": 0, "y_mm": 0, "holds": 1}, "holds is 1"),
            ({"x_mm": 0, "y_mm": 0, "time_ns": 1.5}, "time_ns is 1.5"),
            ({"x_mm": 0, "y_mm": 0, "time_ns": -1}, "time_ns is -1"),
            ({"x_mm": 0, "y_mm": 0, "time_ns": 1_700_000_000 * 10**9}, "s ahead of now"),
            ({"x_mm": 0, "y_mm": 0, "time_ns": 10**400}, "time_ns is 1000"),
            ({"cmd": "zero", "x_mm": 0, "y_mm": 0}, "cmd is 'zero'"),
        ],
    )
    def test_a_field_that_is_wrong_is_named(self, fields, words):
        with pytest.raises(PoseError, match=words.replace("[", r"\[")) as caught:
            pose_of_fields(fields, NOW_NS)
        assert str(caught.value).isprintable() and len(str(caught.value)) < 250


class TestLines:
    @pytest.fixture
    def lines(self):
        """Commands, and the lines that they come from through the end of a pipe."""
        (read_end, write_end), commands = os.pipe(), Commands()
        lines = CommandLines(commands, read_end)
        yield commands, lines, write_end
        os.close(write_end)
        lines.close()
        os.close(read_end)

    def test_poses_and_commands_part_and_bad_lines_stop_nothing(self, lines):
        commands, _, write_end = lines
        os.write(write_end, f'{WHOLE}\n{{"cmd": "pose"}}\nnonsense\n{{"cmd": "reset"}}\n{WHOLE}\n'.encode())
        got, poses = [], []
        wait_for(lambda: got.extend(commands.poll()) or poses.extend(commands.poses.take()) or len(poses) == 2)
        assert got == [RESET] and [one.time_ns for one in poses] == [123, 123]
        assert (commands.refused, commands.poses.refused) == (1, 1)
        assert commands.poses.take_reasons() == {"x_mm": "a pose is refused: x_mm is missing, expected a number"}

    def test_the_time_of_arrival_is_that_of_the_line_while_the_loop_waits(self, lines):
        commands, _, write_end = lines
        before_ns = time.monotonic_ns()
        os.write(write_end, b'{"cmd": "pose", "x_mm": 1, "y_mm": 2}\n')
        poses = []
        wait_for(lambda: poses.extend(commands.poses.take()) or poses)  # nobody polls: its own thread reads
        assert before_ns <= poses[0].time_ns <= time.monotonic_ns()


class TestQueue:
    def test_a_message_that_names_no_sensor_is_for_that_of_its_key(self):
        queue = PoseQueue()
        for sensor in ("null", '"6"'):
            queue.put_json(f'{{"x_mm": 1, "y_mm": 0, "sensor": {sensor}}}'.encode(), 0, "4")
        assert [one.sensor for one in queue.take()] == ["4", "6"]

    def test_it_is_bounded_and_the_oldest_are_dropped(self):
        queue = PoseQueue()
        for number in range(WAITING_POSES + 10):
            queue.put(TimedPose(PadPose(0, 0), number))
        assert [one.time_ns for one in queue.take()] == list(range(10, WAITING_POSES + 10))
        assert queue.dropped == 10 and queue.take() == []


def make_runtime():
    return Runtime(FakeModel(make_posed_contract()), source="device", baselines={"4": BASELINE})


def pose(time_ns, x_mm=0.0, sensor=None, holds=False):
    return TimedPose(PadPose(x_mm, 0.0), time_ns, sensor, holds)


class TestIntake:
    def test_a_pose_out_of_order_is_refused_with_one_line_for_many(self):
        queue = PoseQueue()
        intake = PoseIntake(make_runtime(), queue)
        for time_ns in (50, 40, 30, 60):
            queue.put(pose(time_ns))
        assert [one.time_ns for one in intake.take([], None, 100)] == [50, 60]
        (event,) = intake.look(100)
        assert event.kind == "poses_trouble" and "40 ns, is not after" in event.text
        queue.put(pose(1))
        intake.take([], None, 200)
        assert intake.look(200) == [] and queue.refused == 3
        queue.put(pose(2))
        intake.take([], None, 300)
        events = [event for event in intake.look(100 + REPEATED_NS) if event.kind == "poses_trouble"]
        assert len(events) == 1, "it is reported again after a while"

    def test_a_source_that_falls_silent_is_reported_once_and_when_it_is_back(self):
        queue = PoseQueue()
        intake = PoseIntake(make_runtime(), queue)
        assert intake.look(10**12) == [], "without any pose there is nothing to miss"
        for number, sensor in enumerate((None, "4")):
            queue.put(pose(number + 1, sensor=sensor))
        intake.take([], None, 0)
        assert intake.look(POSES_SILENT_NS) == []
        queue.put(pose(3, sensor="4"))
        intake.take([], None, POSES_SILENT_NS)
        (event,) = intake.look(POSES_SILENT_NS + 1)
        assert (event.kind, event.sensor) == ("poses_silent", None) and "one tap" in event.text
        assert intake.look(POSES_SILENT_NS + 2) == []
        queue.put(pose(4))
        intake.take([], None, POSES_SILENT_NS + 10**8)
        (event,) = intake.look(POSES_SILENT_NS + 10**8)
        assert (event.kind, event.text) == ("poses_back", "poses are back after 0.6 s")

    def test_a_pose_that_holds_is_followed_by_silence_of_any_length(self):
        queue = PoseQueue()
        intake = PoseIntake(make_runtime(), queue)
        queue.put(pose(1, holds=True))
        intake.take([], None, 1)
        assert intake.look(10**15) == []

    def test_poses_of_now_do_not_mix_with_those_of_a_recording_that_is_played_at_its_speed(self):
        queue = PoseQueue()
        intake = PoseIntake(make_runtime(), queue)
        queue.put(pose(3))
        assert [one.time_ns for one in intake.take([], 4, 4)] == [3], "a recording may have none"
        queue.put(pose(7))
        assert [one.time_ns for one in intake.take([pose(5)], 6, 6)] == [5]
        queue.put(pose(8, sensor="4"))
        assert intake.take([], 9, 9) == []
        assert queue.refused == 2 and "has poses of its own" in intake.look(9)[0].text

    def test_poses_of_now_are_refused_for_scans_of_another_time(self):
        queue = PoseQueue()
        intake = PoseIntake(make_runtime(), queue, recorded=True)
        queue.put(pose(9))
        assert [one.time_ns for one in intake.take([pose(5)], 6, 6)] == [5]
        assert queue.refused == 1 and "recording" in intake.look(6)[0].text


class PoseSink(ListSink):
    def __init__(self):
        super().__init__()
        self.seen = []

    def pose(self, poses):
        self.seen += [("pose", one.pose.x_mm) for one in poses]

    def write(self, result, counters):
        super().write(result, counters)
        self.seen.append(("scan", result.scan.number))


def test_poses_come_to_the_sinks_before_the_scans_that_they_serve():
    commands, sink, statistics = Commands(), PoseSink(), Statistics()
    commands.poses.put(pose(1, 7.0))
    link = FakeLink([[make_scan(0)], [make_scan(1)]])
    with Source(link) as source:
        pump(source, make_runtime(), [sink], statistics, commands=commands)
    assert sink.seen == [("pose", 7.0), ("scan", 0), ("scan", 1)]
    assert (statistics.poses, statistics.poses_refused, statistics.poses_dropped) == (1, 0, 0)
    assert sink.counters[-1]["poses"] == 1
    assert "poses: 1 received, 1 used, 0 refused, 0 dropped" in statistics.summary(source="fake")


def test_a_program_counts_poses_at_1000_hz_and_reports_their_end(files):
    """A robot at 1000 poses/s that dies: every scan gets its record all the same, and one event reports it."""
    recording = write_recording(files / "long.npz", ([0] * 5 + [3000] * 5) * 30)
    options = [*base_options(files), "--source", f"replay:{recording}", "--sink", "jsonl:-"]
    with start(*options, stdin=subprocess.PIPE) as process:
        out = []
        reader = threading.Thread(target=lambda: out.extend(process.stdout))
        reader.start()
        wait_for(lambda: out)
        sent = 0
        process.stdin.write('{"cmd": "pose", "x_mm": "left"}\n' * 50)
        while sent < 1000:
            numbers = range(sent, sent + 10)
            process.stdin.write("".join(f'{{"cmd": "pose", "x_mm": {number}, "y_mm": 0}}\n' for number in numbers))
            process.stdin.flush()
            sent += 10
            time.sleep(0.008)
        reader.join()
        err = process.stderr.read()
        assert process.wait() == 0
    lines = records("".join(out))
    events = [line["event"] for line in lines if line["state"] == "event"]
    assert events.count("poses_silent") == 1 and events.count("poses_trouble") == 2
    scans = [line for line in lines if line["state"] != "event"]
    assert [line["scan"] for line in scans] == list(range(300))
    assert f"poses: {sent + 50} received, {sent} used, 50 refused, 0 dropped" in err
    assert err.count("x_mm is 'left'") == err.count("takes none, so that each pattern is of one tap: give --model") == 1
    assert [one["counters"] for one in scans if "counters" in one][-1]["poses"] <= sent


HELD = json.dumps({"cmd": "pose", "x_mm": 5, "y_mm": -3, "turn_deg": 0, "holds": True}) + "\n"


def centre_of(path):
    """Return the middle of what a map covers, in [mm], and how many patterns it holds."""
    with np.load(path) as data:
        rows, cols = np.nonzero(data["coverage"])
        half = (len(data["coverage"]) - 1) / 2
        at = (np.array([cols.mean(), rows.mean()]) - half) / float(data["px_per_mm"]) + data["centre_mm"]
        return at.round(2).tolist(), int(data["fused_patterns"])


def test_ctrl_c_writes_the_map_of_poses_on_stdin(files, tmp_path):
    long = write_recording(tmp_path / "long.npz", ([0] * 5 + [3000] * 5) * 300)
    out, picture, lines = tmp_path / "m.npz", tmp_path / "m.png", tmp_path / "lines"
    options = [*base_options(files), "--source", f"replay:{long}", "--sink", f"jsonl:{lines}"]
    files_of_map = ["--out", out, "--png", picture, "--size-mm", "40", "--px-per-mm", "2"]
    with start("map", *options, *files_of_map, stdin=subprocess.PIPE) as process:
        process.stdin.write(HELD)
        process.stdin.flush()
        wait_for(lambda: lines.exists() and lines.read_text().count('"state":"contact"') > 30)
        assert not out.exists()
        process.send_signal(signal.SIGINT)
        err = process.stderr.read()
        assert process.wait() == 0, err
    check_npz(out)
    place, fused = centre_of(out)
    assert place == [5, -3] and fused > 3
    assert f"map: {fused} patterns fused" in err and f"; {out} and {picture} written" in err
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "takes none" not in err, "a map uses the poses, whatever the model takes"


def test_a_run_without_poses_says_so_and_writes_nothing(files, tmp_path):
    done = run("map", *base_options(files), "--source", f"replay:{files / 'taps.npz'}", "--out", tmp_path / "m.npz")
    assert done.returncode == 0 and list(tmp_path.iterdir()) == []
    assert "patterns came without a pose, so the map is empty: send poses of the pad" in done.stderr
    assert "without a pose; no file written" in done.stderr


def test_a_recording_with_poses_becomes_a_map(files, tmp_path):
    posed = tmp_path / "posed.mcap"
    with start("record", posed, *base_options(files), "--source", f"replay:{files / 'taps.npz'}",
               stdin=subprocess.PIPE) as process:  # fmt: skip
        process.stdin.write(HELD)
        process.stdin.flush()
        assert process.wait() == 0, process.stderr.read()
    out = tmp_path / "m.npz"
    done = run("map", *base_options(files), "--source", f"replay:{posed}", "--out", out)
    assert done.returncode == 0, done.stderr
    assert centre_of(out)[0] == [5, -3]


def test_a_map_is_made_by_hand_and_from_a_stream(files):
    with open_recording(files / "taps.npz") as source:
        runtime = open_runtime(files / "tiny.onnx", source, baselines=files / "zero.json")
        by_hand, sink = ObjectMap(), MapSink(ObjectMap())
        for result in Stream(source, runtime, sinks=[sink]):
            by_hand.add(result, PadPose(1.0, 2.0))
            if result.scan.number == 9:  # after the first of four taps
                runtime.pose(PadPose(3.0, 0.0), result.scan.time_ns + 1, "4", holds=True)
    by_hand.finish()
    sink.close()
    assert by_hand.fused == 4 and np.isfinite(by_hand.layers().contact).any()
    assert sink.without_pose == 5 and sink.whole.fused == 3, "a pose that the runtime was given itself counts"
