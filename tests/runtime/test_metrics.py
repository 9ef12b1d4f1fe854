"""Metrics of patterns, half widths of intervals by region, and classical methods of super-resolution: closed forms."""

import numpy as np
import pytest
from scipy.ndimage import zoom
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from edge.errors import EdgeError
from edge.evaluation.classical_methods import bicubic, bilinear, fitted_methods
from edge.evaluation.metrics import boundary_distance_mm, contact_iou, psnr_db, rmse_percent, ssim, ssim_global
from edge.inference.intervals import REGIONS, half_widths_mm, near_pixels, regions

METRICS = psnr_db, rmse_percent, ssim, ssim_global


def maps(seed, shape=(41, 41)):
    rng = np.random.default_rng(seed)
    truth = np.cumsum(rng.standard_normal(shape), axis=1) * 0.05
    return truth + 0.05 * rng.standard_normal(shape), truth


@pytest.mark.parametrize("full_scale", [0.1, 1.0, 25.0])
def test_they_are_those_of_scikit_image(full_scale):
    pattern, truth = maps(3)
    gaussian = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    expected = structural_similarity(pattern, truth, data_range=full_scale, **gaussian)
    assert ssim(pattern, truth, full_scale) == pytest.approx(expected, abs=1e-12)
    expected = structural_similarity(pattern, truth, data_range=full_scale, win_size=41)
    assert ssim_global(pattern, truth, full_scale) == pytest.approx(expected)
    expected = peak_signal_noise_ratio(truth, pattern, data_range=full_scale)
    assert psnr_db(pattern, truth, full_scale) == pytest.approx(expected)
    assert rmse_percent(pattern, truth, full_scale) == pytest.approx(100 * 10 ** (-expected / 20))


def test_equal_maps_are_perfect_also_where_constant():
    for value, full_scale in ((0.0, 25.0), (1e-12, 1e-3), (1e6, 1e-3)):
        flat = np.full((12, 12), value)
        found = [metric(flat, flat, full_scale) for metric in METRICS]
        assert found == [np.inf, 0, pytest.approx(1.0), pytest.approx(1.0)]


@pytest.mark.parametrize("metric", METRICS)
def test_a_batch_is_its_members_and_what_does_not_fit_is_refused(metric):
    pattern, truth = maps(4, (6, 20, 20))
    batch = metric(pattern, truth, 0.5)
    assert batch.shape == (6,) and batch[2] == pytest.approx(float(metric(pattern[2], truth[2], 0.5)))
    with pytest.raises(ValueError, match="expected equal"):
        metric(np.zeros((20, 20)), np.zeros((20, 21)), 1.0)
    with pytest.raises(ValueError, match="positive"):
        metric(np.zeros((20, 20)), np.zeros((20, 20)), 0.0)
    with pytest.raises(ValueError, match="11 x 11"):
        ssim(np.zeros((10, 20)), np.zeros((10, 20)), 1.0)


def test_iou_counts_overlap_over_union():
    pattern = np.array([[1.0, 1.0], [0.0, 0.0]])
    assert contact_iou(pattern, np.array([[True, False], [True, False]]), 0.5) == pytest.approx(1 / 3)
    assert contact_iou(np.zeros((2, 2)), np.zeros((2, 2), dtype=bool), 0.5) == 1
    assert contact_iou(np.zeros((2, 2)), np.ones((2, 2), dtype=bool), 0.5) == 0
    with pytest.raises(ValueError, match="expected equal"):
        contact_iou(pattern, np.zeros((2, 3), dtype=bool), 0.5)


def test_the_outline_of_nothing_is_as_far_as_can_be():
    nothing, all_of_it = np.zeros((1, 3, 4)), np.ones((1, 3, 4), dtype=bool)
    assert boundary_distance_mm(nothing, all_of_it, 0.5, 2.0) == pytest.approx(10.0)
    assert boundary_distance_mm(nothing, ~all_of_it, 0.5, 2.0) == 0
    with pytest.raises(ValueError, match="expected equal"):
        boundary_distance_mm(nothing, np.ones((1, 4, 4), dtype=bool), 0.5, 2.0)


def test_regions_around_a_contact_have_half_widths_of_their_own():
    pattern = np.zeros((1, 40, 40), dtype=np.float32)
    pattern[0, 10:20, 10:20] = 0.2
    region = regions(pattern, 0.3, 4)[0]
    names = [REGIONS[region[15, x]] for x in (15, 11, 10, 9, 8, 6, 5)]
    assert names == ["inside", "inside", "edge", "edge", "near", "near", "far"]
    counts = np.bincount(region.ravel(), minlength=4).tolist()
    assert counts == [64, 144 - 64, 18 * 18 - 144, 1600 - 18 * 18]
    for value, name in ((0.1, "inside"), (0, "far")):
        assert (regions(np.full((1, 8, 8), value, dtype=np.float32), 0.3, 2) == REGIONS.index(name)).all()
    assert [near_pixels(scale, 4.7) for scale in (10, 20, 4, 2)] == [4, 9, 2, 1], "two millimetres"
    levels = {"50": [0.5, 0.6, 0.7, 0.8], "90": [1.6, 1.6, 1.6, 1.6]}
    region = np.array([[[0, 1], [2, 3]]])
    deviations = np.full((1, 2, 2), 0.1, dtype=np.float32)
    np.testing.assert_allclose(half_widths_mm(levels, "50", deviations, region), [[[0.05, 0.06], [0.07, 0.08]]])
    np.testing.assert_allclose(half_widths_mm(levels, "90", deviations, region), 0.16, rtol=1e-6)


def test_bilinear_is_exact_and_outside_the_outer_taxels_held():
    taxels = np.random.default_rng(0).standard_normal((5, 4, 6))
    expected = zoom(taxels, (1, 7, 7), order=1, mode="nearest", grid_mode=True)
    assert np.allclose(bilinear(taxels, 7), expected) and np.allclose(bilinear(taxels[3], 7), expected[3])


def test_bicubic_is_exact_on_a_parabola():
    def parabola(x):
        return 1 - 2 * x + 3 * x**2

    rows, cols = parabola(np.arange(6.0)), parabola(np.arange(7.0) / 2)
    up = bicubic(np.outer(rows, cols), 10)
    fine_rows, fine_cols = ((np.arange(10 * n) + 0.5) / 10 - 0.5 for n in (6, 7))
    expected = np.outer(parabola(fine_rows), parabola(fine_cols / 2))
    assert np.allclose(up[15:45, 15:55], expected[15:45, 15:55])
    assert not np.allclose(up[5:55, 5:65], expected[5:55, 5:65])
    taxels = np.random.default_rng(4).standard_normal((3, 4, 4))
    assert np.allclose(bicubic(taxels, 5)[:, 2::5, 2::5], taxels), "it goes through the taxels"


def test_methods_come_from_a_file_and_another_is_refused(tmp_path):
    path, rng = tmp_path / "classical.npz", np.random.default_rng(2)
    matrix = rng.standard_normal((48, 1600)).astype(np.float32)
    newest = rng.standard_normal((3, 3, 4, 4))
    np.savez(path, bilinear_gain=np.float32(0.5), bicubic_gain=np.float32(0.25), linear_map=matrix)
    methods = fitted_methods(path, 10)
    assert np.allclose(methods["bilinear"](newest), 0.5 * bilinear(newest[:, 2], 10))
    assert np.allclose(methods["bicubic"](newest), 0.25 * bicubic(newest[:, 2], 10))
    assert np.allclose(methods["linear map"](newest)[1].ravel(), newest[1].ravel() @ matrix)
    with pytest.raises(EdgeError, match=r"train\.freeze"):
        fitted_methods(tmp_path / "none.npz", 10)
    np.savez(path, something=1)
    with pytest.raises(EdgeError, match="bilinear_gain"):
        fitted_methods(path, 10)
