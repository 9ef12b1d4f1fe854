import numpy as np
import pytest
import torch

from train.physics.contact import ContactSolver
from train.physics.elastic_layer import Layer
from train.physics.tpsf import BETA_MM, spread, spread_by_fft, tpsf, tpsf_pattern
from train.surfaces.depth_image import Relief, depth_image
from train.surfaces.named_surfaces import FIGURE_HEIGHT_MM, surface_mesh
from train.surfaces.poses import random_targets

PIXEL_MM = 0.47
ONE = np.ones(1)
KERNELS = ["gaussian", "exponential"]
PLATEAUS = ["response", "outside"]


def weights(radius_mm, beta_mm, kernel):
    return np.exp(-((radius_mm / beta_mm) ** 2)) if kernel == "gaussian" else np.exp(-radius_mm / beta_mm)


def direct(maps, beta_mm, kernel, pixel_mm=PIXEL_MM):
    """Eq. 5's integral pixel by pixel, one map."""
    place = np.argwhere(np.ones_like(maps, dtype=bool)) * pixel_mm
    radius = np.hypot(*(place[:, None] - place[None]).transpose(2, 0, 1))
    return pixel_mm**2 * (weights(radius, beta_mm, kernel) @ maps.ravel()).reshape(maps.shape)


def contact(side=40):
    touching = torch.zeros(1, side, side)
    touching[0, 5:16, 8:25] = 1.0
    return touching


def parameter(value):
    return torch.tensor([value], requires_grad=True)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("beta_mm", [0.3, 1.0, 4.0])
def test_the_response_is_equation_5(kernel, beta_mm):
    maps = np.random.default_rng(0).random((2, 20, 15)).astype(np.float32)
    betas = torch.tensor([beta_mm, 1.3 * beta_mm])
    for route in (spread, spread_by_fft):
        response = route(torch.from_numpy(maps), betas, PIXEL_MM, kernel).numpy()
        for one, image, beta in zip(response, maps, betas.tolist(), strict=True):
            assert np.allclose(one, direct(image, beta, kernel), rtol=2e-5, atol=1e-6)


def test_far_from_the_edges_a_full_face_is_the_integral_of_the_kernel():
    full = torch.ones(1, 161, 161)
    beta = torch.tensor([0.9])
    # In the plane the Gaussian's integral is pi beta^2, the exponential's 2 pi beta^2.
    assert float(spread(full, beta, 0.1, "gaussian")[0, 80, 80]) == pytest.approx(np.pi * 0.81, rel=1e-5)
    assert float(spread(full, beta, 0.1, "exponential")[0, 80, 80]) == pytest.approx(2 * np.pi * 0.81, rel=3e-3)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_response_does_not_depend_on_the_scale(kernel):
    fine = spread(contact(40).repeat_interleave(2, 1).repeat_interleave(2, 2), torch.tensor([1.5]), 0.235, kernel)
    coarse = spread(contact(40), torch.tensor([1.5]), 0.47, kernel)
    assert torch.allclose(fine.reshape(1, 40, 2, 40, 2).mean(dim=(2, 4)), coarse, atol=0.02 * float(coarse.max()))


def test_nothing_wraps_round_the_edges():
    corner = torch.zeros(1, 40, 40)
    corner[0, 0, 0] = 1.0
    response = spread_by_fft(corner, torch.tensor([2.0]), PIXEL_MM, "exponential")[0]
    assert float(response[39, 39]) < 1e-6
    assert float(response[0, 39]) == pytest.approx(PIXEL_MM**2 * np.exp(-39 * PIXEL_MM / 2.0), abs=1e-7)


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_plateau_is_equation_6(kernel):
    depth, beta = contact(), torch.tensor([1.2])
    touching = depth.bool()
    response = 2.5 * spread(depth, beta, PIXEL_MM, kernel)
    by_rule = {rule: tpsf(depth, torch.tensor([2.5]), beta, PIXEL_MM, kernel, rule) for rule in (*PLATEAUS, "none")}
    assert torch.equal(by_rule["none"], response)
    for rule in PLATEAUS:
        assert torch.equal(by_rule[rule][~touching], response[~touching])
    assert (by_rule["response"][touching] == response.max()).all()
    assert (by_rule["outside"][touching] == response[~touching].max()).all()
    assert response[~touching].max() < 0.8 * response.max()


@pytest.mark.parametrize("plateau", PLATEAUS)
@pytest.mark.parametrize("kernel", KERNELS)
def test_a_full_face_is_not_zero_and_no_contact_is(kernel, plateau):
    full = tpsf(torch.ones(1, 40, 40), torch.ones(1), torch.ones(1), PIXEL_MM, kernel, plateau)
    assert (
        float(full.min())
        == float(full.max())
        == pytest.approx(float(spread(torch.ones(1, 40, 40), torch.ones(1), PIXEL_MM, kernel).max()))
    )
    assert float(full.min()) > 1
    assert not tpsf(torch.zeros(1, 40, 40), torch.ones(1), torch.ones(1), PIXEL_MM, kernel, plateau).any()
    assert np.allclose(tpsf_pattern(np.ones((1, 40, 40), bool), 0.3 * ONE, PIXEL_MM, 1.0, kernel, plateau), 0.3)
    assert not tpsf_pattern(np.zeros((1, 40, 40), bool), ONE, PIXEL_MM, 1.0, kernel, plateau).any()


@pytest.mark.parametrize("plateau", PLATEAUS)
@pytest.mark.parametrize("kernel", KERNELS)
def test_contact_pixels_alone_pull_at_alpha_and_beta(kernel, plateau):
    depth = contact()
    alpha, beta = parameter(2.0), parameter(1.2)
    tpsf(depth, alpha, beta, PIXEL_MM, kernel, plateau)[depth.bool()].mean().backward()
    by_hand = []
    for a, b in ((2.01, 1.2), (1.99, 1.2), (2.0, 1.21), (2.0, 1.19)):
        level = tpsf(depth.double(), torch.tensor([a]).double(), torch.tensor([b]).double(), PIXEL_MM, kernel, plateau)
        by_hand.append(float(level[depth.bool()].mean()))
    assert float(alpha.grad) == pytest.approx((by_hand[0] - by_hand[1]) / 0.02, rel=1e-3)
    assert float(beta.grad) == pytest.approx((by_hand[2] - by_hand[3]) / 0.02, rel=1e-3)
    assert float(alpha.grad) > 0.3


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("plateau", [*PLATEAUS, "none"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_extremes_stay_finite_with_their_gradients(kernel, plateau):
    one = torch.zeros(1, 40, 40)
    one[0, 20, 20] = 1.0
    for depth in (torch.zeros(1, 40, 40), torch.ones(1, 40, 40), one, contact()):
        for alpha_value in (0.0, 1.0, 1e6):
            for beta_value in (1e-6, 1e-3, 1.0, 1e3):
                alpha, beta = parameter(alpha_value), parameter(beta_value)
                pattern = tpsf(depth, alpha, beta, PIXEL_MM, kernel, plateau)
                pattern.sum().backward()
                assert torch.isfinite(pattern).all()
                assert (pattern >= 0).all()
                assert torch.isfinite(torch.cat([alpha.grad, beta.grad])).all()


def test_each_sample_has_its_own_alpha_and_beta():
    depth = contact().repeat(3, 1, 1)
    alpha, beta = torch.tensor([0.5, 1.0, 2.0]), torch.tensor([0.7, 1.0, 3.0])
    together = tpsf(depth, alpha, beta, PIXEL_MM)
    for i in range(3):
        assert torch.allclose(together[i], tpsf(depth[:1], alpha[i : i + 1], beta[i : i + 1], PIXEL_MM)[0], rtol=1e-5)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("plateau", PLATEAUS)
def test_the_truth_is_equations_4_to_6_with_the_plateau_at_the_indentation(kernel, plateau):
    touching = np.random.default_rng(0).random((20, 20)) > 0.8
    response = direct(touching, 0.8, kernel)
    response[touching] = response[~touching].max() if plateau == "outside" else response.max()
    pattern = tpsf_pattern(touching[None], np.array([0.4]), PIXEL_MM, 0.8, kernel, plateau)
    assert np.allclose(pattern[0], 0.4 * response / response.max(), atol=1e-6)


def test_without_a_plateau_the_highest_point_is_the_indentation():
    depth = contact().numpy() > 0
    plain = tpsf_pattern(depth, np.array([0.4]), PIXEL_MM, plateau="none")[0]
    assert plain.max() == pytest.approx(0.4)
    assert plain[depth[0]].min() < 0.2


def test_the_plateau_is_each_taps_own_indentation():
    touching = np.zeros((2, 40, 40), dtype=bool)
    touching[0, 10:20, 10:30] = True
    touching[1, 5, 5] = True
    pattern = tpsf_pattern(touching, np.array([0.2, 0.5]), PIXEL_MM)
    assert np.allclose(pattern[0][touching[0]], 0.2)
    assert np.allclose(pattern[1][touching[1]], 0.5)
    assert (pattern[0][~touching[0]] < 0.2).all()
    assert (pattern >= 0).all()


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("beta_mm", [1e-6, 1e3])
def test_extreme_kernels_give_finite_truth(kernel, beta_mm):
    touching = np.zeros((1, 40, 40), dtype=bool)
    touching[0, 20, 20] = True
    for plateau in PLATEAUS:
        pattern = tpsf_pattern(touching, ONE, PIXEL_MM, beta_mm, kernel, plateau)
        assert np.isfinite(pattern).all()
        # Every pixel's equal or none but the one that touches.
        assert pattern.sum() == pytest.approx(1600 if beta_mm > 1 else 1, rel=0.02)


def test_wrong_settings_are_refused():
    touching = np.ones((1, 4, 4), dtype=bool)
    with pytest.raises(ValueError, match="positive length"):
        tpsf_pattern(touching, ONE, PIXEL_MM, 0.0)
    with pytest.raises(ValueError, match="positive length"):
        spread(torch.ones(1, 4, 4), torch.tensor([float("nan")]), PIXEL_MM)
    with pytest.raises(ValueError, match="'gaussian' or 'exponential'"):
        tpsf_pattern(touching, ONE, PIXEL_MM, 1.0, "box")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="'response' or 'outside' or 'none'"):
        tpsf_pattern(touching, ONE, PIXEL_MM, 1.0, plateau="flat")  # pyright: ignore[reportArgumentType]


def test_the_default_kernel_is_the_layers():
    targets = random_targets(np.random.default_rng(0), 36)
    reliefs = {name: Relief(name, surface_mesh(name)) for name in set(targets.surfaces)}
    poses = zip(targets.surfaces, targets.poses, strict=True)
    depth = np.stack([depth_image(reliefs[name], pose, 42, PIXEL_MM) for name, pose in poses])
    # Where the pad bulges out the tactile PSF knows nothing: it is compared with what is pressed in.
    surface_mm = np.maximum(ContactSolver(Layer(), 42, PIXEL_MM).solve(depth).displacement_mm, 0)
    touching = depth < FIGURE_HEIGHT_MM / 2

    def error(beta_mm=BETA_MM, kernel="gaussian", plateau="response"):
        pattern = tpsf_pattern(touching, np.ones(36), PIXEL_MM, beta_mm, kernel, plateau)
        return np.sqrt(np.mean((pattern - surface_mm) ** 2))

    assert error() < 0.027
    assert error() < min(error(1.0), error(1.6))
    # In the paper's order: tactile PSF, PSF, depth; even with the reach that is the best one for the PSF.
    assert 3 * error() < error(0.6, plateau="none") < np.sqrt(np.mean((touching - surface_mm) ** 2))
