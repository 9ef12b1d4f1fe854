import math

import numpy as np
import pytest

from train.learning.interval_fit import calibrate, interval_coverage

LEVELS = [0.1, 0.5, 0.8, 0.9, 0.99]


def laplace(seed=0, shape=(60, 40, 40)):
    """Return patterns with errors of a given standard deviation: half of the pixels are four times as far off."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0, 0.5, shape)
    deviation = np.where(rng.random(shape) < 0.5, 0.01, 0.04)
    return truth, truth + rng.laplace(0, deviation / math.sqrt(2)), deviation


def test_intervals_of_a_laplace_density_cover_what_they_say():
    assert [interval_coverage(*laplace(), level) for level in LEVELS] == pytest.approx(LEVELS, abs=0.005)


@pytest.mark.parametrize("wrong", [0.2, 1.0, 7.0])
@pytest.mark.parametrize("level", [0.5, 0.9])
def test_the_factor_brings_wrong_deviations_back(wrong, level):
    truth, pattern, deviation = laplace()
    factor = calibrate(truth, pattern, wrong * deviation, level)
    assert factor == pytest.approx(1 / wrong, rel=0.02)
    assert interval_coverage(truth, pattern, factor * wrong * deviation, level) == pytest.approx(level, abs=1e-4)


def test_the_level_is_met_whatever_the_density_and_holds_on_other_pixels():
    rng = np.random.default_rng(1)

    def uniform():
        truth = np.zeros((50, 20, 20))
        return truth, rng.uniform(-0.03, 0.03, truth.shape), np.full(truth.shape, 0.01)

    factor = calibrate(*uniform())
    truth, pattern, deviation = uniform()
    assert interval_coverage(truth, pattern, factor * deviation) == pytest.approx(0.9, abs=0.01)
    assert interval_coverage(truth, pattern, factor * deviation, 0.5) < 0.4


def test_deviations_that_cannot_be_scaled_are_refused():
    truth, pattern, deviation = (part[:1] for part in laplace())
    with pytest.raises(ValueError, match="not above zero"):
        calibrate(truth, pattern, 0 * deviation)
