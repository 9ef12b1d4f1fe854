import io
import json

import numpy as np
import pytest
from edge_samples import FakeLink, FakeModel, ListSink
from pose_samples import make_posed_contract, write_posed_model
from trust_samples import make_posed_trust

from edge.api import POSED_MODEL, USPA44, Commands, Runtime, Source, demo_recording, load_model
from edge.cli import run_command
from edge.cli.demo import Demo, Scene
from edge.cli.main import parsed_options
from edge.evaluation.metrics import psnr_db, rmse_percent
from edge.perception.run_options import RuntimeOptions
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.scan import ScanSeries
from train.demo import TAP_FRAMES


@pytest.fixture(scope="module")
def demo():
    with np.load(demo_recording()) as data:
        return dict(data)


def play(demo, lost=()):
    """Return the scores of the demo without some of its scans, a tiny model, and notes of the scenes."""
    model, sink = FakeModel(), ListSink()
    shown = Demo(model, io.StringIO(), None, [sink], Commands(), loops=False, maps=False)
    runtime, series = Runtime(model, source="emulated"), ScanSeries("4", USPA44)
    for n, counts in enumerate(demo["counts"][: np.argmax(demo["scene"] == Scene.SLIDE) + 1]):
        if n not in lost:
            shown.write(runtime.push(series.close(counts.copy(), n * 10_000_000)), {})
    assert shown.score.complete
    return shown.score.scores(), model, sink.events


def test_each_tap_is_scored_at_its_peak_by_that_frames_truth(demo):
    scores, model, events = play(demo)
    assert [(one.tap, one.pose) for one in scores] == [(tap, (0, 0, -5 * tap)) for tap in range(4)]
    assert [one.result.taps_used for one in scores] == [1, 2, 3, 4]
    for one in scores:
        truth = demo["unit_patterns"][one.tap] * demo["indentation_mm"][demo["tap"] == one.tap].max()
        np.testing.assert_allclose(one.truth, truth, rtol=1e-3)
        assert one.psnr_db == pytest.approx(float(psnr_db(one.result.pattern, truth, 2.0)), abs=1e-3)
        newest = model.contract.scale_window(one.result.window[:1])
        alone = model.run(np.stack([*newest, *np.zeros((3, 3, 4, 4))], dtype="f4"))
        for percent, pattern in ((one.rmse_percent, one.result.pattern), (one.alone_percent, alone)):
            assert percent == pytest.approx(float(rmse_percent(pattern, truth, 2.0)), abs=1e-3)
    assert [(one.alone_percent == one.rmse_percent) for one in scores] == [True, False, False, False]
    begun = ["demo: now another surface", "demo: now a magnet comes", "demo: now the pad slides"]
    assert [event.text[: len(words)] for event, words in zip(events, begun, strict=True)] == begun
    gappy = play(demo, lost=(110, 152, 175, 176, 250))[0]  # a lost scan shifts nothing
    assert [one.truth.tobytes() for one in gappy] == [one.truth.tobytes() for one in scores]
    assert gappy[0].result.scan.number != scores[0].result.scan.number


def test_the_bundled_model_drops_foreign_taps_and_flags_a_magnet(demo):
    runtime = Runtime(load_model(POSED_MODEL), source="emulated", options=RuntimeOptions(every_scan=True))
    series = ScanSeries("4", USPA44)
    before = np.argmax(demo["scene"] == Scene.SLIDE)
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


def test_a_looping_demo_is_scored_once_and_begins_each_pass_anew(demo, tmp_path, capfd):
    """The demo's own scans, twice, from a link that waits for its reader: no machine is too slow for it."""
    # A tiny model that takes poses, pad and gains, as the one of the demo does.
    pad_inputs = (("thickness_mm", 4.5, 0.5), ("counts_per_newton", 1000.0, 500.0))
    takes = {"trust": make_posed_trust(100.0).to_json(), "pad_inputs": pad_inputs, "takes_gains": True}
    contract = make_posed_contract(interval_factor=1.6, output_full_scale=100.0, **takes)
    model = tmp_path / "posed.onnx"
    write_posed_model(model, contract)
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
    options = parsed_options("", ["--source", "demo:loop", "--sink", f"jsonl:{path}", "--model", str(model)])
    run_command.run(options, Source(link))
    out, err = capfd.readouterr()
    assert out.count("4 of 4 taps scored") == 1 and err.count("continues until Ctrl-C") == 1
    assert out.count("map of a letter of 50 mm") == 1
    assert "taps 'glyph:1' 4 times, turned by 5 degrees each time" in err
    assert all(err.count(f"demo: now {scene}") == 2 for scene in ("another surface", "a magnet", "the pad slides"))
    used: dict[tuple[int, int], set[int]] = {}
    for record in map(json.loads, path.read_text().splitlines()):
        if record["state"] != "event" and record["pattern"] is not None:
            again, frame = divmod(record["scan"], len(tap_of))
            used.setdefault((again, int(tap_of[frame])), set()).add(record["taps_used"])
    assert [max(used[0, tap]) for tap in range(4)] == [1, 2, 3, 4] and used[1, 0] == {1}
