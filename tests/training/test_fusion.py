"""Network that fuses taps from any poses: one tap is a network of one tap, and the geometry is exact."""

import pytest
import torch
from press_samples import make_press_set

from train.data.press_batches import PosedBatches
from train.networks.compact import CompactNet, HeteroscedasticError
from train.networks.fusion import FusionNet
from train.networks.named_networks import grown

KNOWN = 5
REACHES = (torch.tensor(0.1), torch.tensor(0.1))


@pytest.fixture(scope="module")
def net():
    """Small network whose earlier taps matter."""
    torch.manual_seed(0)
    net = FusionNet(7, 10, channels=16, blocks=2, known=KNOWN).eval()
    for part in (net.receive, net.revise):
        for free in part.parameters():
            torch.nn.init.normal_(free, 0, 0.1)
    net.own_share.data += 0.3
    return net


@pytest.fixture(scope="module")
def inputs():
    rng = torch.Generator().manual_seed(1)
    window, pad = torch.randn(2, 9, 4, 4, generator=rng), torch.randn(2, KNOWN, generator=rng)
    poses = torch.randn(2, 3, 5, generator=rng) * torch.tensor([2, 2, 30, 0.3, 1.0])
    poses[:, :, 3:] = poses[:, :, 3:].abs()
    poses[:, 0] = 0
    return window, pad, poses


def run(net, *inputs):
    with torch.inference_mode():
        return net(*inputs)


def test_one_tap_is_the_network_of_one_tap_it_started_from(inputs):
    torch.manual_seed(3)
    one = CompactNet(1, 10, channels=16, blocks=2, known=KNOWN).eval()
    fused = grown(one, "fusion-mtsr4", 10, channels=16, blocks=2, known=KNOWN).eval()
    window, pad, _ = inputs
    for ours, theirs in zip(run(fused, window[:, :3], pad), run(one, window[:, :3], pad), strict=True):
        assert torch.equal(ours, theirs)


def test_after_training_one_tap_is_still_one_tap(net, inputs):
    window, pad, poses = inputs
    alone = run(net, window[:, :3], pad, poses[:, :1])[0]
    empty = torch.cat([window[:, :3], torch.zeros(2, 6, 4, 4)], dim=1)
    assert torch.equal(run(net, empty, pad, poses)[0], alone)
    assert not torch.allclose(run(net, window, pad, poses)[0], alone, atol=1e-3)


def test_a_quarter_turn_of_everything_turns_the_pattern(net, inputs):
    window, pad, poses = inputs
    turned = torch.rot90(window.unflatten(1, (3, 3)), 1, (-2, -1))
    turned = torch.stack([turned[:, :, 1], -turned[:, :, 0], turned[:, :, 2]], dim=2).flatten(1, 2)
    round_ = poses.clone()
    round_[..., 0], round_[..., 1] = poses[..., 1], -poses[..., 0]
    expected = torch.rot90(run(net, window, pad, poses)[0], 1, (-2, -1))
    assert torch.allclose(run(net, turned, pad, round_)[0], expected, atol=1e-5)


def test_order_and_absence_of_earlier_taps_change_nothing(net, inputs):
    window, pad, poses = inputs
    pattern = run(net, window, pad, poses)[0]
    order = [0, 2, 1]
    shuffled = window.unflatten(1, (3, 3))[:, order].flatten(1, 2)
    assert torch.allclose(run(net, shuffled, pad, poses[:, order])[0], pattern, atol=1e-6)
    longer = torch.cat([window, torch.zeros(2, 6, 4, 4)], dim=1)
    padded = torch.cat([poses, torch.zeros(2, 2, 5)], dim=1)
    assert torch.allclose(run(net, longer, pad, padded)[0], pattern, atol=1e-6)


def test_without_poses_the_schedule_of_the_paper_is_assumed(net, inputs):
    window, pad, _ = inputs
    poses = torch.zeros(2, 3, 5)
    poses[:, 1:, 2] = torch.tensor([5.0, 10.0])
    poses[:, 1:, 3], poses[:, 1:, 4] = 0.2, 1.0
    assert torch.equal(run(net, window, pad)[0], run(net, window, pad, poses)[0])


def test_every_parameter_has_a_gradient():
    presses = make_press_set(48, taps=4)
    for given in ((1.0, 0, 0, 0), (0, 0, 0, 1.0)):
        net = FusionNet(4, 10, channels=16, blocks=2, known=presses.constants.shape[1] * 2 + 1).train()
        batch = PosedBatches(presses, given, 8, seed=1)(0)
        HeteroscedasticError().loss(net, batch).backward()
        assert all(part.grad is not None for part in net.parameters())
