"""The published networks, to compare with: TactileSRCNN, TactileSRGAN, STSR and MTSR-K.

STSR and MTSR-K: Wu and Liu 2024, Section V and Fig. 8; channels and biases follow from the parameter counts of the
authors' code.

TactileSRCNN, their predecessor with one tap and no force branch: Wu, Liu and Zhang 2022 ([20] of Wu and Liu 2024).
Parameters (4.36 M) and MACs (6.96 G at 40 x 40) of the later paper's table are those of three 3 x 3 convolutions, six
multi-scale blocks and a last convolution; the 2022 code has a single convolution before the blocks, which would be
4.29 M.

TactileSRGAN is TactileSRCNN trained against a discriminator. The paper states only the name, and that the generator is
TactileSRCNN's. From the authors' code: a Wasserstein loss with gradient penalty 10, two steps of the discriminator to
one of the generator, 0.001 of the adversarial loss added to the error. Chosen here: the discriminator's layers, which
follow SRGAN's but score patches and take any scale; no batch normalisation in it, since the penalty is of one pattern
at a time (Gulrajani et al. 2017, Section 4); and its input, patterns relative to their truth's size, as in the error.
"""

from typing import Any, Final

import torch
from torch import Tensor, distributed, nn

from train.data.press_batches import Batch
from train.networks.blocks import (
    MultiScaleResidual,
    PatternNet,
    Residual,
    initialise,
    normed_conv,
    relative_error,
    to_pattern,
    truth_size,
    upsample,
)

CHANNELS: Final = 64
BLOCKS: Final = 6
MAX_TAPS: Final = 7
_CRITIC_CHANNELS: Final = (32, 64, 128)
_SLOPE: Final = 0.2
_PENALTY: Final = 10.0
"""Weight of the discriminator's gradient penalty."""
_CRITIC_STEPS: Final = 2
"""Steps of the discriminator to one of the network."""
_TINY: Final = 1e-12


class SeedNet(PatternNet):
    """Network from a window of K taps to a pattern: STSR with one tap, MTSR-K with more.

    All layers work at the pattern's size. Taps are interpolated, each passes its stem, and they are merged; the newest
    tap also passes a branch without batch normalisation, which would remove the force.

    Raises:
        ValueError: taps or scale out of range.
    """

    def __init__(self, taps: int, scale: int) -> None:
        super().__init__()
        if not 1 <= taps <= MAX_TAPS:
            raise ValueError(f"{taps} taps asked for, expected 1 to {MAX_TAPS}")
        if scale < 1:
            raise ValueError(f"scale is {scale}, expected at least 1")
        self.taps, self.scale = taps, scale
        self.stems = nn.ModuleList(
            nn.Sequential(normed_conv(3, CHANNELS, 3), normed_conv(CHANNELS, CHANNELS, 3)) for _ in range(taps)
        )
        self.merge = normed_conv(taps * CHANNELS, CHANNELS, 3)
        self.trunk = nn.Sequential(*(MultiScaleResidual(CHANNELS) for _ in range(BLOCKS)))
        self.force = nn.Sequential(nn.Conv2d(3, CHANNELS, 3, padding=1, bias=False), nn.ReLU(), Residual(CHANNELS))
        self.leave = nn.Sequential(
            nn.Conv2d(2 * CHANNELS, 2 * CHANNELS, 3, padding=1, bias=False),
            nn.ReLU(),
            nn.Conv2d(2 * CHANNELS, 1, 3, padding=1, bias=False),
        )
        initialise(self)

    def forward(self, window: Tensor) -> Tensor:
        """Return patterns (n, H, W) in [mm] of windows (n, 3K, rows, cols) in network units, newest tap first."""
        taps = upsample(window, self.scale).split(3, dim=1)
        shapes = [stem(tap) for stem, tap in zip(self.stems, taps, strict=True)]
        pattern = self.trunk(self.merge(torch.cat(shapes, dim=1)))
        force = self.force(taps[0])
        return to_pattern(self.leave(torch.cat([force, pattern], dim=1)), training=self.training)

    @classmethod
    def from_stsr(cls, stsr: "SeedNet", taps: int) -> "SeedNet":
        """Return an MTSR-K that computes the same as an STSR until it is trained.

        Every stem starts as the STSR's. In the merging layer the earlier taps have zero weights: these weights learn
        from the first step on, the stems before them from the second.

        Raises:
            ValueError: `stsr` takes more than one tap, or `taps` is out of range.
        """
        if stsr.taps != 1:
            raise ValueError(f"the network to start from takes {stsr.taps} taps, expected an STSR")
        net = cls(taps, stsr.scale)
        state = {name: value.clone() for name, value in stsr.state_dict().items()}
        stem = {name: value for name, value in state.items() if name.startswith("stems.0.")}
        for tap in range(1, taps):
            state |= {name.replace("stems.0.", f"stems.{tap}."): value.clone() for name, value in stem.items()}
        newest = state["merge.0.weight"]
        state["merge.0.weight"] = torch.cat([newest, *[torch.zeros_like(newest)] * (taps - 1)], dim=1)
        net.load_state_dict(state)
        return net


class TactileSRCNN(PatternNet):
    """Network from a window of one tap to a pattern, with batch normalisation throughout.

    Raises:
        ValueError: scale is not positive.
    """

    def __init__(self, scale: int) -> None:
        super().__init__()
        if scale < 1:
            raise ValueError(f"scale is {scale}, expected at least 1")
        self.taps, self.scale = 1, scale
        self.net = nn.Sequential(
            normed_conv(3, CHANNELS, 3),
            normed_conv(CHANNELS, CHANNELS, 3),
            normed_conv(CHANNELS, CHANNELS, 3),
            *(MultiScaleResidual(CHANNELS) for _ in range(BLOCKS)),
            nn.Conv2d(CHANNELS, 1, 3, padding=1, bias=False),
        )
        initialise(self)

    def forward(self, window: Tensor) -> Tensor:
        """Return patterns (n, H, W) in [mm] of windows (n, 3, rows, cols) in network units."""
        return to_pattern(self.net(upsample(window, self.scale)), training=self.training)


class TactileSRGAN(TactileSRCNN):
    """Generator: TactileSRCNN with another training."""


class Discriminator(nn.Module):
    """Discriminator: a score without unit, higher for patterns that look more like true ones."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs in zip((1, *_CRITIC_CHANNELS), _CRITIC_CHANNELS, strict=False):
            layers += [
                nn.Conv2d(inputs, outputs, 3, padding=1),
                nn.LeakyReLU(_SLOPE),
                nn.Conv2d(outputs, outputs, 3, stride=2, padding=1),
                nn.LeakyReLU(_SLOPE),
            ]
        self.net = nn.Sequential(*layers, nn.Conv2d(_CRITIC_CHANNELS[-1], 1, 1))

    def forward(self, patterns: Tensor) -> Tensor:
        """Return the score (n,), the mean over patches of patterns (n, H, W)."""
        return self.net(patterns[:, None]).mean(dim=(1, 2, 3))


class SrganObjective:
    """Error of the patterns, less the score of a discriminator that is trained alongside.

    Args:
        device: of the network.
        adversarial_share: weight of the discriminator's score relative to the error.
        learning_rate: of the discriminator's Adam.
        seed: of the discriminator's weights and of the points where the penalty is evaluated.

    Source: Gulrajani et al. 2017, Algorithm 1.
    """

    def __init__(
        self,
        device: torch.device | str = "cpu",
        adversarial_share: float = 1e-3,
        learning_rate: float = 1e-4,
        seed: int = 0,
    ) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.critic = Discriminator().to(device)
        self._optimizer = torch.optim.Adam(self.critic.parameters(), lr=learning_rate, betas=(0.0, 0.9))
        self._adversarial_share = adversarial_share
        self._rng = torch.Generator().manual_seed(seed)
        self._seen: tuple[Tensor, Tensor] | None = None

    def loss(self, net: nn.Module, batch: Batch) -> Tensor:
        """Return the relative error, less a share of the discriminator's score of the patterns."""
        patterns, truth = net(batch.window).float(), batch.pattern
        size = truth_size(truth)
        self._seen = (patterns.detach() / size, truth / size)
        self.critic.requires_grad_(False)
        return relative_error(patterns, truth) - self._adversarial_share * self.critic(patterns / size).mean()

    def after_step(self) -> None:
        """Train the discriminator on the last batch of `loss`."""
        if self._seen is None:
            return
        self.critic.requires_grad_(True)
        for _ in range(_CRITIC_STEPS):
            self._optimizer.zero_grad()
            self.critic_loss(*self._seen).backward()
            _average_gradients(self.critic)
            self._optimizer.step()
        self._seen = None

    def critic_loss(self, false: Tensor, true: Tensor) -> Tensor:
        """Return the loss of the discriminator, from patterns (n, H, W) relative to their truth's size."""
        mix = torch.rand(len(true), 1, 1, generator=self._rng).to(true.device)
        between = (mix * true + (1 - mix) * false).requires_grad_(True)
        (slope,) = torch.autograd.grad(self.critic(between).sum(), between, create_graph=True)
        steepness = (slope.square().sum(dim=(1, 2)) + _TINY).sqrt()  # keeps the slope of the root finite at 0
        penalty = (steepness - 1).square().mean()
        return self.critic(false).mean() - self.critic(true).mean() + _PENALTY * penalty

    def state_dict(self) -> dict[str, Any]:
        """Return the states of the discriminator, its optimizer, and the random draws."""
        return {
            "critic": self.critic.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "rng": self._rng.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state."""
        self.critic.load_state_dict(state["critic"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._rng.set_state(state["rng"].cpu())


def _average_gradients(net: nn.Module) -> None:
    """Average gradients over the processes of a run, because DDP does not support the gradient of a gradient."""
    if not distributed.is_initialized():
        return
    for parameter in net.parameters():
        if parameter.grad is not None:
            distributed.all_reduce(parameter.grad)
            parameter.grad /= distributed.get_world_size()
