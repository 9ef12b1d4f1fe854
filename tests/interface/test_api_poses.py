"""Poses through the library: from any thread, to the patterns and into records."""

import json
import threading

import numpy as np
import pytest
from cli_samples import run, write_recording
from edge_samples import BASELINE, FakeLink, FakeModel, make_scan
from mcap_samples import arrays_of
from pose_samples import PosedModel, make_posed_contract, posed_pattern, write_posed_model

from edge import api
from edge.api import Stream, UsageError, open_recording, open_runtime, open_sink, save_baselines
from edge.pipeline.scan_reader import Source
from firmware_bridge.poses.pad_pose import PadPose

PRESSES = [0, 3000, 3000, 0, 0, 3000, 3000]


class Clock:
    """Clock of the scans of a fake link: the time of the scan that is read next."""

    def __init__(self):
        self.now_ns = 0

    def __call__(self):
        return self.now_ns


def test_poses_that_another_thread_states_are_those_of_the_next_scans():
    steps = [threading.Event() for _ in PRESSES]
    batches = []
    for number, (press, step) in enumerate(zip(PRESSES, steps, strict=True)):
        batches += [[make_scan(number, press_counts=press)], step]
    clock = Clock()
    with Source(FakeLink(batches)) as source:
        model = PosedModel()
        runtime = open_runtime(model, source, baselines={"4": BASELINE})
        stream = Stream(source, runtime, clock_ns=clock)
        results = []
        for result in stream:
            results.append(result)
            clock.now_ns = result.scan.time_ns + 1
            place = {"x_mm": np.float32(len(results)), "y_mm": 0, "turn_deg": 5}
            thread = threading.Thread(target=stream.pose, kwargs=place | {"holds": True, "error_mm": 0.5})
            thread.start()
            thread.join()
            steps[result.scan.number].set()
    assert [result.pose and result.pose.x_mm for result in results] == [None, *range(1, len(PRESSES))]
    assert results[-1].pose == PadPose(6, 0, 5, 0.5)
    last = results[-1]
    turn = np.radians(5)
    assert last.taps_used == 2 and last.poses[1, :2] == pytest.approx([(1 - 6) * np.cos(turn), 5 * np.sin(turn)])
    window = model.contract.scale_window(last.window)
    np.testing.assert_allclose(last.pattern, posed_pattern(window, last.poses), atol=1e-4)
    assert stream.statistics.poses == len(PRESSES) - 1


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"x_mm": float("nan")}, "a pose: x_mm is nan, expected a number from"),
        ({"time_ns": 10**18}, "a pose: time_ns is .* ahead of now"),
    ],
)
def test_a_pose_that_cannot_be_is_refused_where_it_is_stated(wrong, match):
    with Source(FakeLink([[make_scan(0)]])) as source:
        stream = Stream(source, open_runtime(FakeModel(), source), clock_ns=lambda: 0)
        with pytest.raises(UsageError, match=match):
            stream.pose(**({"x_mm": 0, "y_mm": 0} | wrong))


def test_of_a_recording_poses_are_stated_at_its_own_times(tmp_path):
    write_recording(tmp_path / "taps.npz", PRESSES)
    with open_recording(tmp_path / "taps.npz", zero=True) as source:
        runtime = open_runtime(FakeModel(), source, baselines={"4": BASELINE})
        stream = Stream(source, runtime)
        with pytest.raises(UsageError, match=r"is a recording: give `runtime.pose` a PadPose and a time of its scans"):
            stream.pose(0, 0)
        runtime.pose(api.PadPose(3, 4), 0, holds=True)
        assert {result.pose for result in stream} == {PadPose(3, 4)}


@pytest.fixture
def posed_records(tmp_path):
    """Results of two taps with poses, and the files that sinks made of them."""
    contract = make_posed_contract()
    batches = [[make_scan(number, press_counts=press)] for number, press in enumerate(PRESSES)]
    with Source(FakeLink(batches)) as source:
        sinks = [open_sink(f"{form}:{tmp_path}/out.{form}", contract, source) for form in ("jsonl", "mcap")]
        runtime = open_runtime(PosedModel(contract), source, baselines={"4": BASELINE})
        made = []
        for number, batch in enumerate(batches):
            if number:
                runtime.pose(PadPose(number / 3, -1, 15 * number), batch[0].time_ns, holds=True)
            made.append(runtime.push(batch[0]))
            for sink in sinks:
                sink.write(made[-1], {})
        for sink in sinks:
            sink.close()
    return made, tmp_path


def test_an_npz_holds_the_pose_of_each_scan_and_a_row_for_each_tap(posed_records):
    made, folder = posed_records
    arrays = arrays_of(folder / "out.mcap")
    assert arrays["poses"].shape == (len(made), 7, 5) and arrays["scan_pose"].shape == (len(made), 5)
    assert np.isnan(arrays["poses"][0]).all() and np.isnan(arrays["scan_pose"][0]).all()
    np.testing.assert_allclose(arrays["scan_pose"][2], [2 / 3, -1, 30, 0.2, 1], rtol=1e-4)
    np.testing.assert_allclose(arrays["poses"][-1, :2], made[-1].poses, atol=1e-4)
    assert np.isnan(arrays["poses"][-1, 2:]).all()


def test_the_command_line_takes_the_most_taps(tmp_path):
    write_posed_model(tmp_path / "posed.onnx")
    save_baselines(tmp_path / "zero.json", [BASELINE])
    write_recording(tmp_path / "taps.npz", ([0] * 5 + [3000] * 5) * 4)
    fixed = ("--model", tmp_path / "posed.onnx", "--baseline", tmp_path / "zero.json")
    for options, most in (((), 1), (("--taps", "3"), 3)):
        done = run("replay", tmp_path / "taps.npz", *fixed, "--sink", "jsonl:-", *options)
        said = [json.loads(line) for line in done.stdout.splitlines()]
        assert max(one["taps_used"] for one in said) == most, done.stderr
    assert said[-1]["poses"] == [[0] * 5, [0, 0, 5, 0.2, 1], [0, 0, 10, 0.2, 1]]
    done = run("replay", tmp_path / "taps.npz", *fixed, "--taps", "8")
    assert done.returncode == 2 and "taps is 8, but model 'posed' takes 7 at most" in done.stderr
