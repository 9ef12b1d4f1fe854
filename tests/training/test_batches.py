from dataclasses import replace

import numpy as np
import pytest
import torch

from train.data.batches import COUNTS_PER_UNIT, Draw, WindowBatches, network_input
from train.data.dataset import windows
from train.data.generation_config import Generation, solve_all
from train.physics.sensor_noise import Nuisances

CLEAN = Draw(nuisances=Nuisances.none())


@pytest.fixture(scope="module")
def data():
    return solve_all(Generation(surfaces=("O", "T", "small square"), count=24, taps=3, seed=3)).at_scale(10)


def test_a_batch_follows_from_its_number_alone(data):
    one, other = (WindowBatches(data, Draw(), (0.2, 0.3, 0.5), 8, seed=7) for _ in range(2))
    for number in (4, 0, 5, 4):
        _ = other(number + 1)
        mine, same = one(number), other(number)
        assert torch.equal(mine.window, same.window) and torch.equal(mine.pattern, same.pattern)
    assert not torch.equal(one(0).window, one(3).window)
    assert not torch.equal(one(0).window, WindowBatches(data, Draw(), (0.2, 0.3, 0.5), 8, seed=8)(0).window)


def test_an_epoch_takes_every_sequence_once(data):
    """Truth identifies the sequence: unit patterns of the epoch's batches are those of the data, each once."""
    batches = WindowBatches(data, CLEAN, (1.0,), 8, seed=1)
    for first in (0, 3):
        drawn = torch.cat([batches(number).pattern for number in range(first, first + 3)]).numpy()
        turned = [np.sort((pattern / pattern.max()).ravel()) for pattern in drawn]
        known = [np.sort((pattern / pattern.max()).ravel()) for pattern in data.unit_patterns[:, 0].astype(np.float32)]
        nearest = [int(np.argmin([np.abs(one - other).max() for other in known])) for one in turned]
        assert sorted(nearest) == list(range(24))


def test_figures_are_drawn_as_often_as_asked(data):
    """Three quarters of the sequences are figures, a tenth of the windows are to be; every batch is whole."""
    named = replace(data, surfaces=np.array(["T"] * 6 + ["glyph:1", "polygon:2"] * 9))
    batches = WindowBatches(named, replace(CLEAN, figure_share=0.1), (1.0,), 8, seed=1)
    drawn = [batches.index(number) for number in range(100)]
    assert {len(index) for index in drawn} == {8}
    counts = np.bincount(np.concatenate(drawn), minlength=24)
    assert counts[6:].sum() == 80 and counts[6:].min() >= 4
    assert counts[:6].max() - counts[:6].min() <= 1
    again = WindowBatches(named, replace(CLEAN, figure_share=0.1), (1.0,), 8, seed=1)
    assert np.array_equal(again.index(57), drawn[57])


@pytest.mark.parametrize("surfaces", ["T", "glyph:1"])
def test_a_share_of_figures_needs_figures_and_others(data, surfaces):
    same = replace(data, surfaces=np.array([surfaces] * 24))
    with pytest.raises(ValueError, match=r"10% of the windows .* of 24 sequences (0|24) are"):
        WindowBatches(same, replace(CLEAN, figure_share=0.1), (1.0,), 8, seed=1)


@pytest.mark.parametrize("share", [0.0, 1.0, 1.5, -0.1, float("nan")])
def test_a_share_of_figures_is_between_none_and_all(data, share):
    with pytest.raises(ValueError, match="expected one between 0 and 1"):
        WindowBatches(data, replace(CLEAN, figure_share=share), (1.0,), 8, seed=1)


def test_older_taps_are_dropped_as_often_as_asked(data):
    batches = WindowBatches(data, CLEAN, (0.25, 0.0, 0.75), 24, seed=1)
    given = torch.cat([(batches(n).window.view(24, 3, 48).abs().amax(dim=2) > 0).sum(dim=1) for n in range(50)])
    counts = np.bincount(given.numpy(), minlength=4) / len(given)
    assert counts[0] == counts[2] == 0 and counts[1] == pytest.approx(0.25, abs=0.05)


def test_windows_go_in_newest_first_a_tap_side_by_side():
    window = np.arange(2 * 3 * 16, dtype=np.float32).reshape(1, 2, 3, 4, 4)
    given = network_input(window)
    assert given.shape == (1, 6, 4, 4)
    for tap in range(2):
        for axis in range(3):
            assert torch.equal(given[0, 3 * tap + axis], torch.from_numpy(window[0, tap, axis]) / COUNTS_PER_UNIT[axis])


def test_the_truth_belongs_to_the_window(data):
    """A press half as deep has half the pattern and, the field being steeper near the chip, a little less than half."""
    index = np.arange(6)
    full, deep = windows(data, index, 1.0, 3.0, Nuisances.none(), 0)
    half, shallow = windows(data, index, 0.5, 3.0, Nuisances.none(), 0)
    assert np.allclose(shallow, deep / 2, rtol=1e-3)
    share = half[:, 0].sum(axis=(1, 2, 3)) / full[:, 0].sum(axis=(1, 2, 3))
    assert np.all((share > 0.42) & (share < 0.5))
    assert np.array_equal(half[:, 1:], full[:, 1:])


def test_nuisances_are_those_asked_for(data):
    drawn = [WindowBatches(data, replace(CLEAN, nuisances=n), (1.0,), 8, 1) for n in (Nuisances.none(), Nuisances())]
    clean, real = (batches.draw(0)[0] for batches in drawn)
    assert 2 < np.sqrt(np.mean((clean - real) ** 2)) < 0.3 * np.sqrt(np.mean(clean**2))
