import numpy as np
import pytest
import torch

from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from train.networks.tpsf_net import COUNTS_PER_UNIT, PsfNet, degrade, fit_psf_net
from train.physics.tpsf import tpsf

FORMS = ["paper", "code"]
PIXEL_MM = 0.47


def rectangles(count, seed=0, side=40):
    rng = np.random.default_rng(seed)
    depth = np.zeros((count, side, side), dtype=np.float32)
    for image in depth:
        top, left = rng.integers(0, side // 2, 2)
        height, width = rng.integers(side // 8, side // 2, 2)
        image[top : top + height, left : left + width] = 1.0
    return torch.from_numpy(depth)


def synthetic(count, seed=0):
    """Scans of a sensor that is the model itself: any alpha, one beta and one gamma."""
    depth = rectangles(count, seed)
    alpha = torch.from_numpy(np.random.default_rng(seed + 1).uniform(0.1, 0.5, count)).float()
    pattern = tpsf(depth, alpha, torch.ones(1), PIXEL_MM)
    counts = torch.zeros(count, 3, 4, 4)
    counts[:, 2] = 100.0 * degrade(pattern, torch.tensor(1.2))
    return counts, depth, 0.3 * pattern.amax(dim=(1, 2))


def taxel_by_taxel(pattern, gamma, geometry, form):
    """Eq. 7-8 with loops."""
    height, width = pattern.shape
    pixel_mm = geometry.pitch_mm * geometry.rows / height
    weights = np.zeros((geometry.taxel_count, height, width))
    for taxel, (x, y) in enumerate(geometry.taxel_centres_mm()):
        for row in range(height):
            for column in range(width):
                distance = np.hypot((column - (width - 1) / 2) * pixel_mm - x, (row - (height - 1) / 2) * pixel_mm - y)
                exponent = distance / gamma**2 if form == "paper" else distance**2 / gamma
                weights[taxel, row, column] = np.exp(-exponent)
        if form == "paper":
            weights[taxel] /= weights[taxel].max()
    if form == "code":
        weights = (weights - weights.min()) / (weights.max() - weights.min())
    return pixel_mm**2 * (weights * pattern).sum(axis=(1, 2)).reshape(geometry.rows, geometry.cols)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("geometry", [USPA44, SensorGeometry("strip", 2, 5, 3.0, 16.0, 7.0)])
def test_degradation_is_equations_7_and_8(form, geometry):
    pattern = torch.from_numpy(np.random.default_rng(0).random((2, *geometry.pattern_shape(4)))).double()
    gammas = torch.tensor([1.1, 2.3]).double()
    readings = degrade(pattern, gammas, geometry, form)
    for one, image, gamma in zip(readings, pattern, gammas.tolist(), strict=True):
        assert np.allclose(one, taxel_by_taxel(image.numpy(), gamma, geometry, form), rtol=1e-6)
        assert torch.allclose(degrade(image[None], torch.tensor(gamma).double(), geometry, form)[0], one)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("each", [False, True])
def test_extreme_gammas_stay_finite_with_their_gradients(form, each):
    pattern = torch.cat([rectangles(1), torch.zeros(1, 40, 40), torch.ones(1, 40, 40)])
    for value in (1e-3, 1e-2, 1.0, 1e3):
        gamma = torch.full((3,) if each else (), value, requires_grad=True)
        reading = degrade(pattern, gamma, USPA44, form)
        reading.sum().backward()
        assert torch.isfinite(reading).all()
        assert torch.isfinite(gamma.grad).all()
        assert (reading >= 0).all()
        assert (reading[2] > 0).all()
        assert not reading[1].any()


@pytest.mark.parametrize("gamma", ["sensor", "sample"])
def test_the_network_is_the_papers(gamma):
    net = PsfNet(gamma=gamma)
    widths = [(layer.in_features, layer.out_features) for layer in net.layers if isinstance(layer, torch.nn.Linear)]
    assert widths == [(48, 256), (256, 1024), (1024, 256), (256, 3 if gamma == "sample" else 2)]
    read = net(torch.randn(5, 3, 4, 4) * 1000)
    assert read.alpha.shape == read.beta_mm.shape == (5,)
    assert read.gamma.shape == ((5,) if gamma == "sample" else ())
    parameters = torch.cat([read.alpha, read.beta_mm, read.gamma.reshape(-1)])
    assert (parameters > 0).all()
    numbers = sum(p.numel() for p in net.parameters())
    assert numbers == 49 * 256 + 257 * 1024 + 1025 * 256 + 257 * (3 if gamma == "sample" else 2) + (gamma == "sensor")


def test_a_scan_far_out_of_range_divides_by_nothing():
    net = PsfNet(gamma="sample")
    with torch.no_grad():
        net.layers[-1].bias.fill_(-1e4)
    read = net(torch.zeros(2, 3, 4, 4))
    assert torch.isfinite(net.degraded(read, rectangles(2))).all()
    loss = net.loss(torch.zeros(2, 3, 4, 4), rectangles(2))
    loss.backward()
    assert all(torch.isfinite(p.grad).all() for p in net.parameters())


@pytest.mark.parametrize("plateau", ["response", "outside"])
def test_the_loss_reaches_all_three_through_a_full_face(plateau):
    net = PsfNet(plateau=plateau, gamma="sample")
    net.loss(torch.full((1, 3, 4, 4), 500.0), torch.ones(1, 40, 40)).backward()
    assert (net.layers[-1].bias.grad.abs() > 1e-6).all()


def test_the_loss_is_equation_9():
    net, depth = PsfNet(), rectangles(3)
    counts = torch.randn(3, 3, 4, 4) * 300
    with torch.no_grad():
        reading = net.degraded(net(counts), depth)
        expected = np.mean(
            [float(torch.linalg.vector_norm(reading[i] - counts[i, 2].clamp_min(0) / 100) ** 2) for i in range(3)]
        )
        assert float(net.loss(counts, depth)) == pytest.approx(expected, rel=1e-5)


def test_training_finds_the_patterns_of_a_sensor_that_is_the_model():
    counts, depth, press = synthetic(192)
    net = PsfNet()
    losses = fit_psf_net(net, counts.numpy(), depth.numpy(), press.numpy(), epochs=20, batch=16)
    assert losses[-1] < 0.1 * losses[0]
    with torch.no_grad():
        plateau = net.pattern(net(counts), depth).amax(dim=(1, 2))
    # One k_scale brings every plateau near its indentation. Measured: 7 % of the loss left, 0.26 of the indentation.
    assert float((plateau - press).square().mean().sqrt()) < 0.35 * float(press.mean())


def test_k_scale_is_the_least_squares_factor_and_leaves_the_readings():
    net, (counts, depth, press) = PsfNet(), synthetic(16)
    with torch.no_grad():
        read = net(counts)
        before = net.degraded(read, depth)
        plain = net.pattern(read, depth).amax(dim=(1, 2))
        net.set_k_scale(counts, depth, press)
        scaled = net.pattern(read, depth).amax(dim=(1, 2))
    assert torch.allclose(net.degraded(read, depth), before, rtol=1e-5)
    assert torch.allclose(scaled, plain * net.k_scale, rtol=1e-5)
    assert float(plain @ (scaled - press)) == pytest.approx(0, abs=1e-4 * float(plain @ press))
    assert "k_scale" in net.state_dict()


def test_one_seed_gives_one_network_and_leaves_others_chance_alone():
    counts, depth, _ = synthetic(32)
    torch.manual_seed(7)
    expected = torch.rand(1)
    torch.manual_seed(7)
    runs = []
    for seed in (0, 0, 1):
        net = PsfNet()
        torch.manual_seed(7)
        runs.append(fit_psf_net(net, counts.numpy(), depth.numpy(), epochs=2, batch=8, seed=seed))
        assert torch.equal(torch.rand(1), expected)
    assert runs[0] == runs[1] != runs[2]


def test_wrong_input_is_refused():
    with pytest.raises(ValueError, match="'sensor' or 'sample'"):
        PsfNet(gamma="none")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="'paper' or 'code'"):
        degrade(torch.ones(1, 8, 8), torch.tensor(1.0), USPA44, "box")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="2 scans and 3 depth images"):
        fit_psf_net(PsfNet(), np.zeros((2, 3, 4, 4)), np.zeros((3, 40, 40)))
    assert COUNTS_PER_UNIT == 100
