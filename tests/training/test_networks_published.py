import pytest
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from train.data.press_batches import Batch
from train.networks.named_networks import build, grown
from train.networks.published import SrganObjective
from train.networks.symmetric import write_out

PUBLISHED = {
    "srcnn": (4.36, 6.96),
    "srgan": (4.36, 6.96),
    "stsr": (4.584, 7.32),
    "mtsr2": (4.659, 7.44),
    "mtsr4": (4.811, 7.68),
    "mtsr5": (4.886, 7.81),
    "mtsr7": (5.038, 8.05),
}


def window(taps, count=2):
    return torch.randn(count, 3 * taps, 4, 4, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("name", PUBLISHED)
def test_parameters_and_macs_are_the_published_ones(name):
    millions, giga_macs = PUBLISHED[name]
    net = build(name, 10)
    digits = 2 if name.startswith("sr") else 3
    assert round(sum(one.numel() for one in net.parameters()) / 1e6, digits) == millions
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        net.eval()(window(net.taps, 1))
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
    ("start", "name", "scale"),
    [("stsr", "mtsr3", 3), ("mtsr2", "mtsr2", 2), ("srcnn", "srgan", 2), ("stsr", "stsr", 1)],
)
def test_a_network_grown_from_another_computes_the_same(start, name, scale):
    torch.manual_seed(4)
    old = build(start, scale).eval()
    net = grown(old, name, scale).eval()
    given = window(net.taps)
    with torch.inference_mode():
        assert torch.allclose(net(given), old(given[:, : 3 * old.taps]), atol=1e-6)
        next(net.parameters()).zero_()
    assert next(old.parameters()).abs().max() > 0


def test_at_another_scale_a_compact_network_keeps_its_trunk():
    torch.manual_seed(6)
    old = build("compact-stsr", 4, channels=16, blocks=1)
    net = grown(old, "compact-stsr", 10, channels=16, blocks=1)
    assert net(window(1))[0].shape == (2, 40, 40)
    before = write_out(old).state_dict()
    changed = {key for key, value in write_out(net).state_dict().items() if not torch.equal(value, before[key])}
    assert changed == {f"{end}.{part}" for end in ("leave.2", "uncertainty.2") for part in ("weight", "bias")}


@pytest.mark.parametrize(("start", "name"), [("stsr", "srcnn"), ("mtsr2", "mtsr3"), ("stsr", "compact-stsr")])
def test_weights_that_do_not_fit_are_refused(start, name):
    with pytest.raises(ValueError, match=f"{name} at scale 2 cannot start from a SeedNet of"):
        grown(build(start, 2), name, 2)


class Plain(nn.Module):
    """A generator of one number."""

    taps = 1

    def __init__(self, value=0.1):
        super().__init__()
        self.value = nn.Parameter(torch.tensor(value))

    def forward(self, window):
        return self.value.expand(len(window), 8, 8)


def patterns(count=6, seed=0):
    return 0.01 + 0.3 * torch.rand(count, 8, 8, generator=torch.Generator().manual_seed(seed))


def test_the_penalty_is_that_of_a_linear_critic():
    # f(x) = w . x has the slope |w| everywhere: the loss is w . (false - true) + 10 (|w| - 1)^2.
    class Linear(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.full((8, 8), 0.5))

        def forward(self, x):
            return (x * self.weight).sum(dim=(1, 2))

    objective = SrganObjective()
    objective.critic = Linear()  # type: ignore[assignment]
    false, true = patterns(seed=1), patterns(seed=2)
    expected = 0.5 * (false - true).sum(dim=(1, 2)).mean() + 10 * (4.0 - 1) ** 2
    assert torch.allclose(objective.critic_loss(false, true), expected, rtol=1e-4)


def test_a_run_cut_short_goes_on_as_if_it_were_not(tmp_path):
    def train(objective, seeds):
        for seed in seeds:
            objective.loss(Plain(), Batch(torch.zeros(6, 3, 4, 4), patterns(seed=seed)))
            objective.after_step()
        return objective

    whole = train(SrganObjective(seed=3), range(4))
    torch.save(train(SrganObjective(seed=3), range(2)).state_dict(), tmp_path / "objective.pt")
    resumed = SrganObjective(seed=8)
    resumed.load_state_dict(torch.load(tmp_path / "objective.pt", weights_only=True))
    train(resumed, range(2, 4))
    ours, theirs = resumed.critic.state_dict(), whole.critic.state_dict()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
