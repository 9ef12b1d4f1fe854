import numpy as np
import pytest
import torch

from train.contact import ContactSolver
from train.depth import NOTHING_MM
from train.layer import Layer

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


def test_sphere_on_a_thick_layer_is_hertzs():
    layer = Layer(thickness_mm=8.0, poisson=0.3)
    solver = ContactSolver(layer, 128, 0.1, torch.float64)
    modulus_mpa = 2 * layer.shear_modulus_mpa / (1 - layer.poisson)
    for indentation_mm in (0.02, 0.04):
        expected = 4 / 3 * modulus_mpa * np.sqrt(2.0) * indentation_mm**1.5
        # Measured 2.3 % and 3.1 % above: a layer stiffens as the contact grows.
        assert force_n(solver.solve(sphere(2.0, 0.1, 128), indentation_mm, 1e-6), 0.1) == pytest.approx(
            expected, rel=0.05
        )


def test_flat_contact_is_linear_in_the_indentation():
    solver = ContactSolver(Layer(), SIZE, CELL_MM)
    unit = solver.solve(punch(5.0), 1.0)
    deep = solver.solve(punch(5.0), 0.3)
    assert np.allclose(deep.pressure_mpa, 0.3 * unit.pressure_mpa, atol=2e-3 * unit.pressure_mpa.max())


def test_a_pose_is_solved_alike_alone_and_in_company():
    solver = ContactSolver(Layer(), SIZE, CELL_MM, torch.float64)
    alone = solver.solve(punch(3.0), tolerance=1e-7)
    company = solver.solve(np.concatenate([sphere(100.0, CELL_MM, SIZE), punch(3.0), punch(9.0)]), tolerance=1e-7)
    assert np.allclose(alone.pressure_mpa[0], company.pressure_mpa[1], atol=1e-6)


def test_one_cell_full_face_and_nothing():
    solver = ContactSolver(Layer(), SIZE, CELL_MM)
    one = np.full((1, SIZE, SIZE), NOTHING_MM, dtype=np.float32)
    one[0, 20, 20] = 0
    assert (solver.solve(one).pressure_mpa > 0).sum() == 1
    full = solver.solve(np.zeros((1, SIZE, SIZE), dtype=np.float32))
    assert (full.pressure_mpa > 0).all()
    assert full.residual.max() < 1e-3
    nothing = solver.solve(np.full((1, SIZE, SIZE), NOTHING_MM, dtype=np.float32))
    assert not nothing.pressure_mpa.any()
    assert np.isfinite(nothing.residual).all()


def test_a_deeper_feature_stays_out_until_it_is_reached():
    depth = np.full((1, SIZE, SIZE), NOTHING_MM, dtype=np.float32)
    depth[0, 10:14, 10:14] = 0.0
    depth[0, 28:32, 28:32] = 0.4
    solver = ContactSolver(Layer(), SIZE, CELL_MM)
    assert not solver.solve(depth, 0.3).pressure_mpa[0, 28:32, 28:32].any()
    assert solver.solve(depth, 0.8).pressure_mpa[0, 28:32, 28:32].any()


def test_wrong_input_is_refused():
    solver = ContactSolver(Layer(), SIZE, CELL_MM)
    with pytest.raises(ValueError, match="expected \\(n, 42, 42\\)"):
        solver.solve(np.zeros((1, 40, 40), dtype=np.float32))
    with pytest.raises(ValueError, match="positive depth"):
        solver.solve(punch(2.0), 0.0)
