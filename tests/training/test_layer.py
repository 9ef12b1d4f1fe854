import numpy as np
import pytest

from train.physics.elastic_layer import Layer, inner_displacement, surface_compliance

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
