import csv
from dataclasses import replace

import numpy as np
import pytest
from experiment_samples import quick_bench

from train.experiments.paper import bound
from train.experiments.paper.bound import Nudged, least_mse, nudged
from train.physics.sensor_noise import Nuisances

QUIET = replace(Nuisances.none(), noise_counts=1.0)


@pytest.fixture(scope="module")
def taps():
    return nudged(("S",), 4, 5.0)


def test_one_unknown_force_is_known_to_the_noise_over_the_readings():
    """The variance is noise^2 / sum of squares, and the pattern's error is that of its amplitude."""
    counts = np.repeat(np.full((1, 1, 48), 100.0)[:, :, None], 7, axis=2)
    patterns = np.full((1, 7, 9), 0.2)
    noise_var = 1 + 1 / 12 + (0.0025 * 100) ** 2
    expected = 0.2**2 / (48 * 100**2 / noise_var + 1 / 0.5**2)
    assert least_mse(Nudged(counts, patterns), 1, QUIET) == pytest.approx(expected, rel=1e-6)


def test_slopes_are_those_of_the_readings(taps):
    step = taps.counts[0, 0, 1] - taps.counts[0, 0, 0]
    assert np.abs(taps.slopes(taps.counts)[0, 0, 0] * 0.15 - step).max() < 0.15 * np.abs(step).max()


def test_more_taps_tell_more_and_nuisances_tell_less(taps):
    errors = [least_mse(taps, given, Nuisances()) for given in (1, 2, 4)]
    assert (errors[0] > errors[1]).all() and (errors[1] > errors[2]).all()
    assert (least_mse(taps, 1, Nuisances().without("gain_spread")) < 0.5 * errors[0]).all()


def test_taps_that_were_not_turned_do_not_tell_gain_from_place():
    """Taps without pose errors repeat the same readings: only the noise is averaged."""
    same, turned = nudged(("S",), 2, 0.0), nudged(("S",), 2, 5.0)
    exact = replace(Nuisances(), pose_error_mm=0, pose_error_deg=0)
    gained = least_mse(same, 1, exact) / least_mse(same, 2, exact)
    assert (gained < 1.5).all()
    assert (least_mse(turned, 1, exact) / least_mse(turned, 2, exact) > 1.5 * gained).all()


def test_the_report_has_bound_and_networks(tmp_path_factory):
    page = bound.run(quick_bench(tmp_path_factory), tmp_path_factory.mktemp("reports"))
    with page.with_suffix(".csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["taps"] for row in rows if row["what"] == "compact networks"] == ["1", "2"]
    assert len(rows) == 3 * 2 and page.with_suffix(".png").stat().st_size > 10_000
