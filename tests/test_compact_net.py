import pytest
import torch

from train.compact_net import CompactNet


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(0)
    return CompactNet(4, 10, channels=16, blocks=2).eval()


def window(count=3, taps=4, seed=0):
    return torch.randn(count, 3 * taps, 4, 4, generator=torch.Generator().manual_seed(seed))


def test_shapes_follow_taps_and_scale(net):
    assert net(window()).shape == (3, 40, 40)
    assert CompactNet(1, 4, 8, 1)(window(taps=1)).shape == (3, 16, 16)
    assert CompactNet(2, 20, 8, 1)(window(taps=2)).shape == (3, 80, 80)


def test_absent_taps_are_the_same_as_fewer_taps(net):
    for taps in (1, 2, 3):
        given = window()
        given[:, 3 * taps :] = 0
        assert torch.allclose(net(given), net.with_fewer_taps(taps).eval()(given[:, : 3 * taps]), atol=1e-6)


def test_fewer_taps_have_weights_of_their_own(net):
    before = net.enter.weight.clone()
    fewer = net.with_fewer_taps(2)
    with torch.no_grad():
        for parameter in fewer.parameters():
            parameter.zero_()
    assert (net.enter.weight == before).all()
    with pytest.raises(ValueError, match="expected 1 to 4"):
        net.with_fewer_taps(5)


def test_patterns_are_cut_at_zero_in_use_alone(net):
    assert net(window()).min() == 0
    assert net.train()(window()).min() < 0
    net.eval()


def test_a_firm_tap_scales_the_pattern(net):
    with torch.inference_mode():
        firm, firmer = net(20 * window()), net(200 * window())
    assert torch.allclose(firmer, 10 * firm, rtol=0.05, atol=0.05 * float(firmer.max()))


@pytest.mark.parametrize("factor", [0.0, 1e-40, 1e-6, 1e3, 1e6])
def test_extreme_windows_give_finite_patterns(net, factor):
    assert torch.isfinite(net(factor * window())).all()


def test_no_tap_at_all_gives_next_to_nothing(net):
    assert net(torch.zeros(1, 12, 4, 4)).max() < 0.02 * net(window()).max()


def test_odd_scales_are_refused():
    with pytest.raises(ValueError, match="even"):
        CompactNet(1, 5)
