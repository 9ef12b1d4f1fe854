from dataclasses import replace

import numpy as np
import pytest

from firmware_bridge.pad_geometry import USPA44
from train.physics.elastic_layer import Layer
from train.physics.magnets import Magnet
from train.physics.pad_draws import NEWTONS_PER_COUNT_Z, Pad
from train.physics.taxel_response import Skin, pressure_response

SIZE, CELL_MM = 42, 0.47
SKIN = Skin(Pad(), SIZE, CELL_MM)
RIGHT, BACK, DOWN, LEAN_X, LEAN_Y = range(5)


def radius_mm(x_mm, y_mm, size=SIZE, cell_mm=CELL_MM):
    along = (np.arange(size) - (size - 1) / 2) * cell_mm
    return np.hypot(along[None, :] - x_mm, along[:, None] - y_mm)


def blob(x_mm, y_mm, pressure_mpa=0.05):
    """One tap of one frame: an even pressure on a circle of 2 mm."""
    return ((radius_mm(x_mm, y_mm) <= 2.0) * pressure_mpa).astype(np.float32)[None, None]


def test_an_even_load_reads_as_its_force():
    for force_n, within in ((1.0, 1e-3), (7.35, 0.05)):  # the field is steeper near the chip
        pressure = np.full((1, 1, SIZE, SIZE), force_n / (SIZE * CELL_MM) ** 2)
        assert SKIN.frames(pressure)[0, 0, 2].sum() * NEWTONS_PER_COUNT_Z == pytest.approx(force_n, rel=within)


@pytest.mark.parametrize("taxel", range(16))
def test_a_press_is_read_by_the_taxel_under_it(taxel):
    counts = SKIN.frames(blob(*USPA44.taxel_centres_mm()[taxel]))[0, 0]
    assert counts[2].ravel().argmax() == taxel


def test_shear_points_away_from_the_press():
    counts = SKIN.frames(blob(0.0, 0.0))[0, 0]
    assert (counts[0, 1:3, 2] > 0).all()
    assert (counts[0, 1:3, 1] < 0).all()
    assert (counts[1, 2, 1:3] > 0).all()
    assert (counts[1, 1, 1:3] < 0).all()


def test_readings_turn_with_the_load():
    first = blob(3.0, 1.0)
    x, y, z = SKIN.frames(first)[0, 0]
    turned_x, turned_y, turned_z = SKIN.frames(np.rot90(first, axes=(2, 3)).copy())[0, 0]
    assert np.allclose(turned_z, np.rot90(z), atol=0.05)
    assert np.allclose(turned_x, np.rot90(y), atol=0.05)
    assert np.allclose(turned_y, -np.rot90(x), atol=0.05)


class TestLean:
    """A magnet turns with its surroundings, by its shape; on a coarser grid, under a wide smooth load."""

    size, cell_mm = 21, 0.94
    load = np.exp(-((radius_mm(1.0, -0.5, 21, 0.94) / 4.0) ** 2)) * 0.02

    def movement(self, geometry=USPA44, **magnet):
        return pressure_response(geometry, Layer(), self.size, self.cell_mm, Magnet(**magnet)) @ self.load.ravel()

    def test_a_disc_follows_the_slope_of_its_plane(self):
        leans = self.movement(thickness_mm=1e-6)[:, [LEAN_X, LEAN_Y]]
        wide, narrow = (replace(USPA44, pitch_mm=pitch_mm) for pitch_mm in (4.71, 4.69))
        # The taxels of a wider grid sit further out: the slope along the line from the middle.
        steeper = (self.movement(wide, thickness_mm=1e-6) - self.movement(narrow, thickness_mm=1e-6))[:, DOWN] / 0.02
        outward = (leans * USPA44.taxel_centres_mm() / USPA44.pitch_mm).sum(axis=1)
        assert np.allclose(outward, steeper, atol=1e-3 * np.abs(steeper).max())

    def test_a_needle_follows_the_material_along_it(self):
        needle = {"diameter_mm": 1e-6, "thickness_mm": 0.5}
        above = self.movement(height_mm=2.52, **needle)
        below = self.movement(height_mm=2.48, **needle)
        expected = (above - below)[:, [RIGHT, BACK]] / 0.04
        leans = self.movement(**needle)[:, [LEAN_X, LEAN_Y]]
        assert np.allclose(leans, expected, atol=0.01 * np.abs(expected).max())

    def test_a_sphere_follows_half_the_curl(self):
        disc = self.movement(thickness_mm=1e-6)
        needle = self.movement(diameter_mm=1e-6)
        sphere = self.movement(thickness_mm=1.0, diameter_mm=1.0)
        assert np.allclose(sphere[:, LEAN_X:], (disc + needle)[:, LEAN_X:] / 2, atol=1e-7)
        assert np.abs(disc - needle)[:, LEAN_X].max() > 1e-4


def test_friction_takes_its_share_of_the_in_plane_movement_alone():
    free, held = (
        Skin(Pad(in_plane_share=share), SIZE, CELL_MM).movement(blob(1.0, 2.0)[0, 0]) for share in (1.0, 0.25)
    )
    assert np.allclose(held[:, [RIGHT, BACK]], 0.25 * free[:, [RIGHT, BACK]], rtol=1e-5)
    assert np.array_equal(held[:, [DOWN, LEAN_X, LEAN_Y]], free[:, [DOWN, LEAN_X, LEAN_Y]])


def test_a_press_down_to_the_chips_is_refused():
    with pytest.raises(ValueError, match="press less hard"):
        SKIN.frames(blob(2.35, 2.35, 5.0))
