import math

import pytest
import torch

from train.data.press_batches import Batch
from train.networks.blocks import relative_rms_error
from train.networks.compact import TRACTION_SCALE, CompactNet, HeteroscedasticError, heteroscedastic_loss


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(0)
    return CompactNet(4, 10, channels=16, blocks=2).eval()


def window(count=3, taps=4, seed=0):
    return torch.randn(count, 3 * taps, 4, 4, generator=torch.Generator().manual_seed(seed))


def truth_like(pattern, seed=5):
    return 0.3 * torch.rand(pattern.shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("taps", "scale"), [(1, 4), (7, 6), (4, 8), (4, 10), (2, 20)])
def test_shapes_follow_taps_and_scale(taps, scale):
    small = CompactNet(taps, scale, 16, 1)
    pattern, deviation, traction = small(window(taps=taps))
    assert pattern.shape == deviation.shape == (3, 4 * scale, 4 * scale)
    assert traction.shape == (3, 3, 4 * TRACTION_SCALE, 4 * TRACTION_SCALE)
    assert (small.taps, small.scale) == (taps, scale)


@pytest.mark.parametrize(("taps", "channels", "said"), [(0, 16, "at least 1"), (1, 6, "multiple of the 4 symmetries")])
def test_taps_and_channels_out_of_range_are_refused(taps, channels, said):
    with pytest.raises(ValueError, match=said):
        CompactNet(taps, 4, channels)


def test_absent_taps_are_the_same_as_fewer_taps(net):
    given = window()
    given[:, 6:] = 0
    fewer = CompactNet(2, 10, channels=16, blocks=2, group=net.group).eval()
    fewer.take_over(net)
    for output, expected in zip(net(given), fewer(given[:, :6]), strict=True):
        assert torch.allclose(output, expected, atol=1e-6 * float(output.detach().abs().max()) + 1e-6)


@pytest.mark.parametrize("other", [{"channels": 32}, {"blocks": 2}, {"known": 13}])
def test_another_width_or_other_inputs_of_the_pad_are_not_taken_over(other):
    start = CompactNet(1, 4, **{"channels": 16, "blocks": 1, **other})
    with pytest.raises(ValueError, match="its width and inputs of the pad are"):
        CompactNet(2, 4, 16, 1).take_over(start)


def test_patterns_are_cut_at_zero_in_use_alone(net):
    assert net(window())[0].min() == 0
    assert net.train()(window())[0].min() < 0
    net.eval()


def test_a_firm_tap_scales_pattern_deviation_and_traction(net):
    with torch.inference_mode():
        for firm, firmer in zip(net(20 * window()), net(200 * window()), strict=True):
            assert torch.allclose(firmer, 10 * firm, rtol=0.05, atol=0.05 * float(firmer.abs().max()))


@pytest.mark.parametrize("factor", [0.0, 1e-40, 1e-6, 1e3, 1e6])
def test_extreme_windows_give_finite_patterns_and_deviations_above_zero(net, factor):
    pattern, deviation, traction = net(factor * window())
    assert torch.isfinite(pattern).all()
    assert torch.isfinite(deviation).all()
    assert torch.isfinite(traction).all()
    assert (deviation > 0).all()


def test_the_pattern_learns_as_if_there_were_no_deviation():
    torch.manual_seed(2)
    net = CompactNet(2, 4, 16, 1).train()
    learns = {name: value for name, value in net.named_parameters() if not name.startswith("traction")}
    pattern, deviation, _ = net(window(taps=2))
    truth = truth_like(pattern)
    of_both = torch.autograd.grad(heteroscedastic_loss(pattern, deviation, truth), list(learns.values()))
    pattern, *_ = net(window(taps=2))
    alone = torch.autograd.grad(relative_rms_error(pattern, truth), list(learns.values()), allow_unused=True)
    for name, both, one in zip(learns, of_both, alone, strict=True):
        if name.startswith("uncertainty"):
            assert one is None
            assert both.abs().max() > 0
        else:
            assert torch.equal(both, one)


def test_the_best_deviation_is_that_of_a_laplace_density_with_the_mean_error():
    torch.manual_seed(6)
    errors = torch.distributions.Laplace(0.0, 0.02).sample((1, 100, 100))
    truth = torch.full_like(errors, 0.2)
    best_mm = math.sqrt(2) * (float(errors.abs().mean()) - 1e-3 * 0.2)  # the share that the loss adds

    def slope(deviation_mm):
        deviation = torch.full_like(truth, deviation_mm, requires_grad=True)
        heteroscedastic_loss(truth + errors, deviation, truth).backward()
        assert deviation.grad is not None
        return float(deviation.grad.sum())

    assert slope(0.98 * best_mm) < 0 < slope(1.02 * best_mm)
    assert slope(0.1 * best_mm) < 0 < slope(10 * best_mm)
    assert math.sqrt(float((errors**2).mean())) == pytest.approx(best_mm, rel=0.05)


def test_light_contacts_count_as_much_as_firm_ones():
    truth = truth_like(torch.zeros(4, 6, 6))
    pattern, deviation = truth + 0.01, torch.full_like(truth, 0.02)
    firm = heteroscedastic_loss(pattern, deviation, truth)
    light = heteroscedastic_loss(0.05 * pattern, 0.05 * deviation, 0.05 * truth)
    assert float(firm) == pytest.approx(float(light), rel=1e-5)


@pytest.mark.parametrize("deviation_mm", [1e-30, 1e-12, 1e-3, 1e6])
@pytest.mark.parametrize("error_mm", [0.0, 1e-6, 1.0, 1e6])
def test_slopes_are_finite_and_no_steeper_than_the_error(deviation_mm, error_mm):
    truth = truth_like(torch.zeros(2, 6, 6)) + 0.01
    log_deviation = torch.full_like(truth, math.log(deviation_mm), requires_grad=True)
    loss = heteroscedastic_loss(truth + error_mm, log_deviation.exp(), truth)
    loss.backward()
    assert torch.isfinite(loss)
    slope = log_deviation.grad
    assert slope is not None
    assert torch.isfinite(slope).all()
    size = truth.square().mean(dim=(1, 2)).sqrt().min()
    assert slope.sum() <= (deviation_mm + error_mm) / size
    assert slope.sum() >= -error_mm / size - 1e-6


@pytest.mark.parametrize("taps", [1, 2])
def test_with_more_taps_the_function_is_the_same_until_it_is_trained(taps):
    torch.manual_seed(0)
    net = CompactNet(taps, 10, channels=16, blocks=1, known=3).eval()
    larger = CompactNet(4, 10, channels=16, blocks=1, known=3).eval()
    larger.take_over(net)
    given, pad = torch.randn(3, 12, 4, 4), torch.randn(3, 3)
    for ours, theirs in zip(larger(given, pad), net(given[:, : 3 * taps], pad), strict=True):
        assert torch.allclose(ours, theirs, atol=1e-6 * float(theirs.detach().abs().max()) + 1e-6)


def test_what_is_known_of_the_pad_changes_the_outputs_and_nothing_known_is_zeros():
    torch.manual_seed(0)
    net = CompactNet(1, 4, channels=16, blocks=1, known=3).eval()
    unknown, zeros = net(window(taps=1)), net(window(taps=1), torch.zeros(3, 3))
    assert all(torch.equal(one, other) for one, other in zip(unknown, zeros, strict=True))
    assert not torch.allclose(unknown[0], net(window(taps=1), torch.ones(3, 3))[0])


def test_traction_is_learned_where_it_is_known_and_light_pulls_count_as_firm_ones():
    torch.manual_seed(0)
    net = CompactNet(1, 4, channels=16, blocks=1)
    pattern, _, traction = net(window(taps=1))
    truth, pulled = truth_like(pattern), torch.randn(traction.shape)
    loss = HeteroscedasticError().loss
    alone = float(loss(net, Batch(window(taps=1), truth)).detach())
    share = [
        float(loss(net, Batch(window(taps=1), truth, traction=(traction.detach() + pulled * size))).detach()) - alone
        for size in (100.0, 1e4)
    ]
    assert 0 < share[0] == pytest.approx(share[1], rel=0.1)
    right = loss(net, Batch(window(taps=1), truth, traction=traction.detach()))
    assert float(right.detach()) == pytest.approx(alone, abs=1e-6)
