import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from edge.evaluation.metrics import boundary_distance_mm, contact_iou, psnr_db, rmse_percent, ssim, ssim_global
from edge.perception.contact_patch import touched


def maps(seed, shape=(40, 40)):
    rng = np.random.default_rng(seed)
    truth = np.cumsum(rng.standard_normal(shape), axis=1) * 0.05
    return truth + 0.05 * rng.standard_normal(shape), truth


def test_psnr_has_the_square_and_the_mean():
    truth = np.zeros((4, 5))
    pattern = np.full((4, 5), 0.1)
    assert psnr_db(pattern, truth, 1.0) == pytest.approx(20.0)
    assert psnr_db(pattern, truth, 0.5) == pytest.approx(20.0 - 20 * np.log10(2))


def test_rmse_is_a_share_of_full_scale():
    assert rmse_percent(np.full((3, 3), 0.1), np.zeros((3, 3)), 0.5) == pytest.approx(20.0)


def test_psnr_and_rmse_say_the_same():
    pattern, truth = maps(1)
    rmse = rmse_percent(pattern, truth, 0.5) / 100
    assert psnr_db(pattern, truth, 0.5) == pytest.approx(-20 * np.log10(rmse))


@pytest.mark.parametrize("full_scale", [0.1, 1.0, 25.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_ssim_is_scikit_images(seed, full_scale):
    pattern, truth = maps(seed)
    expected = structural_similarity(
        pattern, truth, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=full_scale
    )
    assert ssim(pattern, truth, full_scale) == pytest.approx(expected, abs=1e-12)


def test_ssim_global_is_the_formula_of_one_window():
    pattern, truth = maps(3)
    c1, c2 = (0.01 * 0.5) ** 2, (0.03 * 0.5) ** 2
    covariance = np.cov(pattern.ravel(), truth.ravel())
    expected = ((2 * pattern.mean() * truth.mean() + c1) * (2 * covariance[0, 1] + c2)) / (
        (pattern.mean() ** 2 + truth.mean() ** 2 + c1) * (covariance[0, 0] + covariance[1, 1] + c2)
    )
    assert ssim_global(pattern, truth, 0.5) == pytest.approx(expected)


@given(
    value=st.sampled_from([0.0, 1.0, 1e-12, 1e6, -3.0]),
    full_scale=st.sampled_from([1e-3, 0.5, 25.0]),
)
def test_equal_maps_are_perfect_also_where_constant(value, full_scale):
    flat = np.full((12, 12), value)
    assert psnr_db(flat, flat, full_scale) == np.inf
    assert rmse_percent(flat, flat, full_scale) == 0
    assert ssim(flat, flat, full_scale) == pytest.approx(1.0)
    assert ssim_global(flat, flat, full_scale) == pytest.approx(1.0)


@pytest.mark.parametrize("metric", [psnr_db, rmse_percent, ssim, ssim_global])
def test_a_batch_is_its_members(metric):
    pattern, truth = maps(4, (6, 20, 20))
    batch = metric(pattern, truth, 0.5)
    assert batch.shape == (6,)
    assert batch[2] == pytest.approx(float(metric(pattern[2], truth[2], 0.5)))


@pytest.mark.parametrize("metric", [psnr_db, rmse_percent, ssim, ssim_global])
def test_what_does_not_fit_is_refused(metric):
    with pytest.raises(ValueError, match="expected equal"):
        metric(np.zeros((20, 20)), np.zeros((20, 21)), 1.0)
    with pytest.raises(ValueError, match="positive"):
        metric(np.zeros((20, 20)), np.zeros((20, 20)), 0.0)


def test_ssim_refuses_a_map_below_its_window():
    with pytest.raises(ValueError, match="11 x 11"):
        ssim(np.zeros((10, 20)), np.zeros((10, 20)), 1.0)


def test_touched_is_a_share_of_the_maximum_and_nothing_on_a_zero_map():
    pattern = np.array([[0.0, 0.5], [0.79, 1.0]])
    assert touched(pattern, 0.8).tolist() == [[False, False], [False, True]]
    assert touched(pattern, 0.5).tolist() == [[False, True], [True, True]]
    assert not touched(np.zeros((2, 2)), 0.5).any()
    assert not touched(np.full((2, 2), -1.0), 0.5).any()


def test_iou_counts_overlap_over_union():
    pattern = np.array([[1.0, 1.0], [0.0, 0.0]])
    assert contact_iou(pattern, np.array([[True, False], [True, False]]), 0.5) == pytest.approx(1 / 3)
    assert contact_iou(np.zeros((2, 2)), np.zeros((2, 2), dtype=bool), 0.5) == 1
    assert contact_iou(np.zeros((2, 2)), np.ones((2, 2), dtype=bool), 0.5) == 0
    with pytest.raises(ValueError, match="expected equal"):
        contact_iou(pattern, np.zeros((2, 3), dtype=bool), 0.5)


def test_outlines_lie_as_far_apart_as_they_were_moved():
    square = np.zeros((1, 12, 12))
    square[0, 3:8, 2:7] = 1.0
    moved = np.roll(square, 2, axis=2) > 0
    # Of 16 outline pixels 5 lie 2 px from the nearest of the other on either open end, the others less.
    assert boundary_distance_mm(square, square > 0, 0.5, 0.5) == 0
    between = boundary_distance_mm(square, moved, 0.5, 0.5)[0]
    assert between == boundary_distance_mm(moved.astype(float), square > 0, 0.5, 0.5)[0]
    assert 0.3 < between < 1.0
    line = np.zeros((1, 12, 12))
    line[0, :, 4] = 1.0
    assert boundary_distance_mm(line, np.roll(line, 3, axis=2) > 0, 0.5, 0.5) == pytest.approx(1.5)


def test_no_contact_against_one_is_as_far_as_can_be():
    nothing, all_of_it = np.zeros((1, 3, 4)), np.ones((1, 3, 4), dtype=bool)
    assert boundary_distance_mm(nothing, all_of_it, 0.5, 2.0) == pytest.approx(10.0)
    assert boundary_distance_mm(nothing, ~all_of_it, 0.5, 2.0) == 0
    with pytest.raises(ValueError, match="expected equal"):
        boundary_distance_mm(nothing, np.ones((1, 4, 4), dtype=bool), 0.5, 2.0)
