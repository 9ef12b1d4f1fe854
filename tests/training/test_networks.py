"""Networks: compact, symmetric and published ones, and those that fuse taps of any poses."""

import pytest
import torch
from press_samples import make_press_set
from torch.utils.flop_counter import FlopCounterMode

from train.data.press_batches import Batch, PosedBatches
from train.networks.blocks import relative_rms_errors
from train.networks.compact import CompactNet, HeteroscedasticError, heteroscedastic_loss
from train.networks.fusion import FusionNet
from train.networks.named_networks import build, grown
from train.networks.published import SrganObjective
from train.networks.symmetric import Channels, scalars, symmetries, vectors, write_out


def window(count=3, taps=4, cols=4):
    return torch.randn(count, 3 * taps, 4, cols, generator=torch.Generator().manual_seed(0))


def truth_like(pattern):
    return 0.3 * torch.rand(pattern.shape, generator=torch.Generator().manual_seed(5))


def test_patterns_are_cut_at_zero_in_use_alone():
    torch.manual_seed(0)
    net = CompactNet(10, channels=16, blocks=2)
    assert net.eval()(window(taps=1))[0].min() == 0
    assert net.train()(window(taps=1))[0].min() < 0


def test_the_pattern_learns_as_if_there_were_no_deviation():
    torch.manual_seed(2)
    net = CompactNet(4, 16, 1).train()
    learns = {name: value for name, value in net.named_parameters() if not name.startswith("traction")}
    pattern, deviation, _ = net(window(taps=1))
    truth = truth_like(pattern)
    of_both = torch.autograd.grad(heteroscedastic_loss(pattern, deviation, truth), list(learns.values()))
    pattern, *_ = net(window(taps=1))
    alone = torch.autograd.grad(relative_rms_errors(pattern, truth).mean(), list(learns.values()), allow_unused=True)
    for name, both, one in zip(learns, of_both, alone, strict=True):
        if name.startswith("uncertainty"):
            assert one is None
            assert both.abs().max() > 0
        else:
            assert torch.equal(both, one)


def test_light_pulls_count_as_much_as_firm_ones():
    torch.manual_seed(0)
    net = CompactNet(4, channels=16, blocks=1)
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


def test_what_earlier_taps_make_worse_costs_more():
    truth = truth_like(torch.zeros(2, 8, 8)) + 0.1

    def loss(many: float, one: float, posed: bool = True) -> float:
        def net(window, *_):
            off = one if window.shape[1] == 3 else many
            return truth * (1 + off), torch.full_like(truth, 0.1), torch.zeros(2, 3, 4, 4)

        batch = Batch(window(2), truth, poses=torch.zeros(2, 4, 5) if posed else None)
        return float(HeteroscedasticError().loss(net, batch))

    assert loss(0.2, 0.4) == pytest.approx(loss(0.2, 0.2)) == pytest.approx(loss(0.2, 0.1, posed=False))
    assert loss(0.2, 0.05) - loss(0.2, 0.1) == pytest.approx(loss(0.2, 0.1) - loss(0.2, 0.2), rel=0.05)
    assert loss(0.2, 0.1) > loss(0.2, 0.2) + 0.2


def moved(maps, channels: Channels, number: int):
    """Maps (n, channels, H, W) after one of the symmetries: places move, and channels among each other."""
    index, sign = torch.from_numpy(channels.index[number].copy()), torch.from_numpy(channels.sign[number].copy())
    placed = symmetries(channels.group)[number](maps.detach().numpy())
    return torch.from_numpy(placed.copy())[:, index] * sign[:, None, None]


@pytest.mark.parametrize(("group", "count", "cols"), [("p4m", 8, 4), ("p4", 4, 4), ("p2", 2, 6)])
def test_the_whole_network_keeps_every_symmetry(group, count, cols):
    """Pattern and deviation move as they are, the traction's vectors turn, for any input about the pad."""
    torch.manual_seed(0)
    learning = CompactNet(10, channels=16, blocks=2, known=5, group=group).eval()
    given, pad = window(taps=1, cols=cols), torch.randn(3, 5, generator=torch.Generator().manual_seed(1))
    enter, kinds = vectors(group), (scalars(group, 1), scalars(group, 1), vectors(group))
    for net in (learning, write_out(learning)):
        with torch.inference_mode():
            outputs = net(given, pad)
            assert all(maps.max() > 0 for maps in outputs)
            unknown = net(given, 0 * pad)
            torch.testing.assert_close(net(given), unknown)
            assert not torch.allclose(outputs[0], unknown[0])
            for number in range(count):
                for got, maps, kind in zip(net(moved(given, enter, number), pad), outputs, kinds, strict=True):
                    expected = moved(maps.reshape(3, len(kind), *maps.shape[-2:]), kind, number).reshape(got.shape)
                    assert (got - expected).abs().max() <= 1e-5 * maps.abs().max()


def test_fused_taps_turn_together_and_have_no_order():
    torch.manual_seed(0)
    net = FusionNet(7, 10, channels=16, blocks=2, known=5).eval()
    for part in (net.receive, net.revise):  # or earlier taps would not matter before training
        for free in part.parameters():
            torch.nn.init.normal_(free, 0, 0.1)
    net.own_share.data += 0.3
    rng = torch.Generator().manual_seed(1)
    window, pad = torch.randn(2, 9, 4, 4, generator=rng), torch.randn(2, 5, generator=rng)
    poses = torch.randn(2, 3, 5, generator=rng) * torch.tensor([2, 2, 30, 0.3, 1.0])
    poses[:, :, 3:] = poses[:, :, 3:].abs()
    poses[:, 0] = 0

    @torch.inference_mode()
    def pattern_of(window, poses):
        return net(window, pad, poses)[0]

    pattern, alone = pattern_of(window, poses), pattern_of(window[:, :3], poses[:, :1])
    assert not torch.allclose(pattern, alone, atol=1e-3)
    empty = torch.cat([window[:, :3], torch.zeros(2, 6, 4, 4)], dim=1)
    assert torch.equal(pattern_of(empty, poses), alone), "one tap is one tap after training, too"
    order = [0, 2, 1]
    shuffled = window.unflatten(1, (3, 3))[:, order].flatten(1, 2)
    assert torch.allclose(pattern_of(shuffled, poses[:, order]), pattern, atol=1e-6)
    longer = torch.cat([window, torch.zeros(2, 6, 4, 4)], dim=1)
    padded = torch.cat([poses, torch.zeros(2, 2, 5)], dim=1)
    assert torch.allclose(pattern_of(longer, padded), pattern, atol=1e-6)
    turned = torch.rot90(window.unflatten(1, (3, 3)), 1, (-2, -1))
    turned = torch.stack([turned[:, :, 1], -turned[:, :, 0], turned[:, :, 2]], dim=2).flatten(1, 2)
    round_ = poses.clone()
    round_[..., 0], round_[..., 1] = poses[..., 1], -poses[..., 0]
    assert torch.allclose(pattern_of(turned, round_), torch.rot90(pattern, 1, (-2, -1)), atol=1e-5)


def test_every_parameter_has_a_gradient():
    presses = make_press_set(48, taps=4)
    for given in ((1.0, 0, 0, 0), (0, 0, 0, 1.0)):
        net = FusionNet(4, 10, channels=16, blocks=2, known=presses.constants.shape[1] * 2 + 1).train()
        batch = PosedBatches(presses, given, 8, seed=1)(0)
        HeteroscedasticError().loss(net, batch).backward()
        assert all(part.grad is not None for part in net.parameters())


PUBLISHED = {
    "srcnn": (4.36, 6.96),
    "srgan": (4.36, 6.96),
    "stsr": (4.584, 7.32),
    "mtsr2": (4.659, 7.44),
    "mtsr4": (4.811, 7.68),
    "mtsr5": (4.886, 7.81),
    "mtsr7": (5.038, 8.05),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_parameters_and_macs_are_the_published_ones(name):
    millions, giga_macs = PUBLISHED[name]
    net = build(name, 10)
    digits = 2 if name.startswith("sr") else 3
    assert round(sum(one.numel() for one in net.parameters()) / 1e6, digits) == millions
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        net.eval()(window(1, net.taps))
    assert counter.get_total_flops() / 2e9 == pytest.approx(giga_macs, abs=0.007)


@pytest.mark.parametrize(
    ("name", "scale", "said"),
    [
        ("stsr", 0, "at least 1"),
        ("mtsr8", 10, "no network 'mtsr8', expected one of srcnn, .*fusion-mtsr7"),
        ("compact-stsr", 5, "even"),
        ("compact-stsr", 0, "even"),
    ],
)
def test_what_cannot_be_built_is_refused(name, scale, said):
    with pytest.raises(ValueError, match=said):
        build(name, scale)


@pytest.mark.parametrize(
    ("start", "name", "scale", "options"),
    [
        ("stsr", "mtsr3", 3, {}),
        ("mtsr2", "mtsr2", 2, {}),
        ("srcnn", "srgan", 2, {}),
        ("stsr", "stsr", 1, {}),
        ("compact-stsr", "fusion-mtsr4", 10, {"channels": 16, "blocks": 2}),
    ],
)
def test_a_network_grown_from_another_computes_the_same(start, name, scale, options):
    torch.manual_seed(4)
    old = build(start, scale, **options).eval()
    net = grown(old, name, scale, **options).eval()
    given = window(2, net.taps)
    with torch.inference_mode():
        torch.testing.assert_close(net(given), old(given[:, : 3 * old.taps]), rtol=1e-5, atol=1e-6)
        next(net.parameters()).zero_()
    assert next(old.parameters()).abs().max() > 0


def test_at_another_scale_a_compact_network_keeps_its_trunk():
    torch.manual_seed(6)
    old = build("compact-stsr", 4, channels=16, blocks=1)
    net = grown(old, "compact-stsr", 10, channels=16, blocks=1)
    assert net(window(2, 1))[0].shape == (2, 40, 40)
    before = write_out(old).state_dict()
    changed = {key for key, value in write_out(net).state_dict().items() if not torch.equal(value, before[key])}
    assert changed == {f"{end}.{part}" for end in ("leave.2", "uncertainty.2") for part in ("weight", "bias")}


@pytest.mark.parametrize(
    ("start", "name", "options"),
    [
        ("stsr", "srcnn", {}),
        ("mtsr2", "mtsr3", {}),
        ("stsr", "compact-stsr", {}),
        ("small-stsr", "small-stsr", {"channels": 16}),
        ("small-stsr", "small-stsr", {"blocks": 2}),
        ("small-stsr", "small-stsr", {"known": 13}),
    ],
)
def test_weights_that_do_not_fit_are_refused(start, name, options):
    with pytest.raises(ValueError, match=f"{name} at scale 2 cannot start from a (Seed|Compact)Net of"):
        grown(build(start, 2), name, 2, **options)


def test_the_penalty_is_that_of_a_linear_critic():
    # f(x) = w . x has the slope |w| everywhere: the loss is w . (false - true) + 10 (|w| - 1)^2.
    objective = SrganObjective()
    objective.critic = lambda patterns: 0.5 * patterns.sum(dim=(1, 2))
    false, true = torch.rand(2, 6, 8, 8, generator=torch.Generator().manual_seed(1))
    expected = 0.5 * (false - true).sum(dim=(1, 2)).mean() + 10 * (4.0 - 1) ** 2
    assert torch.allclose(objective.critic_loss(false, true), expected, rtol=1e-4)
