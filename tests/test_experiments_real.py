import csv

import numpy as np
import pytest
import torch
from experiment_samples import quick_bench

from firmware_bridge.recording import CSV_HEADER
from train.errors import DatasetError
from train.experiments import real
from train.experiments.hidden_taxel import (
    BILINEAR,
    GAMMAS,
    OTHERS,
    SIMULATED,
    TRUTH,
    ScanSet,
    fit_gamma,
    hidden_taxels,
    hide,
    linear_from_others,
    neighbours_mean,
    recorded_sets,
)
from train.experiments.workbench import Workbench
from train.networks.registry import build
from train.psf_net import degrade

REST = np.array([15_900, 16_430, 38_600])[:, None, None] + 11 * np.arange(16).reshape(4, 4)


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(0)
    return build("compact-stsr", 10, channels=16, blocks=1).eval()


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


def scans(count, seed, **more):
    rng = np.random.default_rng(seed)
    counts = rng.integers(100, 1500, (count, 3, 4, 4)).astype(np.float32)
    return ScanSet("1", str(seed), counts, **more)


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_a_hidden_taxel_reads_nothing_and_the_others_what_they_did():
    counts = scans(5, 1).counts
    hidden = hide(counts, 6)
    assert not hidden[:, :, 1, 2].any()
    hidden[:, :, 1, 2] = counts[:, :, 1, 2]
    np.testing.assert_array_equal(hidden, counts)


@pytest.mark.parametrize("truth_known", [True, False])
def test_no_method_sees_what_it_is_to_tell(net, truth_known):
    """Whatever the hidden taxel reads, the word on it is the same."""
    rng = np.random.default_rng(4)
    maps = rng.random((6, 40, 40), dtype=np.float32)
    sets = [scans(6, seed, patterns=maps if truth_known else None) for seed in (1, 2)]
    taxel = 9
    changed = sets[0].counts.copy()
    changed[:, :, taxel // 4, taxel % 4] = rng.integers(-9000, 9000, (6, 3))
    others = [ScanSet("1", "1", changed, sets[0].patterns), sets[1]]
    simulated = scans(40, 3).counts
    before, after = (hidden_taxels(these, {"net": net}, 0.6, simulated) for these in (sets, others))
    assert list(before) == ["net", BILINEAR, SIMULATED, TRUTH if truth_known else OTHERS]
    for name in before:
        np.testing.assert_allclose(after[name][0][:, taxel], before[name][0][:, taxel], rtol=1e-4)
        assert not np.allclose(after[name][0][:, taxel - 1], before[name][0][:, taxel - 1], rtol=1e-4)


def test_patterns_that_the_degradation_explains_are_told_exactly():
    patterns = np.random.default_rng(5).random((7, 40, 40), dtype=np.float32)
    z = 370 * degrade(torch.from_numpy(patterns), torch.tensor(0.6)).numpy()
    counts = np.zeros((7, 3, 4, 4), np.float32)
    counts[:, 2] = z
    told = hidden_taxels([ScanSet("1", "1", counts, patterns)], {}, 0.6, scans(40, 3).counts)
    np.testing.assert_allclose(told[TRUTH][0], z.reshape(7, 16), rtol=1e-4)


@pytest.mark.parametrize("index", [5, 30, 50])
def test_the_gamma_that_made_the_readings_is_found(index):
    patterns = np.random.default_rng(6).random((20, 40, 40), dtype=np.float32)
    z = 123 * degrade(torch.from_numpy(patterns), torch.tensor(GAMMAS[index])).flatten(1).numpy()
    gamma, unexplained = fit_gamma(patterns, z)
    assert gamma == GAMMAS[index]
    assert unexplained < 1e-9


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


def test_the_report_compares_all_methods_on_recordings_and_on_simulated_scans(recordings, tmp_path_factory):
    page = real.run(quick_bench(tmp_path_factory), tmp_path_factory.mktemp("reports"))
    rows = rows_of(page.with_suffix(".csv"))
    assert [(row["scans"], row["method"]) for row in rows] == [
        *(("recordings", name) for name in ("stsr", BILINEAR, SIMULATED, OTHERS)),
        *(("simulated", name) for name in ("stsr", BILINEAR, SIMULATED, TRUTH)),
    ]
    error = {(row["scans"], row["method"]): float(row["RMS error counts"].split()[0]) for row in rows}
    # Even a network of two steps leaves these two in their order: one has the truth.
    assert error["simulated", TRUTH] < error["simulated", "stsr"]
    assert {"correlation", "correlation within a trial", "parameters", "MMAC", "run time ms"} <= set(rows[0])
    for source in ("recordings", "simulated"):
        assert len(rows_of(page.with_name(f"real-{source}.csv"))) == 16
    assert page.with_suffix(".png").stat().st_size > 10_000
    assert str(recordings) not in page.read_text()


def test_a_quick_run_does_without_recordings_and_says_so(tmp_path, tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TACTILE_RECORDINGS", str(tmp_path))
    page = real.run(quick_bench(tmp_path_factory), tmp_path / "reports")
    assert "No recordings were there" in page.read_text()
    assert {row["scans"] for row in rows_of(page.with_suffix(".csv"))} == {"simulated"}
