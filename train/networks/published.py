"""The published networks, to compare with: TactileSRCNN, TactileSRGAN, STSR and MTSR-K.

STSR and MTSR-K: Wu and Liu 2024, Section V and Fig. 8; channels and biases follow from the parameter counts of the
authors' code. TactileSRCNN: Wu, Liu and Zhang 2022, with three 3 x 3 convolutions before the blocks, which make the
parameters and MACs of the later paper's table; the 2022 code has one.

TactileSRGAN is TactileSRCNN trained against a discriminator. From the authors' code: a Wasserstein loss with gradient
penalty 10, two steps of the discriminator to one of the generator, 0.001 of the adversarial loss added to the error.
Chosen here: the discriminator's layers, which score patches and take any scale, without batch normalisation; and its
input, patterns relative to their truth's size.
"""

from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from train.data.press_batches import Batch
from train.networks.blocks import Objective, PatternNet, Residual, relative_error, truth_size
from train.surfaces.poses import MAX_TAPS

WIDTH: Final = 64
BLOCKS: Final = 6
_NORM_START: Final = 0.1  # initial scale and shift of batch normalisation, as in the authors' code
_CRITIC_CHANNELS: Final = (32, 64, 128)
_SLOPE: Final = 0.2
_ADVERSARIAL_SHARE: Final = 1e-3  # of the discriminator's score in the loss of the generator


class _PublishedNet(PatternNet):
    """Network whose layers all work at the pattern's size; ValueError if taps or scale are out of range."""

    def __init__(self, taps: int, scale: int) -> None:
        super().__init__()
        if not 1 <= taps <= MAX_TAPS:
            raise ValueError(f"{taps} taps asked for, expected 1 to {MAX_TAPS}")
        if scale < 1:
            raise ValueError(f"scale is {scale}, expected at least 1")
        self.taps, self.scale = taps, scale

    def _initialise(self) -> None:
        """Initialise the weights. Source: He et al. 2015, normal, by fan-out."""
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
            elif isinstance(module, nn.BatchNorm2d):
                nn.init.constant_(module.weight, _NORM_START)
                nn.init.constant_(module.bias, _NORM_START)

    def _upsampled(self, window: Tensor) -> Tensor:
        return F.interpolate(window, scale_factor=self.scale, mode="bilinear", align_corners=False)

    def _pattern(self, output: Tensor) -> Tensor:
        """Convert the last convolution, (n, 1, H, W), to patterns (n, H, W) in [mm], cut at zero in evaluation."""
        # The networks were made for patterns of up to 25, those here reach 0.5 mm.
        pattern = output[:, 0].float() * 0.02
        # Cut in training too, as published, 3 of 16 seeds tried would never learn.
        return pattern if self.training else torch.relu(pattern)


class SeedNet(_PublishedNet):
    """Network from a window of K taps to a pattern: STSR with one tap, MTSR-K with more.

    The newest tap also passes a branch without batch normalisation, which would remove the force.
    """

    def __init__(self, taps: int, scale: int) -> None:
        super().__init__(taps, scale)
        self.stems = nn.ModuleList(nn.Sequential(_normed(3, WIDTH), _normed(WIDTH)) for _ in range(taps))
        self.merge = _normed(taps * WIDTH, WIDTH)
        self.trunk = nn.Sequential(*(_MultiScaleResidual(WIDTH) for _ in range(BLOCKS)))
        self.force = nn.Sequential(_plain(3, WIDTH), nn.ReLU(), Residual(lambda: _plain(WIDTH, bias=True)))
        self.leave = nn.Sequential(_plain(2 * WIDTH), nn.ReLU(), _plain(2 * WIDTH, 1))
        self._initialise()

    def forward(self, window: Tensor) -> Tensor:
        """Return patterns (n, H, W) in [mm] of windows (n, 3K, rows, cols) in network units, newest tap first."""
        taps = self._upsampled(window).split(3, dim=1)
        shapes = [stem(tap) for stem, tap in zip(self.stems, taps, strict=True)]
        pattern = self.trunk(self.merge(torch.cat(shapes, dim=1)))
        return self._pattern(self.leave(torch.cat([self.force(taps[0]), pattern], dim=1)))

    def take_over(self, start: PatternNet) -> None:
        """Copy another network's weights; after an STSR's an MTSR-K computes the same until it is trained."""
        state = dict(start.state_dict())
        if isinstance(start, SeedNet) and start.taps == 1:
            stem = {name: value for name, value in state.items() if name.startswith("stems.0.")}
            for tap in range(1, self.taps):
                state |= {name.replace("stems.0.", f"stems.{tap}."): value for name, value in stem.items()}
            newest = state["merge.0.weight"]  # in this layer the earlier taps begin with zeros
            state["merge.0.weight"] = torch.cat([newest, *[torch.zeros_like(newest)] * (self.taps - 1)], dim=1)
        self.load_state_dict(state)


class TactileSRCNN(_PublishedNet):
    """Network from a window of one tap to a pattern, with batch normalisation throughout."""

    def __init__(self, scale: int) -> None:
        super().__init__(1, scale)
        self.net = nn.Sequential(
            *(_normed(3, WIDTH), _normed(WIDTH), _normed(WIDTH)),
            *(_MultiScaleResidual(WIDTH) for _ in range(BLOCKS)),
            _plain(WIDTH, 1),
        )
        self._initialise()

    def forward(self, window: Tensor) -> Tensor:
        """Return patterns (n, H, W) in [mm] of windows (n, 3, rows, cols) in network units."""
        return self._pattern(self.net(self._upsampled(window)))


class TactileSRGAN(TactileSRCNN):
    """Generator: TactileSRCNN with another training."""


class _MultiScaleResidual(nn.Module):
    """3 x 3 and 5 x 5 paths, exchanged half-way, fused by a 1 x 1 convolution parallel to an identity path.

    Source: Li et al. 2018 (MSRN), Fig. 2, with batch normalisation after each convolution as in Wu and Liu 2024.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fine = _normed(channels, bias=True)
        self.coarse = _normed(channels, kernel=5, bias=True)
        self.fine_of_both = _normed(2 * channels, bias=True)
        self.coarse_of_both = _normed(2 * channels, kernel=5, bias=True)
        self.fuse = nn.Conv2d(4 * channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        both = torch.cat([self.fine(x), self.coarse(x)], dim=1)
        both = torch.cat([self.fine_of_both(both), self.coarse_of_both(both)], dim=1)
        return torch.relu(x + self.fuse(both))


def _plain(inputs: int, outputs: int | None = None, kernel: int = 3, *, bias: bool = False) -> nn.Conv2d:
    """Build a convolution that keeps the size, and without `outputs` the number of channels."""
    return nn.Conv2d(inputs, inputs if outputs is None else outputs, kernel, padding=kernel // 2, bias=bias)


def _normed(inputs: int, outputs: int | None = None, kernel: int = 3, *, bias: bool = False) -> nn.Sequential:
    """Build a convolution, batch normalisation, and ReLU; the authors' blocks have a bias although it is redundant."""
    convolution = _plain(inputs, outputs, kernel, bias=bias)
    return nn.Sequential(convolution, nn.BatchNorm2d(convolution.out_channels), nn.ReLU())


class Discriminator(nn.Module):
    """A score without unit, higher for patterns that look more like true ones."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs in zip((1, *_CRITIC_CHANNELS), _CRITIC_CHANNELS, strict=False):
            layers += [_plain(inputs, outputs, bias=True), nn.LeakyReLU(_SLOPE)]
            layers += [nn.Conv2d(outputs, outputs, 3, stride=2, padding=1), nn.LeakyReLU(_SLOPE)]
        self.net = nn.Sequential(*layers, nn.Conv2d(_CRITIC_CHANNELS[-1], 1, 1))

    def forward(self, patterns: Tensor) -> Tensor:
        """Return the score (n,), the mean over patches of patterns (n, H, W)."""
        return self.net(patterns[:, None]).mean(dim=(1, 2, 3))


class SrganObjective(Objective):
    """Error of the patterns, less a share of the score of a discriminator that is trained alongside.

    Source: Gulrajani et al. 2017, Algorithm 1.
    """

    def __init__(self, device: torch.device | str = "cpu", seed: int = 0) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.critic = Discriminator().to(device)
        self._optimizer = torch.optim.Adam(self.critic.parameters(), lr=1e-4, betas=(0.0, 0.9))
        self._rng = torch.Generator().manual_seed(seed)
        self._seen: tuple[Tensor, Tensor] | None = None

    def loss(self, net: nn.Module, batch: Batch) -> Tensor:
        """Return the relative error, less a share of the discriminator's score of the patterns."""
        patterns, truth = net(batch.window).float(), batch.pattern
        size = truth_size(truth)
        self._seen = (patterns.detach() / size, truth / size)
        self.critic.requires_grad_(False)
        return relative_error(patterns, truth) - _ADVERSARIAL_SHARE * self.critic(patterns / size).mean()

    def after_step(self) -> None:
        """Train the discriminator on the last batch of `loss`."""
        if self._seen is None:
            return
        self.critic.requires_grad_(True)
        for _ in range(2):
            self._optimizer.zero_grad()
            self.critic_loss(*self._seen).backward()
            self._optimizer.step()
        self._seen = None

    def critic_loss(self, false: Tensor, true: Tensor) -> Tensor:
        """Return the loss of the discriminator, from patterns (n, H, W) relative to their truth's size."""
        mix = torch.rand(len(true), 1, 1, generator=self._rng).to(true.device)
        between = (mix * true + (1 - mix) * false).requires_grad_(True)
        (slope,) = torch.autograd.grad(self.critic(between).sum(), between, create_graph=True)
        steepness = (slope.square().sum(dim=(1, 2)) + 1e-12).sqrt()  # keeps the slope of the root finite at 0
        penalty = (steepness - 1).square().mean()
        return self.critic(false).mean() - self.critic(true).mean() + 10.0 * penalty

    def state_dict(self) -> dict[str, Any]:
        """Return the states of the discriminator, its optimizer, and the random draws."""
        states = {"critic": self.critic.state_dict(), "optimizer": self._optimizer.state_dict()}
        return states | {"rng": self._rng.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state."""
        self.critic.load_state_dict(state["critic"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._rng.set_state(state["rng"].cpu())
