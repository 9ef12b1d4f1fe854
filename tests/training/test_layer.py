"""The elastic layer against its closed forms, and its free sides against finite elements."""

import numpy as np
import pytest
import torch

from train.physics.contact import ContactSolver
from train.physics.elastic_layer import FreeSides, Layer, inner_displacement, surface_compliance
from train.physics.pad_draws import Pad
from train.physics.taxel_response import Skin

WAVES = np.array([0.0, 1e-6, 1e-3, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 1e3, 1e6])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.49, 0.499, 0.4999])
@pytest.mark.parametrize("thickness_mm", [0.1, 4.5, 50.0])
def test_closed_form_and_boundary_conditions_agree(poisson, thickness_mm):
    layer = Layer(thickness_mm, 0.12, poisson)
    compliance = surface_compliance(layer, WAVES)
    down, along = inner_displacement(layer, WAVES, thickness_mm)
    assert np.isfinite(compliance).all()
    assert (compliance > 0).all()
    assert np.isfinite(along).all()
    # Near nu = 0.5 the long waves' compliance is a small difference of large numbers: 5e-6 is what doubles leave.
    assert np.allclose(down, compliance, rtol=5e-6, atol=1e-12)


def test_closed_form_is_the_formula_of_its_docstring():
    layer, q = Layer(), np.array([0.2, 0.7, 1.5])
    nu, a = layer.poisson, q * layer.thickness_mm
    kappa = 3 - 4 * nu
    share = (kappa * np.sinh(2 * a) - 2 * a) / (kappa * np.cosh(2 * a) + 2 * a**2 + 5 - 12 * nu + 8 * nu**2)
    assert np.allclose(surface_compliance(layer, q), (1 - nu) / (layer.shear_modulus_mpa * q) * share)


@pytest.mark.parametrize("settings", [{"poisson": 0.5}, {"poisson": -0.1}, {"thickness_mm": 0.0}])
def test_impossible_layers_are_refused(settings):
    with pytest.raises(ValueError, match=r"poisson|positive"):
        Layer(**settings)


SIZE, CELL_MM = 42, 0.47
CELLS_MM = (np.arange(SIZE) - (SIZE - 1) / 2) * CELL_MM
FLAT = np.zeros((1, SIZE, SIZE), dtype=np.float32)
# By finite elements of the whole pad (docs/decisions.md): stiffness in N/mm, pressure over its mean at .235, 7.05 and
# 9.635 mm from the centre along x, and per mm of indentation the inner, edge and corner magnets' way down and outwards.
ELEMENTS = {
    0.45: (46.97, (1.33, 1.09, 0.60), (0.450, 0.438, 0.438), (0.189, 0.674, 0.535)),
    0.48: (53.0, (1.42, 1.10, 0.52), (0.412, 0.404, 0.408), (0.249, 0.853, 0.656)),
    0.49: (55.5, (1.46, 1.11, 0.49), (0.395, 0.390, 0.396), (0.275, 0.930, 0.706)),
    0.495: (56.8, (1.48, 1.11, 0.48), (0.385, 0.382, 0.389), (0.290, 0.973, 0.734)),
}


def solver(layer, sides):
    return ContactSolver(layer, SIZE, CELL_MM, torch.float64, sides=sides)


@pytest.mark.parametrize("poisson", ELEMENTS)
def test_a_flat_face_presses_as_the_finite_elements_have_it(poisson):
    layer, (stiffness, shape, down, out) = Layer(poisson=poisson), ELEMENTS[poisson]
    bare, corrected = (solver(layer, sides).solve(FLAT, 1.0, 1e-4) for sides in (None, FreeSides()))
    assert bare.force_n[0] > 1.6 * stiffness  # so much is at stake
    assert corrected.force_n[0] == pytest.approx(stiffness, rel=0.09)
    pressure = corrected.pressure_mpa[0].astype(np.float64)
    found = np.interp([0.235, 7.05, 9.635], CELLS_MM, pressure[SIZE // 2]) / pressure.mean()
    assert np.abs(found - shape).max() < 0.09
    skin = Skin(Pad(poisson=poisson, in_plane_share=1.0, free_sides=1.0), SIZE, CELL_MM)
    quarter = skin.movement(pressure).reshape(4, 4, 5)[2:, 2:].reshape(4, 5)[[0, 1, 3]]
    assert quarter[:, 2] == pytest.approx(down, rel=0.2)
    assert quarter[:, 0] == pytest.approx(out, rel=0.12)


def test_sides_are_felt_near_them_alone_and_are_all_alike():
    def force_n(row, column):
        depth_mm = np.full((SIZE, SIZE), 1e3, dtype=np.float32)
        depth_mm[row : row + 6, column : column + 6] = 0
        return [solver(Layer(), sides).solve(depth_mm[None], 1.0, 1e-5).force_n[0] for sides in (FreeSides(), None)]

    middle, without = force_n(18, 18)
    assert 0.97 * without < middle < without
    beside = [force_n(*at)[0] for at in ((18, 0), (18, 36), (0, 18), (36, 18))]
    assert beside == pytest.approx([beside[0]] * 4, rel=1e-4)
    assert beside[0] < 0.8 * without
    assert force_n(0, 36)[0] < beside[0]
