import csv
from dataclasses import replace

import numpy as np
import pytest
from experiment_samples import grip, quick_bench, save_recordings

from edge.inference.bundled import DEFAULT_MODEL, find_model
from edge.inference.onnx_session import ModelSession
from edge.perception.taxel_health import HOLD_SCANS
from train.data.real_grips import neighbours_mean, recorded_grips, recorded_sets
from train.errors import DatasetError
from train.experiments.sensor import real
from train.experiments.workbench import Workbench


@pytest.fixture
def recordings(tmp_path, monkeypatch):
    save_recordings(tmp_path)
    monkeypatch.setenv("TACTILE_RECORDINGS", str(tmp_path))
    return tmp_path


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_neighbours_tell_a_plane_exactly_inside_the_rim():
    row, col = np.mgrid[:4, :4]
    plane = (100 + 30 * row - 50 * col).astype(float)
    said = neighbours_mean(plane.reshape(1, 16)).reshape(4, 4)
    np.testing.assert_allclose(said[1:3, 1:3], plane[1:3, 1:3])
    np.testing.assert_allclose(said[0, 0], (plane[0, 1] + plane[1, 0]) / 2)
    np.testing.assert_allclose(neighbours_mean(np.full((1, 16), 7.0)), 7)


def test_recordings_are_zeroed_by_the_trial_that_lets_go(recordings):
    sets = {(part.sensor, part.trial): part.counts for part in recorded_sets(recordings)}
    assert set(sets) == {(f"xela_sensor{n}", f"trial-{t}") for n in (1, 2) for t in "ab"}
    for trial, released in (("trial-a", False), ("trial-b", True)):
        kept = grip(released)
        again = np.zeros(len(kept), bool)
        again[10:30:10] = True
        if released:
            again[30:] = True
        np.testing.assert_array_equal(sets["xela_sensor1", trial], kept[~again])


def test_a_folder_without_recordings_is_named_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setenv("TACTILE_RECORDINGS", str(tmp_path / "none"))
    with pytest.raises(DatasetError, match="TACTILE_RECORDINGS"):
        real.run(Workbench(tmp_path / "data", tmp_path / "checkpoints"), tmp_path)
    assert not (tmp_path / "data").exists()


def test_a_damaged_recording_is_named(recordings):
    (recordings / "trial-a" / "xela_sensor1.csv").write_text("nothing\n")
    with pytest.raises(DatasetError, match=r"trial-a/xela_sensor1\.csv, line 1"):
        recorded_sets(recordings)


def test_measures_of_a_face_of_half_a_face_and_of_a_hole():
    face, half, hole = np.ones((3, 40, 40))
    half[:20] = 0
    hole[15:20, 15:20] = 0
    patterns = np.stack([face, half, hole])
    np.testing.assert_allclose(real.share_touched(patterns), [1, 0.5, 1 - 25 / 1600])
    np.testing.assert_allclose(real.unevenness(patterns)[:2], [0, 1])
    assert real.has_hole(patterns).tolist() == [False, False, True]


def test_a_hidden_taxel_is_not_seen_by_what_tells_it(recordings):
    """Whatever it reads."""
    model = ModelSession(find_model(DEFAULT_MODEL))
    grip = recorded_grips(recordings)[0]
    changed = grip.counts.copy()
    changed[:, :, 1, 2] += 700
    other = replace(grip, counts=changed)
    before, after = (real.play(one, model, hidden=6) for one in (grip, other))
    assert np.isfinite(before.patterns[HOLD_SCANS:]).all() and len(before.believed) == len(before.patterns)
    np.testing.assert_array_equal(before.patterns, after.patterns)
    whole, moved = (real.play(one, model) for one in (grip, other))
    assert np.abs(whole.patterns - moved.patterns).max() > 0.01
    np.testing.assert_array_equal(whole.zeroed[:, :, 0], moved.zeroed[:, :, 0])


def test_the_report_compares_the_shipped_way_with_a_linear_one(recordings, tmp_path_factory):
    page = real.run(quick_bench(tmp_path_factory), tmp_path_factory.mktemp("reports"))
    rows = {row["method"]: row for row in rows_of(page.with_suffix(".csv"))}
    assert list(rows) == [DEFAULT_MODEL, "bilinear"]
    for row in rows.values():
        assert 0 < float(row["share of the pad"]) <= 1 and float(row["hidden taxel counts"].split()[0]) > 0
    trials = rows_of(page.with_name("real-trials.csv"))
    assert [(row["trial"], row["sensor"]) for row in trials] == [
        (f"trial-{trial}", f"xela_sensor{sensor}") for sensor in (1, 2) for trial in "ab"
    ]
    assert page.with_suffix(".png").stat().st_size > 10_000
    assert str(recordings) not in page.read_text()
