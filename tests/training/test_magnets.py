import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_bridge.pad_geometry import USPA44
from train.physics.magnets import Magnet, MagnetArray

MAGNET = Magnet()
DOWN = 2


def moved(taxel, part, by):
    movement = np.zeros((16, 5))
    movement[taxel, part] = by
    return movement


def test_the_whole_array_is_magpylibs_sum_over_all_magnets():
    rng = np.random.default_rng(2)
    movement = rng.normal(size=(16, 5)) * [0.1, 0.1, 0.15, 0.3, 0.3]
    source = magpylib.Collection()
    for (x_mm, y_mm), (right, back, down, lean_x, lean_y) in zip(USPA44.taxel_centres_mm(), movement, strict=True):
        place = np.array([x_mm + right, y_mm + back, 2.5 - down]) * 1e-3
        upright, _ = Rotation.align_vectors([[lean_x, lean_y, 1.0]], [[0.0, 0.0, 1.0]])
        moment = MAGNET.remanence_t * np.pi / 4 * 1e-3**2 * 0.5e-3 / magpylib.mu_0
        source.add(magpylib.misc.Dipole(place, upright, moment=(0, 0, moment)))
    chips = np.column_stack([USPA44.taxel_centres_mm(), np.full(16, 0.5)]) * 1e-3
    expected_mt = 1e3 * source.getB(chips)
    assert np.allclose(MagnetArray(USPA44, MAGNET).flux_mt(movement), expected_mt, atol=1e-5)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="mm into its chip"):
        MagnetArray(USPA44, Magnet(chip_height_mm=2.3))
    array = MagnetArray(USPA44, MAGNET)
    assert np.isfinite(array.change_mt(moved(3, DOWN, 0.99))).all()
    for near in (1.01, 1.74):
        with pytest.raises(ValueError, match=r"comes within .* mm of its chip, .* expected 0\.75 mm or more"):
            array.change_mt(moved(3, DOWN, near))
    for through in (1.75, 9.0, np.nan):
        with pytest.raises(ValueError, match="mm into its chip"):
            array.change_mt(moved(3, DOWN, through))
