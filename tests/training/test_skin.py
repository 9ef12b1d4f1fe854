import numpy as np
import pytest

from firmware_bridge.pad_geometry import USPA44
from train.physics.pad_draws import NEWTONS_PER_COUNT_Z, Pad
from train.physics.taxel_response import Skin

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


def test_a_press_down_to_the_chips_is_refused():
    with pytest.raises(ValueError, match="press less hard"):
        SKIN.frames(blob(2.35, 2.35, 5.0))
