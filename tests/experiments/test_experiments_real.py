import csv
from dataclasses import replace

import numpy as np
import pytest
from experiment_samples import quick_bench

from edge.inference.bundled import DEFAULT_MODEL, find_model
from edge.inference.onnx_session import ModelSession
from edge.perception.taxel_health import HOLD_SCANS
from firmware_bridge.recording.csv_reader import CSV_HEADER
from train.data.real_grips import (
    from_other_trials,
    linear_from_others,
    neighbours_mean,
    recorded_grips,
    recorded_sets,
)
from train.errors import DatasetError
from train.experiments.sensor import real
from train.experiments.support.workbench import Workbench

REST = np.array([15_900, 16_430, 38_600])[:, None, None] + 11 * np.arange(16).reshape(4, 4)


@pytest.fixture
def recordings(tmp_path, monkeypatch):
    """Two trials of two sensors: one grips all the time, the other lets go; its last rows are the rest level."""
    for trial, released in (("trial-a", False), ("trial-b", True)):
        for sensor in ("sensor1", "sensor2"):
            save_recording(tmp_path / trial / f"xela_{sensor}.csv", REST + grip(released))
    monkeypatch.setenv("TACTILE_RECORDINGS", str(tmp_path))
    return tmp_path


def grip(released):
    """Counts above rest, (60, 3, 4, 4): every row another, one in ten sent again."""
    rng = np.random.default_rng(int(released))
    pressed = 900 + rng.integers(-300, 300, (60, 3, 4, 4))
    if released:
        pressed[30:] = 0
    pressed[10:30:10] = pressed[9:29:10]
    return pressed


def save_recording(path, counts):
    path.parent.mkdir(parents=True, exist_ok=True)
    taxels_by_axes = counts.transpose(0, 2, 3, 1).reshape(len(counts), -1)
    lines = [",".join(CSV_HEADER), *(",".join(f"{value}.0" for value in row) for row in taxels_by_axes)]
    path.write_text("\n".join(lines) + "\n")


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


def test_least_squares_tell_a_taxel_that_the_others_determine():
    rng = np.random.default_rng(7)
    shapes = rng.normal(size=(3, 16))
    fitted_on, z = rng.normal(size=(200, 3)) @ shapes, rng.normal(size=(10, 3)) @ shapes
    np.testing.assert_allclose(linear_from_others(fitted_on, z), z, atol=0.01)


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


def test_a_trial_is_told_from_the_others_alone():
    rng = np.random.default_rng(8)
    z = [rng.normal(size=(60, 3)) @ rng.normal(size=(3, 16)) for _ in range(3)]
    told = from_other_trials(["a", "a", "b"], z)
    np.testing.assert_allclose(told[0], linear_from_others(z[2], z[0]), rtol=1e-6)
    np.testing.assert_allclose(told[2], linear_from_others(np.concatenate(z[:2]), z[2]), rtol=1e-6)


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
    assert np.isfinite(before.patterns[HOLD_SCANS:]).all() and before.run_time_us[-1] > 0
    np.testing.assert_array_equal(before.patterns, after.patterns)
    whole, moved = (real.play(one, model) for one in (grip, other))
    assert np.abs(whole.patterns - moved.patterns).max() > 0.01
    np.testing.assert_array_equal(whole.zeroed[:, :, 0], moved.zeroed[:, :, 0])


def test_the_report_compares_the_shipped_way_with_linear_ones(recordings, tmp_path_factory):
    page = real.run(quick_bench(tmp_path_factory), tmp_path_factory.mktemp("reports"))
    rows = {row["method"]: row for row in rows_of(page.with_suffix(".csv"))}
    shipped = [DEFAULT_MODEL, "bilinear", "linear map"]
    fitted = [f"{DEFAULT_MODEL}, gains fitted on other trials", "linear map, fitted on other trials"]
    assert list(rows) == shipped + fitted
    for name in shipped:
        assert 0 < float(rows[name]["share of the pad"]) <= 1 and float(rows[name]["run time us"]) > 0
        assert float(rows[name]["hidden taxel counts"].split()[0]) > 0
    trials = rows_of(page.with_name("real-trials.csv"))
    assert [(row["trial"], row["sensor"]) for row in trials] == [
        (f"trial-{trial}", f"xela_sensor{sensor}") for sensor in (1, 2) for trial in "ab"
    ]
    assert page.with_suffix(".png").stat().st_size > 10_000
    assert str(recordings) not in page.read_text()
