"""Sets of presses: written whole, read back the same, and refused in one line where they are not."""

from dataclasses import replace

import numpy as np
import pytest
from press_samples import make_press_set

from train.data.presses import join_presses, load_presses
from train.errors import DatasetError
from train.learning.checkpoint import batches_of
from train.learning.training_loop import Recipe


def arrays_of(presses):
    return {name: getattr(presses, name) for name in ("family", "pad", "counts", "patterns", "touching", "twist_nmm")}


@pytest.mark.parametrize("compressed", [False, True])
def test_what_is_saved_is_read_back_to_the_bit(tmp_path, compressed):
    made = make_press_set()
    made.save(tmp_path / "deep" / "presses.npz", compressed=compressed)
    read = load_presses(tmp_path / "deep" / "presses.npz")
    assert read.sha256() == made.sha256() and read.config == made.config
    for name, array in arrays_of(made).items():
        assert getattr(read, name).dtype == array.dtype and np.array_equal(getattr(read, name), array), name
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["presses.npz"]
    content = (tmp_path / "deep" / "presses.npz").read_bytes()
    made.save(tmp_path / "again.npz", compressed=compressed)
    assert (tmp_path / "again.npz").read_bytes() == content


@pytest.mark.parametrize("name", ["counts", "touching", "family", "constants", "traction_kpa", "config"])
def test_the_hash_changes_with_everything(name):
    made = make_press_set()
    if name == "config":
        other = replace(made, config={**made.config, "seed": 1})
    else:
        array = getattr(made, name).copy()
        array[-1] = ~array[-1] if array.dtype == bool else array[0]
        other = replace(made, **{name: array})
    assert other.sha256() != made.sha256()


def test_a_damaged_file_is_told_from_one_that_is_none(tmp_path):
    made, path = make_press_set(), tmp_path / "presses.npz"
    made.save(path)
    with np.load(path) as held:
        arrays = dict(held)
    arrays["counts"][0, 0, 0, 0, 0] += 1
    np.savez(path, **arrays)
    with pytest.raises(DatasetError, match=r"presses\.npz is damaged: its sha256 is .*: make it again$"):
        load_presses(path)
    for name, value, told in (
        ("counts", arrays["counts"][:3], r"expected float32 \(12, "),
        ("counts", arrays["counts"].astype(np.float64), "'counts' is float64"),
        ("version", np.array(99), "of version 99, expected .* of at most 3"),
        ("schema", np.array("another"), "is 'another' of version 3"),
        ("facts", np.array("{"), "or a damaged one"),
    ):
        np.savez(path, **{**arrays, name: value})
        with pytest.raises(DatasetError, match=rf"presses\.npz.*{told}"):
            load_presses(path)


@pytest.mark.parametrize("content", [None, b"", b"no zip at all", "cut"])
def test_what_is_no_file_of_presses_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / "presses.npz"
    make_press_set(count=3).save(path)
    if content == "cut":
        path.write_bytes(path.read_bytes()[:2000])
    elif content is None:
        path.unlink()
    else:
        path.write_bytes(content)
    with pytest.raises(DatasetError, match=r"^[^\n]*presses\.npz[^\n]*make (it again|one with)[^\n]*$"):
        load_presses(path)


def test_sets_are_joined_with_their_pads_apart():
    one, two = make_press_set(taps=1), make_press_set(count=5, taps=3, seed=1)
    empty = one.pick(np.zeros(12, dtype=bool))
    joined = join_presses([one, empty, two])
    assert len(joined) == 17 and joined.taps == 3
    assert len(np.unique(joined.pad)) == 3 + 2 and joined.pad[:12].max() < joined.pad[12:].min()
    assert np.array_equal(joined.counts[12:], two.counts) and not joined.counts[:12, 1:].any()
    assert joined.config == {"parts": [one.config, one.config, two.config]}
    assert join_presses([two]).sha256() == two.sha256()
    with pytest.raises(DatasetError, match="name at least one file"):
        join_presses([])


def test_only_sequences_with_all_taps_are_trained_on():
    joined = join_presses([make_press_set(taps=1), make_press_set(count=6, taps=2, seed=1)])
    batch = batches_of(joined, 10, Recipe(1, batch=64, given=(0.0, 1.0)), seed=0)(0)
    assert len(batch.window) == 6 and (batch.window[:, 3:].abs().amax(dim=(1, 2, 3)) > 0).all()
    with pytest.raises(DatasetError, match="no sequences of 3 taps: make some with"):
        batches_of(joined, 10, Recipe(1, given=(0.5, 0.0, 0.5)), seed=0)
    with pytest.raises(DatasetError, match="patterns at x8 asked for, these presses have them at x10"):
        batches_of(joined, 8, Recipe(1), seed=0)
