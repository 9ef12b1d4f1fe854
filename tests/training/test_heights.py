import numpy as np
import pytest

from train.physics.contact import ContactSolver
from train.physics.curved_patterns import PLANES, heights_pattern
from train.physics.elastic_layer import Layer
from train.physics.tpsf import tpsf_pattern

PIXEL_MM = 0.47
SIDE = 42


def along():
    place = (np.arange(SIDE) - (SIDE - 1) / 2) * PIXEL_MM
    return place[None, :] + 0 * place[:, None], place[:, None] + 0 * place[None, :]


def round_surface(name, radius_mm):
    x, y = along()
    square = x**2 + y**2 if name == "sphere" else y**2
    return np.where(square < radius_mm**2, radius_mm - np.sqrt(np.maximum(radius_mm**2 - square, 0)), 1e3)


def steps(low_mm):
    """Two squares, the right one lower."""
    depth = np.full((1, SIDE, SIDE), 1e3)
    depth[0, 12:30, 6:16] = 0.0
    depth[0, 12:30, 26:36] = low_mm
    return depth, depth < 1


def error(pattern, surface_mm, indentation_mm):
    return np.sqrt(np.mean((pattern - np.maximum(surface_mm, 0)) ** 2)) / indentation_mm


@pytest.mark.parametrize("kernel", ["gaussian", "exponential"])
@pytest.mark.parametrize("planes", [1, 3, PLANES])
def test_a_flat_surface_has_the_tactile_psfs_pattern(planes, kernel):
    touching = np.random.default_rng(0).random((4, SIDE, SIDE)) > np.array([0.2, 0.6, 0.99, 1.1])[:, None, None]
    indentation = np.array([0.1, 0.3, 0.5, 0.2])
    depth = np.where(touching, 0.0, 1e3)
    flat = tpsf_pattern(touching, indentation, PIXEL_MM, 1.0, kernel)
    pattern = heights_pattern(depth, touching, indentation, PIXEL_MM, planes, 1.0, kernel=kernel)
    assert np.allclose(pattern, flat, atol=2e-7)
    assert pattern[:3].any()


def test_the_pad_follows_the_surface_that_it_touches():
    depth = round_surface("sphere", 10.0)[None]
    touching = depth < 0.15
    pattern = heights_pattern(depth, touching, np.array([0.3]), PIXEL_MM)
    assert np.allclose(pattern[touching], (0.3 - depth)[touching], atol=1e-6)
    assert (pattern >= 0).all()
    assert pattern.max() == pytest.approx(0.3 - depth.min(), abs=1e-6)


def test_a_lower_step_lifts_its_surroundings_less():
    depth, touching = steps(0.2)
    pattern = heights_pattern(depth, touching, np.array([0.4]), PIXEL_MM)[0]
    beside = pattern[20, 5], pattern[20, 36]
    level = heights_pattern(np.where(touching, 0.0, 1e3), touching, np.array([0.4]), PIXEL_MM)[0]
    # The upper one spreads as if it were alone: the other is 4.7 mm away. The lower one half as high, and less far.
    assert beside[0] == pytest.approx(level[20, 5], rel=1e-3)
    assert beside[1] < 0.5 * level[20, 36]
    assert beside[1] > 0.3 * level[20, 36]


def test_patterns_grow_in_proportion_with_depth_and_indentation():
    depth = np.stack([round_surface("cylinder", 5.0), 2 * round_surface("cylinder", 5.0)])
    touching = np.stack([depth[0] < 0.1] * 2)
    one, two = heights_pattern(depth, touching, np.array([0.2, 0.4]), PIXEL_MM)
    assert np.allclose(2 * one, two, atol=1e-6)


def test_a_tap_is_alike_alone_and_in_company():
    depth = np.stack([round_surface("sphere", 5.0), np.zeros((SIDE, SIDE)), round_surface("cylinder", 10.0)])
    touching = np.stack([depth[0] < 0.2, along()[0] > 3, depth[2] < 0.1])
    indentation = np.array([0.4, 0.2, 0.3])
    together = heights_pattern(depth, touching, indentation, PIXEL_MM)
    for i in range(3):
        alone = heights_pattern(depth[i : i + 1], touching[i : i + 1], indentation[i : i + 1], PIXEL_MM)
        assert np.allclose(together[i], alone[0], atol=1e-6)


def test_several_psfs_are_nearer_to_the_layer_than_one():
    solver = ContactSolver(Layer(), SIDE, PIXEL_MM)

    def errors(name, radius_mm):
        """Return errors of the tactile PSF, of one plane, and of several, as a share of the indentation."""
        each = []
        for indentation_mm in (0.2, 0.4):
            depth = round_surface(name, radius_mm)[None].astype(np.float32)
            result = solver.solve(depth, indentation_mm)
            touching, press = result.pressure_mpa > 0, np.array([indentation_mm])
            patterns = (
                tpsf_pattern(touching, press, PIXEL_MM),
                heights_pattern(depth, touching, press, PIXEL_MM, planes=1),
                heights_pattern(depth, touching, press, PIXEL_MM),
            )
            each.append([error(pattern, result.displacement_mm, indentation_mm) for pattern in patterns])
        return np.mean(each, axis=0)

    small = np.stack([errors("sphere", 5), errors("sphere", 10), errors("cylinder", 5)])
    wide = np.stack([errors("sphere", 20), errors("cylinder", 10)])
    # Measured 5 to 13 % for the tactile PSF, .5 to 1.5 % for several planes.
    for errors_of in (small, wide):
        assert (errors_of[:, 0] > 5 * errors_of[:, 2]).all()
        assert errors_of[:, 2].max() < 0.018
    # A small contact has little room for planes, and one does: measured .7 to 1.5 %.
    assert (wide[:, 2] < 0.75 * wide[:, 1]).all()


@pytest.mark.filterwarnings("error")
def test_no_indentation_no_contact_and_an_impossible_one_stay_finite():
    depth = np.stack([round_surface("sphere", 5.0)] * 3)
    touching = np.stack([depth[0] < 0.1, np.zeros((SIDE, SIDE), bool), depth[0] < 1.0])
    pattern = heights_pattern(depth, touching, np.array([0.0, 0.3, 0.2]), PIXEL_MM)
    assert not pattern[:2].any()
    # Touching where the surface is out of reach is no depression, and no bump either.
    assert (pattern >= 0).all()
    assert np.isfinite(pattern).all()


def test_wrong_input_is_refused():
    depth, touching = np.zeros((1, 4, 4)), np.ones((1, 4, 4), bool)
    with pytest.raises(ValueError, match=r"contact \(1, 5, 4\)"):
        heights_pattern(depth, np.ones((1, 5, 4), bool), np.ones(1), PIXEL_MM)
    with pytest.raises(ValueError, match="0 planes"):
        heights_pattern(depth, touching, np.ones(1), PIXEL_MM, planes=0)
    with pytest.raises(ValueError, match="positive length"):
        heights_pattern(depth, touching, np.ones(1), PIXEL_MM, beta_mm=0.0)
