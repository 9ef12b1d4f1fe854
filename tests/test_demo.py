import dataclasses

import numpy as np
import pytest
from edge_samples import BASELINE, REST, FakeModel, make_contract, make_scan

from edge.demo import DemoScore, score_picture, score_table
from edge.metrics import psnr_db, rmse_percent, ssim
from edge.runtime import Runtime
from firmware_bridge.geometry import USPA44
from firmware_bridge.scan import ScanSeries

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
