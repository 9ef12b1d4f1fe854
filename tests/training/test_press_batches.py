"""Batches of presses: one number is one batch, and the gains given are those applied; and the wide frozen set."""

from dataclasses import replace

import numpy as np
import pytest
from press_samples import make_press_set

from train.data.frozen_presses import freeze_presses, load_frozen_presses, main
from train.data.press_batches import COUNTS_PER_UNIT, PressBatches
from train.families.family_shares import SHARES
from train.physics.pad_draws import INPUTS
from train.physics.sensor_noise import NAMES, Nuisances

QUIET = Nuisances().without(*NAMES)
GAINS_ALONE = replace(QUIET, gain_spread=0.1)


@pytest.fixture(scope="module")
def presses():
    return make_press_set(count=64, taps=2)


def counts_of(batch):
    """Newest taps of a batch, (n, 3, rows, cols) in counts."""
    return batch.window[:, :3].numpy() * np.asarray(COUNTS_PER_UNIT, dtype=np.float32)[:, None, None]


def test_an_epoch_takes_every_sequence_once_with_its_own_truth(presses):
    """Windows of two taps are not mirrored: a mirrored pad would turn the other way."""
    batches = PressBatches(presses, (0.0, 1.0), 16, seed=1, nuisances=QUIET)
    marks = [row.tobytes() for row in presses.traction_kpa[:, 0, 0].astype(np.float32)]  # each has its own
    for first in (0, 4):
        drawn = [batches(number) for number in range(first, first + 4)]
        traction = np.concatenate([batch.traction.numpy() for batch in drawn])
        index = [marks.index(row.tobytes()) for row in traction[:, 0, 0]]
        assert sorted(index) == list(range(64))
        assert np.array_equal(traction, presses.traction_kpa[index].astype(np.float32))
        patterns = np.concatenate([batch.pattern.numpy() for batch in drawn])
        assert np.array_equal(patterns, presses.patterns[index].astype(np.float32))
        apart = np.abs(np.concatenate([counts_of(batch) for batch in drawn]) - presses.counts[index, 0])
        unknown = np.concatenate([batch.pad[:, -1].numpy() for batch in drawn]) == 0
        assert apart[unknown].max() < 0.51, "no nuisance but the rounding"
        assert apart[~unknown].max() > 1, "gains are estimated, with an error that their certainty states"


def test_half_of_the_windows_of_one_tap_are_mirror_images(presses):
    batch = PressBatches(presses, (1.0,), 64, seed=7, nuisances=QUIET)(0)
    sums = presses.traction_kpa.astype(np.float32).sum(axis=(2, 3))[:, 1:]  # no mirror changes those of y and z
    index = np.abs(batch.traction.sum(dim=(2, 3)).numpy()[:, None, 1:] - sums).sum(axis=2).argmin(axis=1)
    own = presses.pick(index)
    mirrored = (batch.traction.numpy() != own.traction_kpa.astype(np.float32)).any(axis=(1, 2, 3))
    assert sorted(index) == list(range(64)) and 0.3 < mirrored.mean() < 0.7
    unknown = batch.pad[:, -1].numpy() == 0
    for name, found, within in (
        ("traction_kpa", batch.traction.numpy(), 0.01),
        ("patterns", batch.pattern.numpy(), 1e-6),
        ("counts", counts_of(batch), 0.51),
    ):
        expected = getattr(own, name).astype(np.float32)
        expected = expected[:, 0] if name == "counts" else expected
        expected[mirrored] = expected[mirrored][..., ::-1]
        if expected.ndim == 4:
            expected[mirrored, 0] *= -1
        assert np.abs(found - expected)[unknown].max() <= within, name


def test_windows_of_one_tap_come_from_presses_of_one(presses):
    """Sixteen of 64 presses have two taps: a quarter of a batch is of the other 48, and all the rest has both."""
    counts = presses.counts.copy()
    counts[16:, 1] = 0
    mixed = replace(presses, counts=counts)
    batches = PressBatches(mixed, (0.25, 0.75), 16, seed=3, nuisances=QUIET)
    for number in range(4):
        older = batches(number).window[:, 3:].abs().amax(dim=(1, 2, 3)).numpy()
        assert (older == 0).tolist() == [True] * 4 + [False] * 12
    marks = [row.tobytes() for row in presses.traction_kpa[:, 0, 0].astype(np.float32)]
    drawn = np.array([[marks.index(row.tobytes()) for row in batches(n).traction.numpy()[:, 0, 0]] for n in range(12)])
    assert sorted(drawn[:, :4].ravel()) == list(range(16, 64)), "each once in an epoch"
    assert drawn[:, 4:].max() < 16


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


@pytest.fixture(scope="module")
def wide():
    return load_frozen_presses()


def test_the_wide_set_is_the_one_that_figures_are_of(wide):
    """It is a file of version 2, which has no poses: they follow from its turns."""
    assert wide.presses.sha256() == WIDE_SHA256
    assert set(wide.presses.family) == set(SHARES) and len(np.unique(wide.presses.pad)) == 126
    assert min(np.unique(wide.presses.family, return_counts=True)[1]) >= 30
    x_mm, y_mm, turn_deg = np.moveaxis(wide.presses.poses, -1, 0)
    assert not x_mm.any() and not y_mm.any() and np.allclose(np.median(turn_deg, axis=0), (0, 5, 10, 15))
    moved = replace(wide.presses, poses=wide.presses.poses + np.float32([0.1, 0, 0]))
    assert moved.sha256() != WIDE_SHA256


def test_it_is_written_by_one_command(tmp_path, capsys):
    make_press_set(6).save(tmp_path / "presses.npz")
    main([str(tmp_path / "presses.npz"), str(tmp_path / "frozen.npz")])
    assert load_frozen_presses(tmp_path / "frozen.npz").presses.sha256() in capsys.readouterr().out
    with pytest.raises(SystemExit, match=r"^frozen_presses: .*no such file"):
        main([str(tmp_path / "absent.npz"), str(tmp_path / "frozen.npz")])
