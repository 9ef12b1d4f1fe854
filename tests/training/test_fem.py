import numpy as np
import pytest

pytest.importorskip("felupe", reason="the FEM reference is an extra: pip install '.[fem]'")

from train.physics.contact import ContactSolver
from train.physics.elastic_layer import Layer
from train.physics.fem_reference import FemPad, NoEquilibriumError


def bowl(along_mm, radius_mm):
    return (along_mm[:, None] ** 2 + along_mm[None, :] ** 2) / (2 * radius_mm)


def test_a_plate_on_a_thin_slab_presses_by_closed_form():
    # Far from the rim a bonded slab only gets thinner: F = diag(1, 1, s), whose stress is d psi / ds.
    layer = Layer(thickness_mm=1.0, poisson=0.3)
    pad = FemPad(2, 2, layer)
    steps_mm = np.array([0.001, 0.1, 0.25])
    pushes_n, _ = pad.press(np.zeros((pad.size, pad.size)), steps_mm)
    middle = pad.size // 2

    def stored(stretch):
        shape = layer.shear_modulus_mpa / 2 * (2 + stretch**2) * stretch ** (-2 / 3)
        return shape + pad.bulk_mpa / 2 * (stretch - 1) ** 2

    for step_mm, push_n in zip(steps_mm, pushes_n, strict=True):
        stretch = 1 - step_mm
        expected_mpa = -(stored(stretch + 1e-5) - stored(stretch - 1e-5)) / 2e-5
        assert push_n[middle, middle] / pad.cell_mm**2 == pytest.approx(expected_mpa, rel=1e-3)


@pytest.mark.parametrize(("thickness_mm", "poisson"), [(4.5, 0.3), (2.0, 0.49)])
def test_at_small_strain_it_is_the_layer(thickness_mm, poisson):
    # The layer has no sides: 2 mm at 0.49 and 4.5 mm at 0.3 are the pads that do not feel theirs.
    layer, indentation_mm = Layer(thickness_mm, poisson=poisson), 0.06
    pad = FemPad(5, 3, layer)
    push_n, down_mm = pad.press(bowl(pad.nodes_mm, 150.0), np.array([indentation_mm]))
    size, cell_mm = 84, 20 / 84
    cells_mm = (np.arange(size) - (size - 1) / 2) * cell_mm
    solver = ContactSolver(layer, size, cell_mm)
    pressure_mpa, _ = solver.solve(bowl(cells_mm, 150.0)[None].astype(np.float32), indentation_mm, 1e-4)
    # Measured: force 0.4 % and 1.2 % off, surface 1.2 % and 2.9 % of the indentation.
    assert push_n.sum() == pytest.approx(pressure_mpa.sum() * cell_mm**2, rel=0.02)
    middle = pad.size // 2
    near = pad.nodes_mm[np.abs(pad.nodes_mm) < 7]
    surface = np.interp(near, cells_mm, solver.displacement_mm(pressure_mpa)[0, size // 2])
    found = down_mm[0, middle][np.abs(pad.nodes_mm) < 7]
    assert np.abs(found - surface).max() < 0.04 * indentation_mm


def test_a_leap_too_far_is_named():
    pad = FemPad(3, 2, Layer())
    disc = np.where(np.hypot(pad.nodes_mm[:, None], pad.nodes_mm) <= 3.0, 0.0, 1e3)
    with pytest.raises(NoEquilibriumError, match=r"at an indentation of 4\.4 mm; press in other steps"):
        pad.press(disc, np.array([0.1, 4.4]))
