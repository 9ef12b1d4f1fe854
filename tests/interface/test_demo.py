import dataclasses

import numpy as np
import pytest
from edge_samples import BASELINE, REST, FakeLink, FakeModel, ListSink, make_contract, make_scan

from edge.api import load_model
from edge.cli import main as cli
from edge.cli import run_command as run
from edge.cli.demo_scenes import DemoScenes
from edge.cli.demo_score import DemoScore, score_picture, score_table
from edge.errors import UsageError
from edge.evaluation.metrics import psnr_db, rmse_percent, ssim
from edge.inference.bundled import DEMO_MODEL, demo_recording
from edge.perception.contact_options import RuntimeOptions
from edge.perception.event import Event
from edge.perception.runtime import Runtime
from edge.pipeline.scan_reader import Source
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import ScanSeries

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
        angles_deg=np.array([10.0, 15.0]),
        surface=np.array("S"),
    )
    return path


def play(recording, *, lost=(), overtaken=()):
    score = DemoScore(recording, make_contract())
    runtime = Runtime(FakeModel(), source="emulated", baselines={"4": BASELINE})
    series = ScanSeries("4", USPA44)
    with np.load(recording) as data:
        for index, counts in enumerate(data["counts"]):
            if index not in lost:
                scan = series.close(counts.copy(), index * 10_000_000)
                score.write(runtime.push(scan, infer=index not in overtaken), {})
    return score


def test_each_tap_is_scored_at_its_peak_against_that_frames_truth(recording):
    score = play(recording)
    assert (score.surface, score.taps) == ("S", 2)
    first, second = score.scores()
    assert (first.tap, first.angle_deg, second.tap, second.angle_deg) == (0, 10.0, 1, 15.0)
    assert (first.result.taps_used, second.result.taps_used) == (1, 2)
    for got, frame, unit in ((first, 3, np.kron(np.eye(4), np.ones((10, 10)))), (second, 7, np.ones((40, 40)))):
        assert got.result.force_counts == pytest.approx(PRESSES[frame], abs=40)
        truth = unit * frame / 8
        np.testing.assert_allclose(got.truth, truth)
        assert got.psnr_db == pytest.approx(float(psnr_db(got.result.pattern, truth, 2.0)))
        assert got.ssim == pytest.approx(float(ssim(got.result.pattern, truth, 2.0)))
        assert got.rmse_percent == pytest.approx(float(rmse_percent(got.result.pattern, truth, 2.0)))


def test_a_lost_scan_shifts_nothing(recording):
    whole, gappy = play(recording).scores(), play(recording, lost=(0, 2, 5)).scores()
    assert [s.truth.tobytes() for s in gappy] == [s.truth.tobytes() for s in whole]
    assert gappy[0].result.scan.number != whole[0].result.scan.number


def test_without_a_pattern_at_the_peak_the_next_strongest_counts(recording):
    first, _ = play(recording, overtaken=(3,)).scores()
    np.testing.assert_allclose(first.truth.max(), 2 / 8)


def test_a_tap_without_any_pattern_has_no_score(recording):
    assert [score.tap for score in play(recording, lost=(2, 3, 4)).scores()] == [1]
    assert play(recording, lost=range(9)).scores() == []


def test_when_the_last_tap_is_over_it_says_so_once_and_a_second_pass_changes_nothing(recording):
    told = []
    score = DemoScore(
        recording, make_contract(), lambda score: told.append([one.result.scan.number for one in score.scores()])
    )
    runtime = Runtime(FakeModel(), source="emulated", baselines={"4": BASELINE})
    series = ScanSeries("4", USPA44)
    with np.load(recording) as data:
        for index, counts in enumerate([*data["counts"]] * 2):
            assert score.complete == (index >= len(PRESSES))
            score.write(runtime.push(series.close(counts.copy(), index * 10_000_000)), {})
    assert told == [[3, 7]]
    assert [one.result.scan.number for one in score.scores()] == [3, 7]


def told_of_scenes(results, path):
    events = []
    scenes = DemoScenes(path, events.append)
    for result in results:
        scenes.write(result, {})
    scenes.close()
    assert {event.kind for event in events} <= {"note"}
    return [event.text.removeprefix("demo: ") for event in events]


def test_each_scene_is_announced_and_then_told_how_it_went(recording, tmp_path):
    """Two passes; the scans of the second are doubted where the first are believed."""
    with np.load(recording) as data:
        arrays = dict(data)
    np.savez(tmp_path / "scenes.npz", **arrays | {"scene": np.array([-1, -1, 0, 0, 0, -1, 1, 1, -1])})
    runtime, series = Runtime(FakeModel(), source="emulated", baselines={"4": BASELINE}), ScanSeries("4", USPA44)
    scans = [series.close(counts.copy(), n * 10_000_000) for n, counts in enumerate([*arrays["counts"]] * 2)]
    results = [runtime.push(scan) for scan in scans]
    results[9 + 3] = dataclasses.replace(results[9 + 3], events=(Event(0, "tap_dropped", "4"),))
    results[9 + 7] = dataclasses.replace(results[9 + 7], trusted=False, untrusted_reason="unfamiliar")
    first, second = (told_of_scenes(part, tmp_path / "scenes.npz") for part in (results[:9], results[9:]))
    assert [line.split(" ")[:4] for line in first[::2]] == [
        ["now", "another", "surface", "is"],
        ["now", "a", "magnet", "comes"],
    ]
    assert second[::2] == first[::2]
    assert first[1].startswith("no tap was dropped") and first[3].startswith("0 of 2 patterns with the magnet")
    assert second[1] == "earlier taps were dropped 1 times" and second[3].startswith("1 of 2 patterns with the magnet")
    assert len(told_of_scenes(results[:7], tmp_path / "scenes.npz")) == 3, "a scene that is cut off has no outcome"


def test_the_bundled_model_drops_the_foreign_tap_and_flags_the_magnet():
    runtime = Runtime(
        load_model(DEMO_MODEL), source="emulated", options=RuntimeOptions(every_scan=True, every_tap=True)
    )
    series = ScanSeries("4", USPA44)
    with np.load(demo_recording()) as demo:
        counts, tap, scene = (demo[name] for name in ("counts", "tap", "scene"))
    results = [runtime.push(series.close(one.astype(np.int32), n * 10_000_000)) for n, one in enumerate(counts)]
    dropped = [scene[n] for n, one in enumerate(results) for event in one.events if event.kind == "tap_dropped"]
    assert dropped == [0, 0, 1]
    made = np.array([one.pattern is not None for one in results])
    trusted = np.array([one.trusted is True for one in results])
    doubted = np.array([one.trusted is False for one in results])
    assert trusted[made & (tap >= 0)].mean() > 0.95 and trusted[made & (scene == 0)].mean() > 0.95
    assert doubted[made & (scene == 1)].mean() > 0.9
    assert max(one.taps_used for one, part in zip(results, scene, strict=True) if part >= 0) == 1


def test_rest_and_foreign_scans_are_not_scored(recording):
    score = DemoScore(recording, make_contract())
    runtime = Runtime(FakeModel(), source="emulated", baselines={"4": BASELINE})
    score.write(runtime.push(make_scan(0, press_counts=9999)), {})
    assert score.scores() == []


def test_the_table_has_a_line_a_tap_and_fits_40_columns(recording):
    scores = [
        dataclasses.replace(s, psnr_db=-12.301, rmse_percent=123.456, ssim=0.98765, angle_deg=30)
        for s in play(recording).scores()
    ]
    scores[0] = dataclasses.replace(scores[0], result=dataclasses.replace(scores[0].result, run_time_us=321.4))
    lines = score_table(scores).splitlines()
    assert len(lines) == 2 + 2 and max(map(len, lines)) <= 40
    assert lines[2].split() == ["1", "30", "1", "-12.30", "0.988", "123.46", "-", "321"]
    scores[0] = dataclasses.replace(scores[0], result=dataclasses.replace(scores[0].result, interval_mm=0.1234))
    lines = score_table(scores).splitlines()
    assert max(map(len, lines)) <= 40 and lines[2].split()[-2:] == ["123", "321"]
    assert lines[0].index("+-") + 1 == lines[1].index("um") + 1 == lines[2].index("123", 30) + 2


def test_the_picture_shows_taxels_result_and_truth_on_their_scales(recording):
    score = play(recording).scores()[0]
    text = score_picture(score, 80, "plain")
    title, *_, scale = text.splitlines()
    assert title.split("  ")[0] == "taxels, 4 x 4" and "super-resolved, 40 x 40" in title and title.endswith("truth")
    assert scale.count(f" {score.result.pattern.max():.3g} mm") == 2 and "counts" in scale
    louder = score_picture(dataclasses.replace(score, truth=score.truth * 100), 80, "plain")
    assert louder.splitlines()[-1].count(f" {score.truth.max() * 100:.3g} mm") == 2
    taxels_z = score.result.scan.counts[2] - REST[2]
    assert f" {taxels_z.max():.0f} counts" in scale


def test_a_demo_that_goes_on_is_scored_once_and_each_pass_begins_at_its_first_tap(monkeypatch, capfd):
    """The demo's own scans, twice, from a link that waits for its reader: no machine is too slow for it."""
    with np.load(demo_recording()) as demo:
        tap_of, counts = demo["tap"], demo["counts"].astype(np.int32)
    series, sink = ScanSeries("4", USPA44), ListSink()
    link = FakeLink([[series.close(one, n * 10_000_000)] for n, one in enumerate([*counts, *counts])], kind="emulated")
    link.patient = True
    monkeypatch.setattr(cli, "_open_source", lambda options, give_up_s: Source(link))
    monkeypatch.setattr(run, "open_sink", lambda text, **facts: sink)
    assert cli.main(["--source", "demo:loop", "--sink", "status"]) == 0
    out, err = capfd.readouterr()
    assert out.count("4 of 4 taps scored") == 1 and err.count("continues until Ctrl-C") == 1
    assert err.count("demo: now another surface is tapped") == err.count("demo: now a magnet comes near") == 2
    used: dict[tuple[int, int], set[int]] = {}
    for result in sink.results:
        if result.pattern is not None:
            again, frame = divmod(result.scan.number, len(tap_of))
            used.setdefault((again, int(tap_of[frame])), set()).add(result.taps_used)
    assert max(used[0, 3]) > 1 and used[1, 0] == {1}


@pytest.mark.parametrize(
    ("arguments", "terminal", "source"),
    [(["--view"], True, "demo:loop"), (["--view"], False, "demo"), ([], True, "demo")],
)
def test_only_who_looks_at_the_page_from_a_terminal_gets_a_demo_without_end(monkeypatch, arguments, terminal, source):
    class AskedError(UsageError):
        pass

    def ask(options, give_up_s):
        raise AskedError(*options.source)

    monkeypatch.setattr(cli, "_open_source", ask)
    monkeypatch.setattr(cli.sys.stdout, "isatty", lambda: terminal)
    monkeypatch.setattr(cli, "_exit_code", lambda error: str(error))
    assert cli.main(["demo", *arguments]) == source


def test_the_demo_takes_no_other_source(capsys):
    assert cli.main(["demo", "--source", "gs_usb"]) == 2
    assert "leave out --source gs_usb" in capsys.readouterr().err
