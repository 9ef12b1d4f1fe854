import numpy as np
import pytest
import torch

from train.physics.contact import ContactSolver
from train.physics.elastic_layer import Layer
from train.surfaces.depth_image import NOTHING_MM

CELL_MM = 0.47
SIZE = 42


def punch(radius_mm, cell_mm=CELL_MM, size=SIZE, centre_mm=(0.0, 0.0)):
    along = (np.arange(size) - (size - 1) / 2) * cell_mm
    radius = np.hypot(along[None, :] - centre_mm[0], along[:, None] - centre_mm[1])
    return np.where(radius <= radius_mm, 0.0, NOTHING_MM).astype(np.float32)[None]


def sphere(radius_mm, cell_mm, size):
    along = (np.arange(size) - (size - 1) / 2) * cell_mm
    square = along[None, :] ** 2 + along[:, None] ** 2
    cap = np.where(square < radius_mm**2, radius_mm - np.sqrt(np.maximum(radius_mm**2 - square, 0)), NOTHING_MM)
    return cap.astype(np.float32)[None]


def force_n(result, cell_mm=CELL_MM):
    return float(result.pressure_mpa.sum()) * cell_mm**2


@pytest.mark.parametrize("poisson", [0.3, 0.49, 0.4999])
def test_no_pull_no_overlap_and_one_of_them_zero(poisson):
    solver = ContactSolver(Layer(poisson=poisson), SIZE, CELL_MM, torch.float64)
    depth = np.concatenate([punch(6.0), sphere(30.0, CELL_MM, SIZE), punch(4.0, centre_mm=(9.0, 9.0))])
    result = solver.solve(depth, indentation_mm=0.3, tolerance=1e-6)
    gap = result.displacement_mm - (0.3 - depth)
    assert (result.pressure_mpa >= 0).all()
    assert gap.min() > -1e-5
    assert np.abs(gap[result.pressure_mpa > 0]).max() < 1e-5
    assert result.residual.max() < 1e-6


def test_flat_punch_on_a_thick_layer_is_boussinesqs():
    layer = Layer(thickness_mm=8.0, poisson=0.3)
    shape = punch(0.4, 0.1, 128)
    result = ContactSolver(layer, 128, 0.1, torch.float64).solve(shape, indentation_mm=0.1, tolerance=1e-6)
    radius_mm = np.sqrt((shape == 0).sum() * 0.1**2 / np.pi)
    expected = 4 * layer.shear_modulus_mpa * radius_mm * 0.1 / (1 - layer.poisson)
    # Measured 0.8 % above: cells, and a layer 20 radii thick instead of a half-space.
    assert force_n(result, 0.1) == pytest.approx(expected, rel=0.02)


def test_a_cell_carries_as_much_as_it_is_covered():
    solver = ContactSolver(Layer(), SIZE, CELL_MM, torch.float64)
    one, cover = np.full((3, SIZE, SIZE), NOTHING_MM, dtype=np.float32), np.zeros((3, SIZE, SIZE), dtype=np.float32)
    one[:, 20, 20] = 0
    cover[:, 20, 20] = 1, 0.5, 1 / 16
    whole, half, corner = solver.solve(one, covered=cover, tolerance=1e-9).pressure_mpa[:, 20, 20]
    assert whole == pytest.approx(1 / solver.cell_compliance_mm_per_mpa)
    assert (half / whole, corner / whole) == pytest.approx((0.5, 1 / 16))


def test_wrong_input_is_refused():
    solver = ContactSolver(Layer(), SIZE, CELL_MM)
    with pytest.raises(ValueError, match="positive depth"):
        solver.solve(punch(2.0), 0.0)
    with pytest.raises(ValueError, match="positive depth"):
        solver.solve(np.concatenate([punch(2.0)] * 2), np.array([0.1, np.nan]))
    out_of_reach = np.full((1, SIZE, SIZE), 0.4, dtype=np.float32)
    with pytest.raises(ValueError, match=r"depth image 1 begins 0.4 mm down, pressed in by 0.3 mm: no cell"):
        solver.solve(np.concatenate([punch(2.0), out_of_reach]), 0.3)
