import numpy as np
import pytest

from train.physics.tpsf import resample, resample_touching

SCALES = [4, 4.5, 7, 12.5, 19]


def maps(count=3, side=80):
    return np.random.default_rng(0).random((count, side, side)).astype(np.float32)


@pytest.mark.parametrize("scale", SCALES)
def test_mean_and_constants_are_kept(scale):
    small = resample(maps(), 20, scale)
    assert small.shape == (3, round(4 * scale), round(4 * scale))
    assert small.dtype == np.float32
    assert np.allclose(small.mean(axis=(1, 2)), maps().mean(axis=(1, 2)), atol=1e-6)
    assert np.allclose(resample(np.full((1, 80, 80), 0.3), 20, scale), 0.3)


def test_whole_ratios_are_block_means_and_rows_and_columns_not_confused():
    fine = np.random.default_rng(1).random((2, 80, 40)).astype(np.float32)
    assert np.allclose(resample(fine, 20, 5), fine.reshape(2, 20, 4, 10, 4).mean(axis=(2, 4)), atol=1e-6)


def test_half_a_pixel_touches_and_less_does_not():
    fine = np.zeros((1, 12, 12), dtype=bool)
    fine[0, :2, :3] = True  # 6 of 9 pixels, into 3 x 3
    fine[0, 3:5, 3:5] = True  # 4 of 9
    assert np.argwhere(resample_touching(fine, 3, 1)[0]).tolist() == [[0, 0]]
    half = np.zeros((1, 12, 12), dtype=bool)
    half[0, :, :1] = True
    assert resample_touching(half, 12, 6)[0, :, 0].all()
    # 10 -> 3 pixels: the second takes 2/3 + 1 + 1 + 2/3 old ones; half of that is 1/2 but for rounding.
    thirds = np.zeros((1, 10, 10), dtype=bool)
    thirds[0, :, 3:5] = True
    assert resample_touching(thirds, 10, 3)[0].tolist() == [[False, True, False]] * 3
