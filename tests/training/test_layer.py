import numpy as np
import pytest

from train.physics.elastic_layer import Layer, inner_displacement, inner_tangential, surface_compliance

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


@pytest.mark.parametrize("load", ["pressure", "traction"])
def test_inside_obeys_equilibrium(load):
    layer, q, step = Layer(poisson=0.45), np.array([0.5]), 1e-3
    heights = [2.0 - step, 2.0, 2.0 + step]
    if load == "pressure":
        w, u = np.array(
            [(-down[0], along[0]) for down, along in (inner_displacement(layer, q, at) for at in heights)]
        ).T
    else:
        fields = [inner_tangential(layer, q, height) for height in heights]
        w, u, across = np.array([(field.sunk[0], field.along[0], field.across[0]) for field in fields]).T
        assert (across[2] - 2 * across[1] + across[0]) / step**2 == pytest.approx(q[0] ** 2 * across[1], rel=1e-4)
    slope_w, slope_u = (w[2] - w[0]) / (2 * step), (u[2] - u[0]) / (2 * step)
    bend_w, bend_u = (w[2] - 2 * w[1] + w[0]) / step**2, (u[2] - 2 * u[1] + u[0]) / step**2
    stiff = 1 / (1 - 2 * layer.poisson)
    along_x = bend_u - q[0] ** 2 * u[1] + stiff * q[0] * (slope_w - q[0] * u[1])
    along_z = bend_w - q[0] ** 2 * w[1] + stiff * (bend_w - q[0] * slope_u)
    assert abs(along_x) < 1e-4 * abs(stiff * q[0] ** 2 * u[1])
    assert abs(along_z) < 1e-4 * abs(stiff * q[0] ** 2 * w[1])


@pytest.mark.parametrize("settings", [{"poisson": 0.5}, {"poisson": -0.1}, {"thickness_mm": 0.0}])
def test_impossible_layers_are_refused(settings):
    with pytest.raises(ValueError, match=r"poisson|positive"):
        Layer(**settings)
