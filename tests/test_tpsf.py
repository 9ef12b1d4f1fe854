import numpy as np
import pytest

from train.contact import ContactSolver
from train.dataset import random_poses
from train.depth import depth_image, depth_map
from train.layer import Layer
from train.surfaces import FIGURE_HEIGHT_MM, surface_mesh
from train.tpsf import tpsf_pattern

PIXEL_MM = 0.47
ONE = np.ones(1)


def direct(touching, beta_mm, kernel):
    """Eq. 4-6 pixel by pixel."""
    size = len(touching)
    place = np.argwhere(np.ones_like(touching)) * PIXEL_MM
    radius = np.hypot(*(place[:, None] - place[None]).transpose(2, 0, 1))
    weights = np.exp(-((radius / beta_mm) ** 2)) if kernel == "gaussian" else np.exp(-radius / beta_mm)
    response = (weights @ touching.ravel()).reshape(size, size)
    response[touching] = response.max()
    return response / response.max()


@pytest.mark.parametrize("kernel", ["gaussian", "exponential"])
@pytest.mark.parametrize("beta_mm", [0.3, 1.0, 4.0])
def test_the_pattern_is_equations_4_to_6(kernel, beta_mm):
    touching = np.random.default_rng(0).random((20, 20)) > 0.8
    pattern = tpsf_pattern(touching[None], np.array([0.4]), PIXEL_MM, beta_mm, kernel)
    assert np.allclose(pattern[0], 0.4 * direct(touching, beta_mm, kernel), atol=1e-6)


def test_the_plateau_is_the_indentation():
    touching = np.zeros((2, 40, 40), dtype=bool)
    touching[0, 10:20, 10:30] = True
    touching[1, 5, 5] = True
    pattern = tpsf_pattern(touching, np.array([0.2, 0.5]), PIXEL_MM)
    assert np.allclose(pattern[0][touching[0]], 0.2)
    assert np.allclose(pattern[1][touching[1]], 0.5)
    assert (pattern[0][~touching[0]] < 0.2).all()
    assert (pattern >= 0).all()


def test_full_face_is_not_zero_and_no_contact_is():
    pattern = tpsf_pattern(np.ones((1, 40, 40), dtype=bool), np.array([0.3]), PIXEL_MM)
    assert np.allclose(pattern, 0.3)
    assert not tpsf_pattern(np.zeros((1, 40, 40), dtype=bool), ONE, PIXEL_MM).any()


@pytest.mark.parametrize("beta_mm", [1e-6, 1e3])
def test_extreme_kernels_stay_finite(beta_mm):
    touching = np.zeros((1, 40, 40), dtype=bool)
    touching[0, 20, 20] = True
    assert np.isfinite(tpsf_pattern(touching, ONE, PIXEL_MM, beta_mm)).all()


def test_wrong_settings_are_refused():
    touching = np.ones((1, 4, 4), dtype=bool)
    with pytest.raises(ValueError, match="positive length"):
        tpsf_pattern(touching, ONE, PIXEL_MM, 0.0)
    with pytest.raises(ValueError, match="'gaussian' or 'exponential'"):
        tpsf_pattern(touching, ONE, PIXEL_MM, 1.0, "box")  # pyright: ignore[reportArgumentType]


def test_the_default_kernel_is_within_three_percent_of_the_layer():
    names, poses = random_poses(np.random.default_rng(0), 36)
    maps = {name: depth_map(surface_mesh(name)) for name in set(names)}
    depth = np.stack([depth_image(maps[name], pose, 42, PIXEL_MM) for name, pose in zip(names, poses, strict=True)])
    surface_mm = ContactSolver(Layer(), 42, PIXEL_MM).solve(depth).displacement_mm
    pattern = tpsf_pattern(depth < FIGURE_HEIGHT_MM / 2, np.ones(36), PIXEL_MM)
    # Where the pad bulges out the tactile PSF knows nothing: it is compared with what is pressed in.
    assert np.sqrt(np.mean((pattern - np.maximum(surface_mm, 0)) ** 2)) < 0.03
