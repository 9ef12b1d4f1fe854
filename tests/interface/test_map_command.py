"""`edge-sr map` as a whole: poses on stdin, a recording with poses, Ctrl-C, and what is refused."""

import json
import signal
import subprocess

import numpy as np
import pytest
from cli_samples import base_options, files, run, start, wait_for, write_recording

from edge.api import MapSink, ObjectMap, PadPose, Stream, open_recording, open_runtime
from edge.mapping.map_files import check_npz

__all__ = ["files"]
HELD = json.dumps({"cmd": "pose", "x_mm": 5, "y_mm": -3, "turn_deg": 0, "holds": True}) + "\n"


@pytest.fixture
def long(files, tmp_path):
    return write_recording(tmp_path / "long.npz", ([0] * 5 + [3000] * 5) * 300)


def centre_of(path):
    """Return the middle of what a map covers, in [mm], and how many patterns it holds."""
    with np.load(path) as data:
        rows, cols = np.nonzero(data["coverage"])
        half = (len(data["coverage"]) - 1) / 2
        places = [
            (at.mean() - half) / float(data["px_per_mm"]) + c
            for at, c in zip((cols, rows), data["centre_mm"], strict=True)
        ]
        return [round(place, 2) for place in places], int(data["fused_patterns"])


def test_ctrl_c_writes_the_map_of_poses_on_stdin(files, long, tmp_path):
    out, picture, lines = tmp_path / "m.npz", tmp_path / "m.png", tmp_path / "lines"
    options = [*base_options(files), "--source", f"replay:{long}", "--sink", f"jsonl:{lines}"]
    files_of_map = ["--out", out, "--png", picture, "--size-mm", "40", "--px-per-mm", "2"]
    with start("map", *options, *files_of_map, stdin=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stderr is not None
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
        assert process.stdin is not None
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
