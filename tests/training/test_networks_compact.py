import pytest
import torch

from train.data.press_batches import Batch
from train.networks.blocks import relative_rms_error
from train.networks.compact import CompactNet, HeteroscedasticError, heteroscedastic_loss


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(0)
    return CompactNet(4, 10, channels=16, blocks=2).eval()


def window(count=3, taps=4, seed=0):
    return torch.randn(count, 3 * taps, 4, 4, generator=torch.Generator().manual_seed(seed))


def truth_like(pattern, seed=5):
    return 0.3 * torch.rand(pattern.shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("taps", "channels", "said"), [(0, 16, "at least 1"), (1, 6, "multiple of the 4 symmetries")])
def test_taps_and_channels_out_of_range_are_refused(taps, channels, said):
    with pytest.raises(ValueError, match=said):
        CompactNet(taps, 4, channels, 1)


def test_absent_taps_are_the_same_as_fewer_taps(net):
    given = window()
    given[:, 6:] = 0
    fewer = CompactNet(2, 10, channels=16, blocks=2, group=net.group).eval()
    fewer.take_over(net)
    for output, expected in zip(net(given), fewer(given[:, :6]), strict=True):
        assert torch.allclose(output, expected, atol=1e-6 * float(output.detach().abs().max()) + 1e-6)


@pytest.mark.parametrize("other", [{"channels": 32}, {"blocks": 2}, {"known": 13}])
def test_another_width_is_not_taken_over(other):
    start = CompactNet(1, 4, **{"channels": 16, "blocks": 1, **other})
    with pytest.raises(ValueError, match="its width and inputs of the pad are"):
        CompactNet(2, 4, 16, 1).take_over(start)


def test_patterns_are_cut_at_zero_in_use_alone(net):
    assert net(window())[0].min() == 0
    assert net.train()(window())[0].min() < 0
    net.eval()


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


def test_what_is_known_of_the_pad_changes_the_outputs():
    torch.manual_seed(0)
    net = CompactNet(1, 4, channels=16, blocks=1, known=3).eval()
    unknown, zeros = net(window(taps=1)), net(window(taps=1), torch.zeros(3, 3))
    assert all(torch.equal(one, other) for one, other in zip(unknown, zeros, strict=True))
    assert not torch.allclose(unknown[0], net(window(taps=1), torch.ones(3, 3))[0])


def test_light_pulls_count_as_much_as_firm_ones():
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
