import numpy as np
import pytest

from train.physics.elastic_layer import Layer
from train.physics.mooney_rivlin import MooneyRivlin

RUBBER = MooneyRivlin(0.05, 0.02, 6.0)
STEP = 1e-6


def gradients(count=5, seed=0):
    """Deformation gradients well away from the identity, (3, 3, count)."""
    return np.eye(3)[:, :, None] + 0.3 * np.random.default_rng(seed).uniform(-1, 1, (3, 3, count))


def slope(function, gradient):
    """Central differences of function(F) by F, the tensor's axes last but one before the points."""
    pieces = []
    for k in range(9):
        nudge = np.zeros((3, 3, 1))
        nudge[k // 3, k % 3] = STEP
        pieces.append((function(gradient + nudge) - function(gradient - nudge)) / (2 * STEP))
    return np.moveaxis(np.stack(pieces), 0, -2).reshape(*pieces[0].shape[:-1], 3, 3, -1)


@pytest.mark.parametrize("rubber", [RUBBER, MooneyRivlin(0.06, 0.0, 6.0), MooneyRivlin(0.0, 0.06, 6.0)])
def test_stress_is_the_slope_of_the_energy_and_stiffness_that_of_the_stress(rubber):
    gradient = gradients()
    assert np.allclose(rubber.stress(gradient), slope(rubber.energy, gradient), atol=1e-9)
    assert np.allclose(rubber.stiffness(gradient), slope(rubber.stress, gradient), atol=1e-8)


def test_turning_and_swelling_cost_nothing():
    gradient = gradients()
    turn = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    turned = np.einsum("ij,jk...->ik...", turn * np.linalg.det(turn), gradient)
    assert np.allclose(RUBBER.energy(turned), RUBBER.energy(gradient))
    assert np.allclose(RUBBER.energy(1.3 * gradient), RUBBER.energy(gradient))
    assert RUBBER.energy(1.3 * np.eye(3)) == pytest.approx(0, abs=1e-12)


def test_stretch_and_shear_cost_what_the_textbook_says():
    stretch = np.diag([1.4, 1.4**-0.5, 1.4**-0.5])
    expected = 0.05 * (1.4**2 + 2 / 1.4 - 3) + 0.02 * (2 * 1.4 + 1.4**-2 - 3)
    assert RUBBER.energy(stretch) == pytest.approx(expected)
    shear = np.eye(3)
    shear[0, 2] = 0.25
    assert RUBBER.energy(shear) == pytest.approx((0.05 + 0.02) * 0.25**2)


@pytest.mark.parametrize("c2_share", [0.0, 0.2, 1.0])
def test_at_small_strain_it_is_the_layer(c2_share):
    layer = Layer(shear_modulus_mpa=0.12, poisson=0.49)
    rubber = MooneyRivlin.of_layer(layer, c2_share)
    stiffness = rubber.stiffness(np.eye(3))
    assert stiffness[0, 1, 0, 1] == pytest.approx(0.12)
    assert stiffness[0, 1, 1, 0] == pytest.approx(0.12)
    assert stiffness[0, 0, 0, 0] == pytest.approx(4 / 3 * 0.12)
    assert rubber.bulk_mpa / 0.12 == pytest.approx(49.67, abs=0.01)
    assert rubber.c2_mpa == pytest.approx(c2_share * (rubber.c1_mpa + rubber.c2_mpa))


def test_a_share_beyond_the_whole_is_refused():
    with pytest.raises(ValueError, match="expected 0 to 1"):
        MooneyRivlin.of_layer(Layer(), 1.2)
