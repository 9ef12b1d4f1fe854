"""A pad that is turned or mirrored gives the turned or mirrored pattern, by every layer and by the whole network."""

import pytest
import torch

from train.networks.compact import CompactNet
from train.networks.symmetric import Channels, SymmetricConv2d, fields, scalars, symmetries, vectors, write_out

GROUPS = {"p2": 2, "p4": 4, "p4m": 8}
TOLERANCE = 1e-5


def maps_of(channels: int, side: int = 4, count: int = 3, seed: int = 0):
    return torch.randn(count, channels, side, side, generator=torch.Generator().manual_seed(seed))


def moved(maps, channels: Channels, number: int):
    """Maps (n, channels, H, W) after one of the symmetries: places move, and channels among each other."""
    index, sign = torch.from_numpy(channels.index[number].copy()), torch.from_numpy(channels.sign[number].copy())
    placed = symmetries(channels.group)[number](maps.detach().numpy())
    return torch.from_numpy(placed.copy())[:, index] * sign[:, None, None]


def assert_keeps(layer, enter: Channels, leave: Channels, side=4):
    """The layer of moved maps is the moved layer of the maps."""
    given = maps_of(len(enter), side)
    with torch.inference_mode():
        result = layer(given)
        for number in range(len(enter.index)):
            apart = (layer(moved(given, enter, number)) - moved(result, leave, number)).abs().max()
            assert apart <= TOLERANCE * result.abs().max(), f"symmetry {number}"


def layer_kinds(group):
    return {
        "vectors to fields": (vectors(group, 2) + scalars(group, 3), fields(group, 16)),
        "fields to fields": (fields(group, 16), fields(group, 24)),
        "fields to vectors": (fields(group, 8), vectors(group)),
        "fields to a pixel's parts": (fields(group, 8), scalars(group, 1).shuffled(5)),
        "fields to fields' parts": (fields(group, 8), fields(group, 8).shuffled(2)),
    }


@pytest.mark.parametrize("kernel", [1, 3, 5])
@pytest.mark.parametrize("kind", layer_kinds("p2"))
@pytest.mark.parametrize("group", GROUPS)
def test_a_convolution_keeps_every_symmetry(group, kind, kernel):
    torch.manual_seed(0)
    enter, leave = layer_kinds(group)[kind]
    assert_keeps(SymmetricConv2d(enter, leave, kernel), enter, leave)


def test_x_points_up_after_a_quarter_turn_and_left_in_a_mirror():
    right = torch.zeros(1, 3, 3, 3)
    right[0, 0, 1, 2] = 1  # x at the right edge
    right[0, 2] = 0.5  # z does not turn
    channels = vectors("p4m")
    turned, mirrored = moved(right, channels, 1), moved(right, channels, 4)
    assert turned[0, 1, 0, 1] == -1 and turned[0, :2].abs().sum() == 1, "y points down the rows"
    assert mirrored[0, 0, 1, 0] == -1 and mirrored[0, :2].abs().sum() == 1
    assert (turned[0, 2] == 0.5).all() and (mirrored[0, 2] == 0.5).all()


@pytest.mark.parametrize(("taps", "group"), [(1, "p4m"), (1, "p4"), (4, "p4"), (2, "p2")])
def test_the_whole_network_keeps_every_symmetry(taps, group):
    """Pattern and deviation move as they are, the traction's vectors turn, for any input about the pad."""
    torch.manual_seed(0)
    net = CompactNet(taps, 10, channels=16, blocks=2, known=5, group=group).eval()
    assert_network_keeps(net)
    assert_network_keeps(write_out(net))


def assert_network_keeps(net):
    enter, one, traction = vectors(net.group, net.taps), scalars(net.group, 1), vectors(net.group)
    window, pad = maps_of(len(enter)), torch.randn(3, 5, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        pattern, deviation, pulled = net(window, pad)
        assert pattern.max() > 0 and pulled.abs().max() > 0
        for number in range(GROUPS[net.group]):
            pairs = zip(
                net(moved(window, enter, number), pad),
                (pattern[:, None], deviation[:, None], pulled),
                (one, one, traction),
                strict=True,
            )
            for got, before, channels in pairs:
                expected = moved(before, channels, number).reshape(got.shape)
                assert (got - expected).abs().max() <= TOLERANCE * before.abs().max()
