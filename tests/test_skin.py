import numpy as np
import pytest

from firmware_bridge.geometry import USPA44
from train.layer import Layer
from train.skin import NEWTONS_PER_COUNT_Z, Nuisances, Skin, draw_gains, draw_rest, read_counts

SIZE, CELL_MM = 42, 0.47
SKIN = Skin(USPA44, Layer(), SIZE, CELL_MM)


def blob(x_mm, y_mm, radius_mm=2.0):
    along = (np.arange(SIZE) - (SIZE - 1) / 2) * CELL_MM
    inside = np.hypot(along[None, :] - x_mm, along[:, None] - y_mm) <= radius_mm
    return inside.astype(np.float32)[None] * 0.05


def test_an_even_load_reads_as_its_force():
    pressure = np.full((1, SIZE, SIZE), 0.01, dtype=np.float32)
    newtons = float(pressure.sum()) * CELL_MM**2
    assert SKIN.deform(pressure)[0, 2].sum() * NEWTONS_PER_COUNT_Z == pytest.approx(newtons, rel=1e-3)


@pytest.mark.parametrize("taxel", range(16))
def test_a_press_is_read_by_the_taxel_under_it(taxel):
    counts = SKIN.deform(blob(*USPA44.taxel_centres_mm()[taxel]))[0]
    assert counts[2].ravel().argmax() == taxel


def test_shear_points_away_from_the_press():
    counts = SKIN.deform(blob(0.0, 0.0))[0]
    assert (counts[0, 1:3, 2] > 0).all()
    assert (counts[0, 1:3, 1] < 0).all()
    assert (counts[1, 2, 1:3] > 0).all()
    assert (counts[1, 1, 1:3] < 0).all()


def test_readings_add_up_and_turn_with_the_load():
    first, second = blob(3.0, 1.0), blob(-4.0, 5.0)
    assert np.allclose(SKIN.deform(first + second), SKIN.deform(first) + SKIN.deform(second), atol=1e-2)
    x, y, z = SKIN.deform(first)[0]
    turned_x, turned_y, turned_z = SKIN.deform(np.rot90(first, axes=(1, 2)).copy())[0]
    assert np.allclose(turned_z, np.rot90(z), atol=1e-2)
    assert np.allclose(turned_x, np.rot90(y), atol=1e-2)
    assert np.allclose(turned_y, -np.rot90(x), atol=1e-2)


def test_nuisances_are_as_large_as_they_say_and_can_be_off():
    rng = np.random.default_rng(0)
    gains = draw_gains(rng, Nuisances(gain_spread=0.05, repeat_spread=0.0), USPA44, 400, 3)
    assert gains.std() == pytest.approx(0.05, rel=0.1)  # the cut takes 4 % of it
    assert np.abs(gains - 1).max() <= 0.1 + 1e-6
    assert (gains[:, 0] == gains[:, 2]).all()
    repeats = draw_gains(rng, Nuisances(gain_spread=0.0, repeat_spread=0.03), USPA44, 400, 3)
    assert repeats.std() == pytest.approx(0.03, rel=0.1)
    assert (repeats[:, 0] != repeats[:, 2]).any()
    off = Nuisances(0.0, 0.0, 0.0)
    assert (draw_gains(rng, off, USPA44, 5, 2) == 1).all()
    exact = np.array([[10.4, -3.6]])
    assert read_counts(rng, exact, off).tolist() == [[10.0, -4.0]]
    noisy = read_counts(rng, np.zeros((1000, 48)), Nuisances())
    assert noisy.std() == pytest.approx(np.sqrt(2.0**2 + 1 / 12), rel=0.05)


def test_rest_levels_fit_sixteen_bits_and_differ_per_axis():
    rest = draw_rest(np.random.default_rng(1), USPA44)
    assert rest.min() > 20000
    assert rest.max() < 50000
    assert rest[2].mean() > rest[0].mean() + 2000
