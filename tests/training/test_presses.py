"""Sets of presses: written whole and read back the same, or refused in one line; and batches of them."""

from dataclasses import replace

import numpy as np
import pytest
from press_samples import make_press_set

from train.data.frozen_presses import freeze_presses, load_frozen_presses
from train.data.press_batches import COUNTS_PER_UNIT, PressBatches
from train.data.presses import join_presses, load_presses
from train.errors import DatasetError
from train.families.catalogue import SHARES
from train.learning.checkpoint import batches_of
from train.learning.training_loop import Recipe
from train.physics.pad_draws import INPUTS
from train.physics.sensor_noise import NAMES, Nuisances


def test_what_is_saved_is_read_back_to_the_bit(tmp_path):
    made = make_press_set()
    made.save(tmp_path / "deep" / "presses.npz")
    read = load_presses(tmp_path / "deep" / "presses.npz")
    assert read.sha256() == made.sha256() and read.config == made.config
    for name in ("family", "pad", "counts", "patterns", "touching", "twist_nmm"):
        array = getattr(made, name)
        assert getattr(read, name).dtype == array.dtype and np.array_equal(getattr(read, name), array), name
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["presses.npz"]
    content = (tmp_path / "deep" / "presses.npz").read_bytes()
    made.save(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == content


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

    made.save(path)
    for content in (path.read_bytes()[:2000], b"", b"no zip at all", None):
        path.unlink() if content is None else path.write_bytes(content)
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


QUIET = Nuisances().without(*NAMES)
GAINS_ALONE = replace(QUIET, gain_spread=0.1)


@pytest.fixture(scope="module")
def presses():
    return make_press_set(count=64, taps=2)


def test_half_of_the_windows_of_one_tap_are_mirror_images(presses):
    batch = PressBatches(presses, (1.0,), 64, seed=7, nuisances=QUIET)(0)
    sums = presses.traction_kpa.astype(np.float32).sum(axis=(2, 3))[:, 1:]  # no mirror changes those of y and z
    index = np.abs(batch.traction.sum(dim=(2, 3)).numpy()[:, None, 1:] - sums).sum(axis=2).argmin(axis=1)
    own = presses.pick(index)
    mirrored = (batch.traction.numpy() != own.traction_kpa.astype(np.float32)).any(axis=(1, 2, 3))
    assert sorted(index) == list(range(64)) and 0.3 < mirrored.mean() < 0.7
    units = np.asarray(COUNTS_PER_UNIT, dtype=np.float32)[:, None, None]
    signs = np.where(mirrored[:, None], (-1, 1, 1), 1)[..., None, None]
    for found, expected, within in (
        (batch.traction.numpy(), own.traction_kpa, 0.01),
        (batch.window.numpy() * units, own.counts[:, 0], 0.51),
    ):
        image = np.where(mirrored[:, None, None, None], expected[..., ::-1], expected) * signs
        assert np.abs(found - image)[batch.pad[:, -1].numpy() == 0].max() <= within


def test_gains_of_frozen_presses_divide_out(presses):
    frozen = freeze_presses(presses, 9, GAINS_ALONE)
    raw, evened = frozen.windows(2), frozen.windows(2, gains_known=True)
    assert np.abs(evened - presses.counts).max() < 1.2, "but for two roundings to whole counts"
    assert np.abs(raw - presses.counts).max() > 20
    assert freeze_presses(presses, 9, GAINS_ALONE).presses.sha256() == frozen.presses.sha256()
    assert freeze_presses(presses, 10, GAINS_ALONE).presses.sha256() != frozen.presses.sha256()
    assert not frozen.pads(known=False).any()
    assert (frozen.pads(known=True)[:, len(INPUTS) :] == 1).all()
    assert np.array_equal(frozen.pads(known=True)[:, : len(INPUTS)], presses.constants)


WIDE_SHA256 = "edeb2202b59f15f51a49c3e5c96b8a1d752b877ffb50361257bf527b2cbedac2"


def test_the_wide_set_is_the_one_that_figures_are_of():
    """It is a file of version 2, which has no poses: they follow from its turns."""
    wide = load_frozen_presses().presses
    assert wide.sha256() == WIDE_SHA256
    assert set(wide.family) == set(SHARES) and len(np.unique(wide.pad)) == 126
    x_mm, y_mm, turn_deg = np.moveaxis(wide.poses, -1, 0)
    assert not x_mm.any() and not y_mm.any() and np.allclose(np.median(turn_deg, axis=0), (0, 5, 10, 15))
    assert replace(wide, poses=wide.poses + np.float32([0.1, 0, 0])).sha256() != WIDE_SHA256
