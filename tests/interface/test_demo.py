import json
from itertools import pairwise

import cli_samples
import numpy as np
import pytest
from edge_samples import BASELINE, FakeLink, FakeModel, make_scan
from pose_samples import make_posed_contract, write_posed_model
from trust_samples import make_posed_trust

from edge.api import POSED_MODEL, USPA44, Runtime, Source, demo_recording, load_model
from edge.cli import run_command
from edge.cli.demo import SLIDE, DemoRecording, DemoScenes, DemoScore
from edge.cli.main import parsed_options
from edge.evaluation.metrics import psnr_db, rmse_percent
from edge.perception.contact_options import RuntimeOptions
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.scan import ScanSeries
from train.demo import TAP_FRAMES

PRESSES = [0, 0, 2000, 3000, 3500, 0, 2100, 4000, 0]
TAPS = [-1, -1, 0, 0, -1, -1, 1, 1, -1]


@pytest.fixture
def recording(tmp_path):
    counts = np.stack([make_scan(n, press_counts=press, noise=2).counts for n, press in enumerate(PRESSES)])
    unit_patterns = np.stack([np.kron(np.eye(4), np.ones((10, 10))), np.ones((40, 40))]).astype(np.float16)
    path = tmp_path / "demo.npz"
    np.savez(
        path,
        counts=counts,
        tap=np.array(TAPS),
        indentation_mm=np.arange(len(TAPS)) / 8,
        unit_patterns=unit_patterns,
        tap_pose=np.array([[0, 0, 0, 0.2, 1], [0, 0, -5, 0.2, 1]]),
        scene=np.full(len(TAPS), -1),
        surface=np.array("S"),
    )
    return path


def play(recording, *, lost=(), model=None):
    """Return the score of a recording."""
    model = model or FakeModel()
    score = DemoScore(DemoRecording(recording), model)
    runtime, series = Runtime(model, source="emulated", baselines={"4": BASELINE}), ScanSeries("4", USPA44)
    with np.load(recording) as data:
        shown = data["counts"]
    for index, counts in enumerate(shown):
        if index not in lost:
            score.add(runtime.push(series.close(counts.copy(), index * 10_000_000)))
    return score


def test_each_tap_is_scored_at_its_peak_by_that_frames_truth(recording):
    model = FakeModel()
    first, second = play(recording, model=model).scores()
    assert (first.tap, first.pose, second.tap, second.pose) == (0, (0, 0, 0), 1, (0, 0, -5))
    assert (first.result.taps_used, second.result.taps_used) == (1, 2)
    for got, frame, unit in ((first, 3, np.kron(np.eye(4), np.ones((10, 10)))), (second, 7, np.ones((40, 40)))):
        assert got.result.force_counts == pytest.approx(PRESSES[frame], abs=40)
        truth = unit * frame / 8
        np.testing.assert_allclose(got.truth, truth)
        assert got.psnr_db == pytest.approx(float(psnr_db(got.result.pattern, truth, 2.0)))
        assert got.rmse_percent == pytest.approx(float(rmse_percent(got.result.pattern, truth, 2.0)))
    newest = model.contract.scale_window(second.result.window[:1])
    alone = model.run(np.stack([*newest, np.zeros((3, 4, 4))], dtype="f4"))
    assert second.alone_percent == pytest.approx(float(rmse_percent(alone, second.truth, 2.0)))
    assert second.alone_percent != second.rmse_percent and first.alone_percent == first.rmse_percent


def test_a_lost_scan_shifts_nothing(recording):
    whole, gappy = play(recording).scores(), play(recording, lost=(0, 2, 5)).scores()
    assert [s.truth.tobytes() for s in gappy] == [s.truth.tobytes() for s in whole]
    assert gappy[0].result.scan.number != whole[0].result.scan.number


def test_each_scene_is_announced(recording, tmp_path):
    with np.load(recording) as data:
        arrays = dict(data)
    np.savez(tmp_path / "scenes.npz", **arrays | {"scene": np.array([-1, -1, 0, 0, 0, -1, 1, 1, -1])})
    runtime, series = Runtime(FakeModel(), source="emulated", baselines={"4": BASELINE}), ScanSeries("4", USPA44)
    results = [runtime.push(series.close(counts.copy(), n * 10_000_000)) for n, counts in enumerate(arrays["counts"])]
    events = []
    scenes = DemoScenes(DemoRecording(tmp_path / "scenes.npz"), events.append, lambda: pytest.fail("no other object"))
    for result in results:
        scenes.add(result)
    assert [(event.kind, event.text[:24]) for event in events] == [
        ("note", "demo: now another surfac"),
        ("note", "demo: now a magnet comes"),
    ]


def test_the_bundled_model_drops_foreign_taps_and_flags_a_magnet():
    runtime = Runtime(load_model(POSED_MODEL), source="emulated", options=RuntimeOptions(every_scan=True))
    series = ScanSeries("4", USPA44)
    with np.load(demo_recording()) as demo:
        before = np.argmax(demo["scene"] == SLIDE)
        counts, tap, scene = (demo[name][:before] for name in ("counts", "tap", "scene"))
    stated, results = [*load_recording(demo_recording()).poses], []
    for n, one in enumerate(counts):
        while stated[0].time_ns <= n * 10_000_000:
            pose = stated.pop(0)
            assert runtime.pose(pose.pose, pose.time_ns, holds=pose.holds)
        results.append(runtime.push(series.close(one.astype(np.int32), n * 10_000_000)))
    dropped = [scene[n] for n, one in enumerate(results) for event in one.events if event.kind == "tap_dropped"]
    assert dropped == [0] + [1] * 5, "the foreign one, and with the magnet all five of the first surface"
    made = np.array([one.pattern is not None for one in results])
    trusted = np.array([one.trusted is True for one in results])
    doubted = np.array([one.trusted is False for one in results])
    assert trusted[made & (tap >= 0)].mean() > 0.95 and trusted[made & (scene == 0)].mean() > 0.95
    assert doubted[made & (scene == 1)].mean() > 0.9
    used = np.array([one.taps_used or 0 for one in results])
    foreign, again = np.split(used[scene == 0], [TAP_FRAMES])
    assert set(foreign[foreign > 0]) == {1}, "of the foreign surface there is one tap"
    assert set(again[again > 0]) == {5}, "the first surface's four serve its fifth tap, without the foreign one"
    assert max(used[scene == 1]) == 1


@pytest.fixture(scope="module")
def posed(tmp_path_factory):
    """A tiny model that takes poses, pad and gains, as the one of the demo does."""
    path = tmp_path_factory.mktemp("posed") / "posed.onnx"
    pad_inputs = (("thickness_mm", 4.5, 0.5), ("counts_per_newton", 1000.0, 500.0))
    takes = {"trust": make_posed_trust(100.0).to_json(), "pad_inputs": pad_inputs, "takes_gains": True}
    write_posed_model(path, make_posed_contract(interval_factor=1.6, output_full_scale=100.0, **takes))
    return str(path)


def test_a_looping_demo_is_scored_once_and_begins_each_pass_anew(posed, tmp_path, capfd):
    """The demo's own scans, twice, from a link that waits for its reader: no machine is too slow for it."""
    with np.load(demo_recording()) as demo:
        tap_of, counts = demo["tap"], demo["counts"].astype(np.int32)
    poses = load_recording(demo_recording()).poses
    series, path = ScanSeries("4", USPA44), tmp_path / "out.jsonl"
    link = FakeLink([[series.close(one, n * 10_000_000)] for n, one in enumerate([*counts, *counts])], kind="emulated")
    link.patient = link.states_poses = True
    length_ns = len(counts) * 10_000_000
    waiting = [pose.later(again * length_ns) for again in (0, 1) for pose in poses]

    def stated():
        now_ns = link.reads * 10_000_000
        return [waiting.pop(0) for one in tuple(waiting) if one.time_ns < now_ns]

    link.poses = stated
    options = parsed_options("", ["--source", "demo:loop", "--sink", f"jsonl:{path}", "--model", posed])
    run_command.run(options, Source(link))
    out, err = capfd.readouterr()
    assert out.count("4 of 4 taps scored") == 1 and err.count("continues until Ctrl-C") == 1
    assert out.count("map of a letter of 50 mm") == 1
    assert all(err.count(f"demo: now {scene}") == 2 for scene in ("another surface", "a magnet", "the pad slides"))
    used: dict[tuple[int, int], set[int]] = {}
    for record in map(json.loads, path.read_text().splitlines()):
        if record["state"] != "event" and record["pattern"] is not None:
            again, frame = divmod(record["scan"], len(tap_of))
            used.setdefault((again, int(tap_of[frame])), set()).add(record["taps_used"])
    assert max(used[0, 3]) > 1 and used[1, 0] == {1}


def test_the_taps_of_the_demo_and_its_slide_are_both_scored(posed):
    """The whole program with a model that takes poses: a busy machine may lose scans, with which taps are forgotten."""
    # At its own rate: faster, a busy machine loses scans in the kernel, and with them the zeroing before the first tap.
    done = cli_samples.run("demo", "--model", posed, "--sink", "jsonl:-")
    assert done.returncode == 0, done.stderr
    assert "taps 'glyph:1' 4 times, turned by 5 degrees each time" in done.stderr
    results = [one for one in cli_samples.records(done.stdout) if one["state"] != "event"]
    assert {one["source"] for one in results} == {"emulated"}
    used: dict[float, int] = {}  # taps of the newest pattern, by the turn of the pad in [deg]
    for one in results:
        if one["state"] == "contact" and one["pose"] is not None and one["pose"]["x_mm"] == 0:
            used[one["pose"]["turn_deg"]] = one["taps_used"]
    whole = all(b["time_ns"] - a["time_ns"] < 500_000_000 and a["dead"] == b["dead"] for a, b in pairwise(results))
    assert not whole or [used[turn_deg] for turn_deg in (0, -5, -10, -15)] == [1, 2, 3, 4], (used, done.stderr)
    assert not whole or "4 of 4 taps scored" in done.stderr
    sliding = [one["pose"] for one in results[-250:] if one["pose"]]  # where the machine stands still poses are lost
    assert len({pose["x_mm"] for pose in sliding}) > 100 and "map of a letter of 50 mm" in done.stderr
