import copy

import pytest
import torch
from torch import nn

from train.data.batch import Batch
from train.networks.losses import relative_error
from train.networks.srgan import Discriminator, SrganObjective, TactileSRGAN


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


def test_the_discriminator_takes_patterns_of_any_size_one_by_one():
    torch.manual_seed(0)
    critic = Discriminator()
    for size in (16, 24, 40, 80):
        given = torch.rand(3, size, size)
        assert critic(given).shape == (3,)
        assert torch.allclose(critic(given)[1], critic(given[1:2])[0], atol=1e-6)


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


def test_a_flat_critic_has_a_finite_gradient():
    objective = SrganObjective()
    with torch.no_grad():
        for parameter in objective.critic.parameters():
            parameter.zero_()
    objective.critic_loss(patterns(seed=1), patterns(seed=2)).backward()
    assert all(torch.isfinite(p.grad).all() for p in objective.critic.parameters() if p.grad is not None)


def test_the_critic_learns_to_tell_and_the_network_feels_it():
    objective, net, window = SrganObjective(learning_rate=1e-3), Plain(), torch.zeros(6, 3, 4, 4)
    truth = patterns()
    size = truth.square().mean(dim=(1, 2), keepdim=True).sqrt()

    def lead():
        with torch.inference_mode():
            false = net(window) / size
            return float((objective.critic(truth / size) - objective.critic(false)).mean())

    before = lead()
    for _ in range(40):
        objective.loss(net, Batch(window, truth))
        objective.after_step()
    assert lead() > before + 0.1


def test_the_loss_is_the_error_less_a_share_of_the_critics_view():
    truth, window, net = patterns(), torch.zeros(6, 3, 4, 4), Plain()
    plain = SrganObjective(adversarial_share=0.0).loss(net, Batch(window, truth))
    assert torch.allclose(plain, relative_error(net(window), truth))
    objective = SrganObjective(adversarial_share=0.5)
    size = truth.square().mean(dim=(1, 2), keepdim=True).sqrt()
    expected = plain - 0.5 * objective.critic(net(window) / size).mean()
    assert torch.allclose(objective.loss(net, Batch(window, truth)), expected)


def test_network_and_critic_keep_out_of_each_others_weights():
    objective, net = SrganObjective(), Plain()
    critic = copy.deepcopy(objective.critic.state_dict())
    objective.loss(net, Batch(torch.zeros(6, 3, 4, 4), patterns())).backward()
    assert net.value.grad is not None
    assert all(p.grad is None for p in objective.critic.parameters())
    gradient = net.value.grad.clone()
    objective.after_step()
    assert torch.equal(net.value.grad, gradient)
    assert not all(torch.equal(value, critic[name]) for name, value in objective.critic.state_dict().items())


def test_nothing_is_learnt_twice_from_one_batch():
    objective = SrganObjective()
    objective.loss(Plain(), Batch(torch.zeros(6, 3, 4, 4), patterns()))
    objective.after_step()
    once = copy.deepcopy(objective.critic.state_dict())
    objective.after_step()
    assert all(torch.equal(value, once[name]) for name, value in objective.critic.state_dict().items())


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


def test_making_one_does_not_disturb_the_draws_of_others():
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    SrganObjective(seed=1)
    assert torch.equal(torch.rand(3), expected)


def test_the_generator_trains_under_low_precision():
    torch.manual_seed(6)
    net, objective = TactileSRGAN(2).train(), SrganObjective()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss = objective.loss(net, Batch(torch.randn(2, 3, 4, 4), patterns(2)))
    loss.backward()
    objective.after_step()
    assert torch.isfinite(loss)
    assert all(torch.isfinite(p).all() for p in objective.critic.parameters())


def test_patterns_of_light_and_firm_contacts_look_the_same_to_the_critic():
    objective, truth = SrganObjective(adversarial_share=1.0), patterns()
    firm = objective.loss(Plain(0.1), Batch(torch.zeros(6, 3, 4, 4), truth))
    light = objective.loss(Plain(0.001), Batch(torch.zeros(6, 3, 4, 4), truth / 100))
    assert float(firm) == pytest.approx(float(light), rel=1e-4)
