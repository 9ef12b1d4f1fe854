import magpylib
import numpy as np
import pytest
from magpylib.func import cylinder_field, dipole_field
from scipy.spatial.transform import Rotation

from firmware_bridge.pad_geometry import USPA44
from train.physics.magnets import Magnet, MagnetArray, dipole_mt

MAGNET = Magnet()
DOWN = 2


def rolls(rng, count):
    return Rotation.from_rotvec(rng.normal(size=(count, 3)))


def around(rng, count):
    """Points 0.3 to 9 mm away, in every direction."""
    way = rng.normal(size=(count, 3))
    return way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(0.3, 9.0, (count, 1))


def moved(taxel, part, by):
    movement = np.zeros((16, 5))
    movement[taxel, part] = by
    return movement


def test_the_dipole_is_magpylibs():
    rng = np.random.default_rng(0)
    away_mm, turn = around(rng, 200), rolls(rng, 200)
    axis = turn.apply([0.0, 0.0, 1.0])
    volume_m3 = np.pi / 4 * 1e-3**2 * 0.5e-3
    moment = axis * MAGNET.remanence_t * volume_m3 / magpylib.mu_0
    expected_mt = 1e3 * dipole_field("B", away_mm * 1e-3, moment)
    assert np.allclose(np.stack(dipole_mt(MAGNET, tuple(away_mm.T), tuple(axis.T)), axis=1), expected_mt, rtol=1e-6)


def test_the_dipoles_error_falls_with_the_square_of_the_distance():
    z, zero, one = np.array([4.0, 8.0]), np.zeros(2), np.ones(2)
    places = np.column_stack([zero, zero, z]) * 1e-3
    exact = 1e3 * cylinder_field("B", places, (1e-3, 0.5e-3), (0, 0, 1.2))[:, 2]
    error = dipole_mt(MAGNET, (zero, zero, z), (zero, zero, one))[2] / exact - 1
    assert error[0] / error[1] == pytest.approx(4.0, rel=0.05)
    assert 0 < error[0] < 0.03


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_movement_changes_exactly_nothing(dtype):
    change = MagnetArray(USPA44, MAGNET).change_mt(np.zeros((3, 5, 16, 5), dtype=dtype))
    assert change.shape == (3, 5, 16, 3)
    assert change.dtype == dtype
    assert not change.any()


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
