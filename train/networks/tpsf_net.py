"""The tactile PSF learned from taps: a network estimates alpha, beta and gamma from a scan.

Depth and PSF give the HR pattern, the pattern degraded to the taxels gives the scan's z again, and the difference
trains the network: no HR truth is needed. Alpha has the scan's unit per area, since only the product of alpha and the
taxels' sensitivity is visible in a scan. k_scale, one constant per sensor, converts that into [mm]; where indentations
are available it is the least-squares factor from the plateaus to them.

Source: Wu and Liu 2024, Section IV-C, Eq. 4-10 and Fig. 4.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from train.physics.tpsf import Kernel, Plateau, tpsf

Gamma = Literal["sensor", "sample"]
Form = Literal["paper", "code"]
COUNTS_PER_UNIT: Final = 100.0
"""Counts per unit of the network's input and loss."""
_WIDTHS: Final = (256, 1024, 256)
_SMALLEST: Final = 1e-6
"""Least length: softplus of a very negative number is 0, and the lengths are divisors."""
_GAMMA_START: Final = 0.8
_RATE: Final = 1e-3
"""Learning rate of Adam; it falls to nothing on a half cosine."""
_GAMMA_HASTE: Final = 20.0
"""Learning rate of the single gamma over the network's.

At the same rate it stays at its initial value, because a thousand weights of alpha and beta compensate for it.
"""


@dataclass(frozen=True, slots=True)
class PsfParameters:
    """Parameters that the network estimates from n scans.

    Attributes:
        alpha: (n,) intensity, >= 0, in [counts / 100 / mm^4]: a taxel weighs its pattern over an area, and the
            pattern the depth over another.
        beta_mm: (n,) reach of the PSF, > 0, in [mm].
        gamma: () or (n,) perceptual region of a taxel, > 0; in [mm^0.5] for form "paper", [mm^2] for "code".
    """

    alpha: Tensor
    beta_mm: Tensor
    gamma: Tensor


class PsfNet(nn.Module):
    """Network from a scan to alpha, beta, gamma: 48 -> 256 -> 1024 -> 256 -> 3, ReLU, softplus.

    Args:
        geometry: the taxels.
        kernel: form of the PSF, see `train.physics.tpsf.spread`.
        plateau: see `train.physics.tpsf.tpsf`.
        gamma: "sensor": one number, trained with the network (whose last layer then has two outputs); "sample":
            estimated from every scan.
        form: of the degradation, see `degrade`.

    Attributes:
        k_scale: (), the constant of Eq. 5, in [mm] of pattern per [counts / 100 / mm^2]; 1 until `set_k_scale`.
    """

    k_scale: Tensor

    def __init__(
        self,
        geometry: SensorGeometry = USPA44,
        kernel: Kernel = "gaussian",
        plateau: Plateau = "response",
        gamma: Gamma = "sensor",
        form: Form = "paper",
    ) -> None:
        super().__init__()
        if gamma not in get_args(Gamma):
            raise ValueError(f"gamma {gamma!r}, expected {' or '.join(map(repr, get_args(Gamma)))}")
        self.geometry = geometry
        self.kernel: Kernel = kernel
        self.plateau: Plateau = plateau
        self.form: Form = form
        self.layers = nn.Sequential()
        width = 3 * geometry.taxel_count
        for wider in _WIDTHS:
            self.layers.extend([nn.Linear(width, wider), nn.ReLU()])
            width = wider
        self.layers.append(nn.Linear(width, 3 if gamma == "sample" else 2))
        start = float(np.log(np.expm1(_GAMMA_START)))
        self.gamma = nn.Parameter(torch.tensor(start)) if gamma == "sensor" else None
        self.register_buffer("k_scale", torch.tensor(1.0))

    def forward(self, counts: Tensor) -> PsfParameters:
        """Return the parameters of scans (n, 3, rows, cols) in zeroed counts."""
        raw = self.layers(counts.flatten(1) / COUNTS_PER_UNIT)
        raw_gamma = raw[:, 2] if self.gamma is None else self.gamma
        alpha, beta_mm, gamma = (nn.functional.softplus(value) for value in (raw[:, 0], raw[:, 1], raw_gamma))
        return PsfParameters(alpha, beta_mm + _SMALLEST, gamma + _SMALLEST)

    def pattern(self, read: PsfParameters, depth: Tensor) -> Tensor:
        """Return HR patterns (n, H, W) of depth images (n, H, W) in 0..1; in [mm] once k_scale is set.

        Source: Wu and Liu 2024, Eq. 5-6.
        """
        pixel_mm = self.geometry.pitch_mm * self.geometry.rows / depth.shape[1]
        return self.k_scale * tpsf(depth, read.alpha, read.beta_mm, pixel_mm, self.kernel, self.plateau)

    def degraded(self, read: PsfParameters, depth: Tensor) -> Tensor:
        """Return the z readings (n, rows, cols) of the patterns, in [counts / 100]."""
        pattern = self.pattern(read, depth) / self.k_scale
        return degrade(pattern, read.gamma, self.geometry, self.form)

    def loss(self, counts: Tensor, depth: Tensor) -> Tensor:
        """Return the squared error of the z readings, summed over the taxels, mean over the scans.

        Only the positive part of a reading counts. Next to a contact the pad bulges and z is negative; the model cannot
        reproduce that, and in fitting it beta would vanish.

        Source: Wu and Liu 2024, Eq. 9-10.
        """
        error = self.degraded(self(counts), depth) - pressed(counts)
        return (error**2).sum(dim=(1, 2)).mean()

    @torch.no_grad()
    def set_k_scale(self, counts: Tensor, depth: Tensor, indentation_mm: Tensor) -> None:
        """Set k_scale by least squares of each pattern's highest point to its indentation (n,)."""
        plateau = (self.pattern(self(counts), depth) / self.k_scale).amax(dim=(1, 2))
        self.k_scale.copy_((plateau @ indentation_mm) / (plateau @ plateau).clamp_min(_SMALLEST))


def pressed(counts: Tensor) -> Tensor:
    """Return the positive part of the z readings, (n, rows, cols) of (n, 3, rows, cols), in [counts / 100]."""
    return counts[:, 2].clamp_min(0.0) / COUNTS_PER_UNIT


def degrade(pattern: Tensor, gamma: Tensor, geometry: SensorGeometry = USPA44, form: Form = "paper") -> Tensor:
    """Integrate HR patterns (n, H, W) with each taxel's weights, (n, rows, cols); the pattern's unit times [mm^2].

    Eq. 7's sum over pixels is taken as an integral, so that a pattern reads alike at every scale.

    Args:
        pattern: (n, H, W).
        gamma: (), or (n,) for one each; > 0.
        geometry: the taxels.
        form: "paper": weights exp(-d/gamma^2), each taxel's divided by their largest; "code", as in the authors'
            code: exp(-d^2/gamma), all taxels' together stretched to 0..1. d in [mm].

    Raises:
        ValueError: the form is unknown.

    Source: Wu and Liu 2024, Eq. 7-8.
    """
    height, width = pattern.shape[1:]
    distance_mm = _distances_mm(geometry, height, width)
    gamma = gamma[..., None, None]
    # Distances count from the nearest pixel, which replaces the division by the largest weight and avoids 0/0. Their
    # differences are computed in float64, since a small gamma depends on their last digits.
    if form == "paper":
        beyond_mm = distance_mm - distance_mm.amin(dim=1, keepdim=True)
        weights = torch.exp(-beyond_mm.to(pattern) / gamma**2)
    elif form == "code":
        square = distance_mm**2
        weights = torch.exp(-(square - square.min()).to(pattern) / gamma)
        least = weights.amin(dim=(-2, -1), keepdim=True)
        weights = (weights - least) / (1 - least)
    else:
        raise ValueError(f"form {form!r}, expected {' or '.join(map(repr, get_args(Form)))}")
    area_mm2 = (geometry.pitch_mm * geometry.rows / height) * (geometry.pitch_mm * geometry.cols / width)
    pixels = pattern.flatten(1)
    readings = pixels @ weights.T if weights.ndim == 2 else (weights @ pixels[..., None])[..., 0]
    return area_mm2 * readings.reshape(-1, geometry.rows, geometry.cols)


@lru_cache
def _distances_mm(geometry: SensorGeometry, height: int, width: int) -> Tensor:
    """Return the distance of each taxel to each pixel, (taxels, H * W) in [mm]."""
    down_mm = ((torch.arange(height) + 0.5) / height - 0.5) * geometry.rows * geometry.pitch_mm
    right_mm = ((torch.arange(width) + 0.5) / width - 0.5) * geometry.cols * geometry.pitch_mm
    pixels_mm = torch.cartesian_prod(down_mm, right_mm).flip(1)
    return torch.cdist(torch.from_numpy(geometry.taxel_centres_mm()), pixels_mm.double())


def fit_psf_net(
    net: PsfNet,
    counts: NDArray[np.floating],
    depth: NDArray[np.floating],
    indentation_mm: NDArray[np.floating] | None = None,
    *,
    epochs: int = 100,
    batch: int = 64,
    seed: int = 0,
) -> list[float]:
    """Train the network on scans and their depth images, and return the loss of every epoch.

    Args:
        net: the network; its weights are initialised again from the seed.
        counts: (n, 3, rows, cols) zeroed.
        depth: (n, H, W) in 0..1, 1 the surface's top.
        indentation_mm: (n,), in [mm], or None; sets k_scale.
        epochs: passes over the scans.
        batch: scans in a step.
        seed: of the weights and of the order of the scans.

    Raises:
        ValueError: scans and depth images do not match.
    """
    if len(counts) != len(depth) or len(counts) == 0:
        raise ValueError(f"{len(counts)} scans and {len(depth)} depth images, expected as many of both, at least one")
    scans, images = torch.as_tensor(counts, dtype=torch.float32), torch.as_tensor(depth, dtype=torch.float32)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for layer in net.layers:
            if isinstance(layer, nn.Linear):
                layer.reset_parameters()
    order = torch.Generator().manual_seed(seed)
    lone = [] if net.gamma is None else [net.gamma]
    groups = [{"params": net.layers.parameters()}, {"params": lone, "lr": _GAMMA_HASTE * _RATE}]
    optimizer = torch.optim.Adam(groups, _RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs)
    losses: list[float] = []
    for _ in tracked(range(epochs), "PSF network", "epoch"):
        total = 0.0
        for index in torch.randperm(len(scans), generator=order).split(batch):
            loss = net.loss(scans[index], images[index])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            total += float(loss.detach()) * len(index)
        schedule.step()
        losses.append(total / len(scans))
    if indentation_mm is not None:
        net.set_k_scale(scans, images, torch.as_tensor(indentation_mm, dtype=torch.float32))
    return losses
