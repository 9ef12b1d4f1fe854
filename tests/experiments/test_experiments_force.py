import csv

import numpy as np
import pytest
from experiment_samples import quick_bench

from train.experiments.paper import force
from train.experiments.paper.protocol import classical_methods, mixed
from train.experiments.support.workbench import Method


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return quick_bench(tmp_path_factory)


@pytest.fixture(scope="module")
def sequences(bench):
    return bench.held_out("test").at_scale(10)


@pytest.fixture(scope="module")
def scans(sequences):
    return force.scans_between(sequences, (0.2, 0.4), 3, [1])


@pytest.mark.night
def test_the_report_has_every_range_and_method(bench, tmp_path):
    page = force.run_force(bench, tmp_path)
    with page.with_suffix(".csv").open() as file:
        rows = list(csv.DictReader(file))
    columns = {"PSNR dB", "SSIM", "SSIM at own scale", "relative error %", "parameters", "MMAC", "run time ms"}
    assert set(rows[0]) >= columns
    assert {row["model"] for row in rows} == {"stsr", "mtsr2", "mtsr4", "linear map", "bilinear"}
    assert len(rows) == 5 * len({row["force N"] for row in rows})
    assert rows[0]["force N"] == "0.1..0.2"
    assert all(int(row["taps"]) <= int(row["scans"]) for row in rows)


def test_forces_lie_within_their_range(sequences, scans):
    # Contacts are flat: force is proportional to the pattern, and the whole press' force and pattern are given.
    whole = sequences.patterns_at(scans.tap, np.ones(len(scans.tap))).sum(axis=(1, 2))
    force_n = sequences.force_n[scans.tap, 0, -1] * scans.patterns.sum(axis=(1, 2)) / whole
    assert (force_n > 0.2 * 0.999).all()
    assert (force_n < 0.4 * 1.001).all()
    assert np.ptp(force_n) > 0.1
    assert np.bincount(scans.tap, minlength=len(sequences)).tolist() == [3] * len(sequences)


def test_the_newest_tap_is_light_and_the_earlier_ones_have_come_to_their_ends(scans):
    z = scans.windows[:, :, 2].sum(axis=(-2, -1))
    assert (z[:, 1:].min(axis=1) > 4000).all()  # 5 N at 1400 counts a newton
    assert (z[:, 0] < 3000).all()


def test_a_press_that_ends_before_is_left_out(sequences):
    highest_n = sequences.force_n[:, 0, -1]
    middle_n = float(np.median(highest_n))
    found = force.scans_between(sequences, (middle_n, middle_n * 1.001), 2, [1])
    able = np.flatnonzero(highest_n >= middle_n * 1.001)
    assert set(able) <= set(found.tap)
    assert 0 < len(np.unique(found.tap)) < len(sequences)
    assert force.scans_between(sequences, (50.0, 60.0), 2, [1]) is None


def test_a_relative_error_is_that_of_the_scale_and_the_truth_has_none(scans):
    for factor, percent in ((1.1, 10), (0.5, 50), (3.0, 200), (0.0, 100)):
        found = force.errors(_giving(factor * scans.patterns), scans)["relative_percent"]
        np.testing.assert_allclose(found, percent, rtol=1e-4)
    found = force.errors(_giving(scans.patterns), scans)
    assert np.isinf(found["psnr_db"]).all() and (found["relative_percent"] == 0).all()
    np.testing.assert_allclose(found["ssim_own"], 1)


def test_shape_figures_do_not_know_the_force_and_the_others_do(scans):
    blurred = (scans.patterns + np.roll(scans.patterns, 2, axis=1)) / 2
    light = force.errors(_giving(blurred), scans)
    heavy_scans = force.Bin(scans.force_n, scans.windows, 5 * scans.patterns, scans.touching, scans.tap)
    heavy = force.errors(_giving(5 * blurred), heavy_scans)
    for key in ("ssim_own", "relative_percent", "contact_iou"):
        np.testing.assert_allclose(heavy[key], light[key], rtol=1e-4)
    np.testing.assert_allclose(light["psnr_db"] - heavy["psnr_db"], 20 * np.log10(5), rtol=1e-4)
    assert (heavy["ssim"] < light["ssim"]).all()


def test_classical_methods_are_fitted_once_and_cost_what_they_multiply(bench):
    data = mixed(bench)
    linear, cubic = classical_methods(bench, data, ("linear map", "bicubic"))
    path = next(bench.data_folder.glob("classical-*.npz"))
    written_ns = path.stat().st_mtime_ns
    again = classical_methods(bench, data, ("linear map",))[0]
    assert path.stat().st_mtime_ns == written_ns
    windows = np.random.default_rng(0).normal(0, 500, (2, 4, 3, 4, 4)).astype(np.float32)
    np.testing.assert_array_equal(linear.patterns(windows), again.patterns(windows))
    # A linear map is linear, and blind to the earlier taps.
    np.testing.assert_allclose(linear.patterns(2 * windows), 2 * linear.patterns(windows), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(linear.patterns(windows), linear.patterns(windows[:, :1]))
    assert linear.cost["parameters"] == 48 * 1600 and cubic.cost["parameters"] == 1
    assert linear.cost["MMAC"] == pytest.approx(48 * 1600 / 1e6, abs=1e-3)


def _giving(patterns):
    return Method("given", 1, 0.5, lambda _: (patterns, None))
