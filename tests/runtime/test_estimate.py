"""Estimates for dead taxels: exact where they must be, and reported."""

from functools import cache

import numpy as np
import pytest
from edge_samples import FakeModel, make_contract
from numpy.typing import NDArray
from runtime_samples import PRESS, Pushed, make_runtime

from edge.api import EdgeError
from edge.inference.bundled import TAXELS
from edge.perception.taxel_health import BACK_SCANS, HOLD_SCANS, WIDENING, TaxelEstimator, load_estimator

GRID = (4, 4)


@cache
def estimator():
    return load_estimator(TAXELS, GRID)


def dead(*taxels):
    mask = np.zeros(GRID, dtype=bool)
    mask.flat[list(taxels)] = True
    return mask


def one_way(shape) -> NDArray[np.float64]:
    """Return a covariance in which any living taxel determines every dead one: rank 3, one pattern an axis."""
    return np.kron(np.diag([1.0, 1.0, 4.0]), np.outer(shape, shape)).astype(np.float64)


@pytest.mark.parametrize(("taxels", "kind"), [((1, 6, 11), 0), ((1, 6), 1)])
def test_the_dead_are_estimated_by_the_kind_of_contact(taxels, kind):
    """Without error, where the others tell all."""
    shapes = np.random.default_rng(0).uniform(500, 1500, (2, 16)) * [[1], [-1]]
    filler = TaxelEstimator(np.stack([one_way(shape) for shape in shapes]), GRID).filler(dead(*taxels))
    counts = np.outer([0.3, -0.2, 2.0], shapes[kind]).astype(np.float32).reshape(3, 4, 4)
    told = filler(np.where(dead(*taxels), 1e6, counts).astype(np.float32))
    np.testing.assert_allclose(told, counts, rtol=0.02)
    np.testing.assert_array_equal(told[:, ~dead(*taxels)], counts[:, ~dead(*taxels)])


@pytest.mark.parametrize("taxels", [(5,), (0,), (5, 6), (0, 3, 9, 14)])
def test_a_field_that_varies_little_is_estimated_from_neighbours(taxels):
    rows, cols = np.indices(GRID)
    z = 1000 + 40 * rows - 60 * cols
    counts = np.stack([0 * z, 0 * z, z]).astype(np.float32)
    counts[:, dead(*taxels)] = np.nan
    told, twice = (estimator().filler(dead(*taxels))(factor * counts) for factor in (1, 2))
    np.testing.assert_allclose(told[2], z, atol=150)
    np.testing.assert_allclose(twice, 2 * told, rtol=1e-5)


@pytest.mark.parametrize(
    "covariances",
    [np.eye(47)[None], np.eye(48), np.empty((0, 48, 48)), np.full((1, 48, 48), np.nan), -np.eye(48)[None]],
    ids=["of another grid", "without kinds", "none", "nan", "negative"],
)
def test_covariances_that_are_none_are_refused(covariances):
    with pytest.raises(EdgeError, match="freeze them again"):
        TaxelEstimator(covariances, GRID)


def test_no_file_and_no_living_taxel_are_refused(tmp_path):
    with pytest.raises(EdgeError, match=r"taxels\.npz cannot be read"):
        load_estimator(tmp_path / "taxels.npz", GRID)
    with pytest.raises(EdgeError, match="16 dead taxels"):
        estimator().filler(dead(*range(16)))


def test_deviations_are_wider_the_more_taxels_are_dead():
    pad = Pushed(make_runtime(FakeModel(make_contract(interval_factor=1.6)), estimator=estimator()))
    pad.push(PRESS)
    less = [pad.push(PRESS, absent=(0, 15)) for _ in range(HOLD_SCANS + 1)][-1]
    np.testing.assert_allclose(less.deviation, WIDENING[2] * 0.01 * (1 + np.abs(less.pattern)), rtol=1e-5)
    assert list(WIDENING) == sorted(WIDENING) and WIDENING[0] == 1 and len(WIDENING) == 9


def test_taps_are_forgotten_when_a_taxel_dies_or_is_back():
    """A window never holds readings of an undetected dead taxel, or filled in ones, without a note."""
    pad, dies = Pushed(make_runtime(estimator=estimator())), 10 + HOLD_SCANS
    for number, press in enumerate([PRESS, PRESS, 0] * 12):
        pad.push(press, absent=(0,) if 10 <= number <= dies else ())
    used, lives = [result.taps_used for result in pad.results], dies + BACK_SCANS
    assert max(used[dies - 3 : dies]) == 4 and max(used[dies : dies + 3]) == 1
    assert max(used[lives : lives + 3]) == 1 < max(used[lives - 3 : lives])
