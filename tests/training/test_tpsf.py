"""Patterns of flat and of curved contacts: the paper's equations, and the layer that they stand for."""

import numpy as np
import pytest
import torch

from train.physics.contact import ContactSolver
from train.physics.elastic_layer import Layer
from train.physics.tpsf import BETA_MM, heights_pattern, resample, spread, tpsf_pattern
from train.surfaces.depth_image import depth_image
from train.surfaces.named_surfaces import FIGURE_HEIGHT_MM, SURFACES, relief
from train.surfaces.poses import random_poses

PIXEL_MM = 0.47
SIDE = 42
PLACE_MM = (np.arange(SIDE) - (SIDE - 1) / 2) * PIXEL_MM


def direct(maps, beta_mm):
    """Eq. 5's integral pixel by pixel, one map."""
    place = np.argwhere(np.ones_like(maps, dtype=bool)) * PIXEL_MM
    square = ((place[:, None] - place[None]) ** 2).sum(axis=2)
    return PIXEL_MM**2 * (np.exp(-square / beta_mm**2) @ maps.ravel()).reshape(maps.shape)


def round_surface(name, radius_mm):
    square = np.broadcast_to(PLACE_MM[:, None] ** 2 + (name == "sphere") * PLACE_MM**2, (SIDE, SIDE))
    return np.where(square < radius_mm**2, radius_mm - np.sqrt(np.maximum(radius_mm**2 - square, 0)), 1e3)


@pytest.mark.parametrize("beta_mm", [0.3, 1.0, 4.0])
def test_the_response_is_equation_5(beta_mm):
    maps = np.random.default_rng(0).random((2, 20, 15)).astype(np.float32)
    betas = torch.tensor([beta_mm, 1.3 * beta_mm])
    for one, image, beta in zip(spread(torch.from_numpy(maps), betas, PIXEL_MM), maps, betas.tolist(), strict=True):
        assert np.allclose(one.numpy(), direct(image, beta), rtol=2e-5, atol=1e-6)


def test_the_plateau_is_each_taps_own_indentation():
    touching = np.zeros((4, 20, 20), dtype=bool)
    touching[0] = np.random.default_rng(0).random((20, 20)) > 0.8
    touching[1, 5, 5] = touching[2] = True
    indentation_mm = np.array([0.4, 0.5, 0.3, 0.2])
    patterns = tpsf_pattern(touching, indentation_mm, PIXEL_MM, 0.8)
    for pattern, area, depth_mm in zip(patterns[:3], touching, indentation_mm, strict=False):
        response = direct(area, 0.8)
        assert np.allclose(pattern, depth_mm * np.where(area, 1, response / response.max()), atol=1e-6)
    assert not patterns[3].any(), "nothing touches"


def test_the_default_kernel_is_the_layers():
    reliefs = [relief(name) for name in SURFACES]
    poses = random_poses(np.random.default_rng(0), 36)
    depth = np.stack([depth_image(reliefs[i % 18], pose, SIDE, PIXEL_MM) for i, pose in enumerate(poses)])
    # Where the pad bulges out the tactile PSF knows nothing: it is compared with what is pressed in.
    solver = ContactSolver(Layer(), SIDE, PIXEL_MM)
    surface_mm = np.maximum(solver.displacement_mm(solver.solve(depth)[0]), 0)
    touching = depth < FIGURE_HEIGHT_MM / 2

    def off(pattern):
        return np.sqrt(np.mean((pattern - surface_mm) ** 2))

    def error(beta_mm):
        return off(tpsf_pattern(touching, np.ones(36), PIXEL_MM, beta_mm))

    assert error(BETA_MM) < 0.027
    assert error(BETA_MM) < min(error(1.0), error(1.6))
    # In the paper's order: tactile PSF, PSF, depth; even with the reach that is the best one for the PSF.
    plain = spread(torch.from_numpy(touching).float(), torch.tensor([0.6]), PIXEL_MM).numpy()
    assert 3 * error(BETA_MM) < off(plain / plain.max(axis=(1, 2), keepdims=True)) < off(touching)


@pytest.mark.filterwarnings("error")
def test_no_contact_and_an_impossible_one_stay_finite():
    depth = np.stack([round_surface("sphere", 5.0)] * 3)
    touching = np.stack([depth[0] < 0.1, np.zeros((SIDE, SIDE), bool), depth[0] < 1.0])
    pattern = heights_pattern(depth, touching, np.array([0.0, 0.3, 0.2]), PIXEL_MM)
    assert not pattern[:2].any()
    # Touching where the surface is out of reach is no depression, and no bump either.
    assert (pattern >= 0).all() and np.isfinite(pattern).all()


SCALES = [4, 4.5, 7, 12.5, 19]


def maps(count=3, side=80):
    return np.random.default_rng(0).random((count, side, side)).astype(np.float32)


@pytest.mark.parametrize("scale", SCALES)
def test_mean_and_constants_are_kept(scale):
    small = resample(maps(), 20, scale)
    assert small.shape == (3, round(4 * scale), round(4 * scale))
    assert small.dtype == np.float32
    assert np.allclose(small.mean(axis=(1, 2)), maps().mean(axis=(1, 2)), atol=1e-6)
    assert np.allclose(resample(np.full((1, 80, 80), 0.3), 20, scale), 0.3)
