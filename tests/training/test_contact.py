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


def test_cells_that_are_whole_are_solved_as_without_cover():
    solver = ContactSolver(Layer(), SIZE, CELL_MM)
    depth = scenes()
    covered = solver.solve(depth, 0.3, covered=np.ones_like(depth))
    assert np.array_equal(covered.pressure_mpa, solver.solve(depth, 0.3).pressure_mpa)


def test_a_deeper_feature_stays_out_until_it_is_reached():
    depth = np.full((1, SIZE, SIZE), NOTHING_MM, dtype=np.float32)
    depth[0, 10:14, 10:14] = 0.0
    depth[0, 28:32, 28:32] = 0.4
    solver = ContactSolver(Layer(), SIZE, CELL_MM)
    assert not solver.solve(depth, 0.3).pressure_mpa[0, 28:32, 28:32].any()
    assert solver.solve(depth, 0.8).pressure_mpa[0, 28:32, 28:32].any()


def test_wrong_input_is_refused():
    solver = ContactSolver(Layer(), SIZE, CELL_MM)
    with pytest.raises(ValueError, match="positive depth"):
        solver.solve(punch(2.0), 0.0)
    with pytest.raises(ValueError, match="positive depth"):
        solver.solve(np.concatenate([punch(2.0)] * 2), np.array([0.1, np.nan]))
    out_of_reach = np.full((1, SIZE, SIZE), 0.4, dtype=np.float32)
    with pytest.raises(ValueError, match=r"depth image 1 begins 0.4 mm down, pressed in by 0.3 mm: no cell"):
        solver.solve(np.concatenate([punch(2.0), out_of_reach]), 0.3)


def scenes():
    """Contacts in the middle, at the edges and all over, flat and curved, of many sizes."""
    rng = np.random.default_rng(0)
    flat = [punch(rng.uniform(0.5, 8), centre_mm=rng.uniform(-9, 9, 2)) for _ in range(20)]
    round_ = [
        np.roll(sphere(radius, CELL_MM, SIZE), rng.integers(-12, 12, 2), (1, 2)) for radius in (3, 8, 20, 60, 300)
    ]
    return np.concatenate([*flat, *round_, np.zeros((1, SIZE, SIZE), dtype=np.float32)])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_box_gives_what_the_whole_pad_gives(dtype):
    depth = scenes()
    # Cells that are just within reach and touch nothing make the box the whole pad.
    corners = depth.copy()
    corners[:, [0, -1], [0, -1]] = np.minimum(corners[:, [0, -1], [0, -1]], 0.44)
    boxed, whole = (ContactSolver(Layer(), SIZE, CELL_MM, dtype).solve(one, 0.3) for one in (depth, corners))
    peak = whole.pressure_mpa.max(axis=(1, 2), keepdims=True)
    assert (np.abs(boxed.pressure_mpa - whole.pressure_mpa) / peak).max() < 1e-3
    assert np.abs(boxed.force_n / whole.force_n - 1).max() < 1e-4
    assert boxed.residual.max() < 1e-3


def test_the_pad_bulges_against_what_it_has_not_been_pressed_into():
    floor_mm, press_mm = 0.24, 0.2
    depth = punch(7.0) + np.where(punch(4.5) == 0, floor_mm, 0).astype(np.float32)
    result = ContactSolver(Layer(), SIZE, CELL_MM, torch.float64).solve(depth, press_mm, tolerance=1e-6)
    assert result.pressure_mpa[0][depth[0] == np.float32(floor_mm)].any()
    assert (result.displacement_mm - (press_mm - depth)).min() > -1e-5
