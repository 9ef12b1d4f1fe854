"""Patterns of flat and of curved contacts: the paper's equations, and the layer that they stand for."""

import numpy as np
import pytest
import torch

from firmware_bridge.pad_geometry import USPA44
from train.networks.tactile_psf import PsfNet, degrade, fit_psf_net, tpsf
from train.physics.contact import ContactSolver
from train.physics.elastic_layer import Layer
from train.physics.tpsf import BETA_MM, heights_pattern, resample, spread, tpsf_pattern
from train.surfaces.depth_image import depth_image
from train.surfaces.named_surfaces import FIGURE_HEIGHT_MM, SURFACES, relief
from train.surfaces.poses import random_poses

PIXEL_MM = 0.47
SIDE = 42


def direct(maps, beta_mm):
    """Eq. 5's integral pixel by pixel, one map."""
    place = np.argwhere(np.ones_like(maps, dtype=bool)) * PIXEL_MM
    square = ((place[:, None] - place[None]) ** 2).sum(axis=2)
    return PIXEL_MM**2 * (np.exp(-square / beta_mm**2) @ maps.ravel()).reshape(maps.shape)


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
    place_mm = (np.arange(SIDE) - (SIDE - 1) / 2) * PIXEL_MM
    square = place_mm[:, None] ** 2 + place_mm**2
    depth = np.stack([np.where(square < 25, 5 - np.sqrt(np.maximum(25 - square, 0)), 1e3)] * 3)  # a ball
    touching = np.stack([depth[0] < 0.1, np.zeros((SIDE, SIDE), bool), depth[0] < 1.0])
    pattern = heights_pattern(depth, touching, np.array([0.0, 0.3, 0.2]), PIXEL_MM)
    assert not pattern[:2].any()
    # Touching where the surface is out of reach is no depression, and no bump either.
    assert (pattern >= 0).all() and np.isfinite(pattern).all()


@pytest.mark.parametrize("scale", [4, 4.5, 7, 12.5, 19])
def test_resampling_keeps_mean_and_constants(scale):
    maps = np.random.default_rng(0).random((3, 80, 80)).astype(np.float32)
    small = resample(maps, 20, scale)
    assert small.shape == (3, round(4 * scale), round(4 * scale)) and small.dtype == np.float32
    assert np.allclose(small.mean(axis=(1, 2)), maps.mean(axis=(1, 2)), atol=1e-6)
    assert np.allclose(resample(np.full((1, 80, 80), 0.3), 20, scale), 0.3)


def test_degradation_is_equations_7_and_8():
    pattern = torch.from_numpy(np.random.default_rng(0).random((1, 16, 16))).double()
    pixel_mm, gamma = USPA44.pitch_mm / 4, 1.1
    row, col = (np.mgrid[:16, :16] - 7.5) * pixel_mm
    x, y = USPA44.taxel_centres_mm().T[:, :, None, None]
    weights = np.exp(-np.hypot(col - x, row - y) / gamma**2)
    weights /= weights.max(axis=(1, 2), keepdims=True)
    expected = pixel_mm**2 * (weights * pattern.numpy()).sum(axis=(1, 2)).reshape(4, 4)
    assert np.allclose(degrade(pattern, torch.tensor(gamma).double())[0], expected, rtol=1e-6)


def test_training_finds_patterns_of_a_sensor_like_the_model():
    """Scans of 192 rectangles under a sensor that is the model itself: any alpha, one beta and one gamma."""
    rng, depth = np.random.default_rng(0), torch.zeros(192, 40, 40)
    for image in depth:
        top, left = rng.integers(0, 20, 2)
        height, width = rng.integers(5, 20, 2)
        image[top : top + height, left : left + width] = 1.0
    alpha = torch.from_numpy(np.random.default_rng(1).uniform(0.1, 0.5, 192)).float()
    pattern = tpsf(depth, alpha, torch.ones(1), PIXEL_MM)
    counts = np.zeros((192, 3, 4, 4), np.float32)
    counts[:, 2] = 100.0 * degrade(pattern, torch.tensor(1.2)).numpy()
    depth, press = depth.numpy(), 0.3 * pattern.amax(dim=(1, 2)).numpy()
    net, again = PsfNet(), PsfNet()
    losses = fit_psf_net(net, counts, depth, press, epochs=60)
    assert losses[-1] < 0.1 * losses[0]
    with torch.no_grad():
        plateau = net.pattern(net(torch.from_numpy(counts)), torch.from_numpy(depth)).amax(dim=(1, 2)).numpy()
    # One k_scale, the least-squares factor, brings every plateau near its indentation. Measured: 0.26 of it.
    assert np.sqrt(np.mean((plateau - press) ** 2)) < 0.35 * press.mean()
    assert plateau @ (plateau - press) == pytest.approx(0, abs=1e-3 * float(plateau @ press))
    torch.manual_seed(7)
    expected = torch.rand(1)
    torch.manual_seed(7)
    assert fit_psf_net(again, counts, depth, press, epochs=2, seed=1) != losses[:2]
    assert torch.equal(torch.rand(1), expected), "it leaves others' chance alone"
