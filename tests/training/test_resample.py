import numpy as np
import pytest

from train.physics.resample import resample, resample_touching

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


@pytest.mark.parametrize("scale", SCALES)
def test_a_plane_stays_where_it_is(scale):
    # A map linear in x and y is its own mean at a pixel's centre; only pixels of unlike size would move it.
    def plane(side):
        centre = (np.arange(side) + 0.5) / side
        return (2 * centre[:, None] - 3 * centre[None, :])[None]

    small = resample(plane(80), 20, scale)[0]
    if (20 / scale).is_integer():
        assert np.allclose(small, plane(len(small))[0], atol=1e-5)
    # Elsewhere the fine map is a staircase, whose mean over a pixel is off by half a fine step at most.
    assert np.abs(small - plane(len(small))[0]).max() < 3 / 80


def test_whole_ratios_are_block_means_and_rows_and_columns_not_confused():
    fine = np.random.default_rng(1).random((2, 80, 40)).astype(np.float32)
    assert np.allclose(resample(fine, 20, 5), fine.reshape(2, 20, 4, 10, 4).mean(axis=(2, 4)), atol=1e-6)


def test_down_again_undoes_up():
    coarse = maps(2, 16)
    assert np.allclose(resample(resample(coarse, 4, 20), 20, 4), coarse, atol=1e-6)
    assert np.array_equal(resample(coarse, 4, 4), coarse)


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
