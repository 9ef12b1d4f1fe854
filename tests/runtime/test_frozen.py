from dataclasses import replace

import numpy as np
import pytest

from edge.evaluation.test_set import FrozenSet, FrozenSetError, load_frozen_set
from edge.inference.bundled import BUNDLE_DIR


@pytest.fixture
def small():
    rng = np.random.default_rng(0)
    return FrozenSet(
        newest=rng.integers(-50, 50, (6, 3, 4, 4)).astype(np.int16),
        earlier=rng.integers(-50, 50, (2, 3, 3, 4, 4)).astype(np.int16),
        tap=np.array([0, 0, 0, 1, 1, 1], dtype=np.int16),
        indentation_mm=np.linspace(0.1, 0.6, 6).astype(np.float32),
        force_n=np.linspace(1, 6, 6).astype(np.float32),
        unit_patterns=np.stack([np.eye(40), np.full((40, 40), 0.5)]).astype(np.float16),
        touched=np.stack([np.eye(40) > 0, np.zeros((40, 40), dtype=bool)]),
        surface=np.array(["C", "F"]),
        angle_deg=np.array([0, 30], dtype=np.float32),
        full_scale_mm=0.5,
    )


def test_windows_are_newest_first_and_absent_taps_are_zero(small):
    windows = small.windows(4)
    assert windows.shape == (6, 4, 3, 4, 4)
    assert (windows[4, 0] == small.newest[4]).all()
    assert (windows[4, 2] == small.earlier[1, 1]).all()
    given_two = small.windows(4, given=2)
    assert (given_two[:, :2] == windows[:, :2]).all()
    assert not given_two[:, 2:].any()
    assert small.windows(1).shape == (6, 1, 3, 4, 4)


@pytest.mark.parametrize("taps", [0, 8])
def test_more_taps_than_there_are_are_refused(small, taps):
    with pytest.raises(FrozenSetError, match=f"windows of {taps} taps asked for, the frozen test set has"):
        small.windows(taps)


def test_truth_is_the_unit_pattern_times_the_indentation(small):
    assert np.allclose(small.patterns()[5], 0.5 * 0.6)
    assert np.allclose(small.patterns()[1].diagonal(), small.indentation_mm[1])
    assert small.touching()[0].sum() == 40
    assert not small.touching()[5].any()
    assert small.scale == 10


def test_a_file_gives_back_the_set(small, tmp_path):
    small.save(tmp_path / "set.npz")
    assert load_frozen_set(tmp_path / "set.npz").sha256() == small.sha256()


def test_a_set_that_cannot_be_read_back_does_not_replace_one_that_can(small, tmp_path):
    path = tmp_path / "set.npz"
    small.save(path)
    with pytest.raises(FrozenSetError):
        replace(small, full_scale_mm=0.0).save(path)
    assert load_frozen_set(path).sha256() == small.sha256() and [one.name for one in tmp_path.iterdir()] == ["set.npz"]


def test_the_hash_sees_every_array(small):
    changed = replace(small, indentation_mm=small.indentation_mm + np.float32(1e-6))
    assert changed.sha256() != small.sha256()
    assert replace(small, surface=np.array(["C", "G"])).sha256() != small.sha256()


def test_what_is_no_frozen_set_is_refused(tmp_path, small):
    with pytest.raises(FrozenSetError, match="No such file"):
        load_frozen_set(tmp_path / "none.npz")
    np.savez(tmp_path / "other.npz", newest=small.newest)
    with pytest.raises(FrozenSetError, match="earlier"):
        load_frozen_set(tmp_path / "other.npz")


def test_the_bundled_set_is_the_one_that_is_frozen():
    frozen = load_frozen_set(BUNDLE_DIR / "frozen.npz")
    assert len(frozen) == 1152
    assert len(set(frozen.surface.tolist())) == 18
    assert float(frozen.patterns().max()) <= frozen.full_scale_mm
