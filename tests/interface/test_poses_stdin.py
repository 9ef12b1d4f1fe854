"""Poses on stdin: lines, the bounded queue, the way into a real runtime and a whole `edge-sr`; and maps of them."""

import signal
import subprocess

import numpy as np
import pytest
from cli_samples import base_options, files, start, write_recording
from edge_samples import BASELINE, FakeLink, FakeModel, ListSink, make_scan, wait_for
from pose_samples import make_posed_contract

from edge.api import PadPose, Runtime, Source, TimedPose, pump
from edge.mapping.sink import check_npz
from edge.pipeline import pose_queue
from edge.pipeline.commands import Commands
from edge.pipeline.run_statistics import Statistics
from firmware_bridge.schedule import SENSOR_SILENT_NS

__all__ = ["files"]
NOW_NS = 10**12


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
        ({"cmd": "zero", "x_mm": 0, "y_mm": 0}, "cmd is 'zero'"),
    ],
)
def test_a_field_that_is_wrong_is_named(fields, words):
    with pytest.raises(pose_queue.PoseError, match=words.replace("[", r"\[")) as caught:
        pose_queue.pose_of_fields(fields, NOW_NS)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 250


def test_it_is_bounded_and_the_oldest_are_dropped():
    queue = pose_queue.PoseQueue()
    for number in range(pose_queue.WAITING_POSES + 10):
        queue.put(TimedPose(PadPose(0, 0), number))
    assert [one.time_ns for one in queue.take()] == list(range(10, pose_queue.WAITING_POSES + 10))
    assert queue.dropped == 10 and queue.take() == []


def make_runtime():
    return Runtime(FakeModel(make_posed_contract()), source="device", baselines={"4": BASELINE})


def pose(time_ns, x_mm=0.0, sensor=None, holds=False):
    return TimedPose(PadPose(x_mm, 0.0), time_ns, sensor, holds)


@pytest.fixture
def step():
    """Function that puts poses, takes them at a time, and looks then."""
    queue = pose_queue.PoseQueue()
    intake = pose_queue.PoseIntake(make_runtime(), queue)

    def step(now_ns, *poses):
        for one in poses:
            queue.put(one)
        taken = [one.time_ns for one in intake.take([], None, now_ns)]
        return taken, [(event.kind, event.sensor, event.text) for event in intake.look(now_ns)], queue.refused

    return step


def test_a_pose_out_of_order_is_refused_with_one_line_for_many(step):
    taken, ((kind, _, text),), refused = step(100, *map(pose, (50, 40, 30, 60)))
    assert taken == [50, 60] and kind == "poses_trouble" and "40 ns, is not after" in text and refused == 2
    assert step(200, pose(1)) == ([], [], 3)
    _, after_a_while, _ = step(100 + pose_queue.REPEATED_NS, pose(2))
    assert "poses_trouble" in [kind for kind, *_ in after_a_while]


def test_poses_of_a_clock_that_is_ahead_are_used_and_noted(step):
    """Each scan has the pose of a scan that came so much earlier."""
    assert step(NOW_NS, pose(NOW_NS + 50_000_000)) == ([NOW_NS + 50_000_000], [], 0)
    taken, ((kind, _, text),), refused = step(NOW_NS + 1, pose(NOW_NS + 900_000_001))
    assert (taken, kind, refused) == ([NOW_NS + 900_000_001], "poses_trouble", 0)
    assert text.startswith("poses come 0.90 s before the time that they state") and "CLOCK_MONOTONIC" in text


def test_a_silent_source_is_reported_once_and_when_it_is_back(step):
    assert step(10**12)[1] == [], "without any pose there is nothing to miss"
    step(0, pose(1), pose(2, sensor="4"), pose(1, sensor="6", holds=True))
    assert step(SENSOR_SILENT_NS, pose(3, sensor="4"))[1] == []
    ((kind, sensor, text),) = step(SENSOR_SILENT_NS + 1)[1]
    assert (kind, sensor) == ("poses_silent", None) and "one tap" in text
    assert step(SENSOR_SILENT_NS + 2)[1] == []
    assert step(SENSOR_SILENT_NS + 10**8, pose(4))[1] == [("poses_back", None, "poses are back after 0.6 s")]
    assert {sensor for _, sensor, _ in step(10**15)[1]} == {None, "4"}, "one that holds is not missed"


@pytest.mark.parametrize(
    ("of_link", "why"),
    [
        ({}, None),
        ({"patient": True}, "of another time than now: add --paced"),
        ({"states_poses": True}, "a pose is refused: the scans come with poses of their own"),
    ],
)
def test_poses_reach_the_sinks_before_the_scans_that_they_serve(of_link, why):
    commands, seen, statistics = Commands(), [], Statistics()
    sink = ListSink(lambda result: seen.append(("scan", result.scan.number)))
    sink.pose = lambda poses: seen.extend(("pose", one.pose.x_mm) for one in poses)
    commands.poses.put(pose(1, 7.0))
    link = FakeLink([[make_scan(0)], [make_scan(1)]])
    vars(link).update(of_link)
    with Source(link) as source:
        pump(source, make_runtime(), [sink], statistics, commands=commands)
    used = int(why is None)
    assert seen == [("pose", 7.0), ("scan", 0), ("scan", 1)][1 - used :]
    assert [why in event.text for event in sink.events] == [True] * (1 - used)
    assert (statistics.poses, statistics.poses_refused, statistics.poses_dropped) == (used, 1 - used, 0)
    assert sink.counters[-1]["poses"] == used
    assert f"poses: 1 received, {used} used, {1 - used} refused, 0 dropped" in statistics.summary(source="fake")


def test_ctrl_c_writes_the_map_of_poses_on_stdin(files, tmp_path):
    long = write_recording(tmp_path / "long.npz", ([0] * 5 + [3000] * 5) * 300)
    out, lines = tmp_path / "m.npz", tmp_path / "lines"
    options = [*base_options(files), "--source", f"replay:{long}", "--sink", f"jsonl:{lines}"]
    files_of_map = ["--out", out, "--size-mm", "40", "--px-per-mm", "2"]
    with start("map", *options, *files_of_map, stdin=subprocess.PIPE) as process:
        process.stdin.write('{"cmd": "pose", "x_mm": 5, "y_mm": -3, "turn_deg": 0, "holds": true}\n')
        process.stdin.flush()
        wait_for(lambda: lines.exists() and lines.read_text().count('"state":"contact"') > 30)
        assert not out.exists()
        process.send_signal(signal.SIGINT)
        err = process.stderr.read()
        assert process.wait() == 0, err
    check_npz(out)
    with np.load(out) as data:
        rows, cols = np.nonzero(data["coverage"])
        half = (len(data["coverage"]) - 1) / 2
        place_mm = (np.array([cols.mean(), rows.mean()]) - half) / float(data["px_per_mm"]) + data["centre_mm"]
        fused = int(data["fused_patterns"])
    assert place_mm.round(2).tolist() == [5, -3] and fused > 3
    assert f"map: {fused} patterns fused" in err and f"; {out} written" in err
    assert "takes none" not in err, "a map uses the poses, whatever the model takes"
