"""Network of the tactile PSF: from a scan to the PSF that spreads the depth of its contact.

Depth and PSF give the HR pattern, the pattern degraded to the taxels gives the scan's z again, and the difference
trains the network: no HR truth is needed. Alpha has the scan's unit per area, since only the product of alpha and the
taxels' sensitivity is visible in a scan; k_scale converts that into [mm].

Source: Wu and Liu 2024, Fig. 4, Section IV-C, Eq. 4-10.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from train.physics.tpsf import spread

COUNTS_PER_UNIT: Final = 100.0  # counts per unit of the network's input and loss
_SMALLEST: Final = 1e-6  # least length: softplus of a very negative number is 0, and the lengths are divisors
_RATE: Final = 1e-3


@dataclass(frozen=True, slots=True)
class PsfParameters:
    """Parameters that the network estimates from n scans."""

    alpha: Tensor  # (n,) intensity, >= 0, in [counts / 100 / mm^4]
    beta_mm: Tensor  # (n,) reach of the PSF, > 0, in [mm]
    gamma: Tensor  # () perceptual region of a taxel, > 0, in [mm^0.5]


class PsfNet(nn.Module):
    """Network from a scan to alpha and beta, 48 -> 256 -> 1024 -> 256 -> 2, ReLU, softplus; gamma is one number."""

    k_scale: Tensor  # of Eq. 5, in [mm] of pattern per [counts / 100 / mm^2]; 1 until it is fitted

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential()
        width = 3 * USPA44.taxel_count
        for wider in (256, 1024, 256):
            self.layers.extend([nn.Linear(width, wider), nn.ReLU()])
            width = wider
        self.layers.append(nn.Linear(width, 2))
        self.gamma = nn.Parameter(torch.tensor(float(np.log(np.expm1(0.8)))))
        self.register_buffer("k_scale", torch.tensor(1.0))

    def forward(self, counts: Tensor) -> PsfParameters:
        """Return the parameters of scans (n, 3, rows, cols) in zeroed counts."""
        raw = self.layers(counts.flatten(1) / COUNTS_PER_UNIT)
        alpha, beta_mm, gamma = (nn.functional.softplus(value) for value in (raw[:, 0], raw[:, 1], self.gamma))
        return PsfParameters(alpha, beta_mm + _SMALLEST, gamma + _SMALLEST)

    def pattern(self, read: PsfParameters, depth: Tensor) -> Tensor:
        """Return HR patterns (n, H, W) of depth images (n, H, W) in 0..1; in [mm] once k_scale is fitted."""
        pixel_mm = USPA44.pitch_mm * USPA44.rows / depth.shape[1]
        return self.k_scale * tpsf(depth, read.alpha, read.beta_mm, pixel_mm)

    def loss(self, counts: Tensor, depth: Tensor) -> Tensor:
        """Return the squared error of the z readings, summed over the taxels, mean over the scans; Eq. 9-10."""
        read = self(counts)
        # Next to a contact the pad bulges, and in fitting that beta would vanish.
        pressed = counts[:, 2].clamp_min(0.0) / COUNTS_PER_UNIT
        error = degrade(self.pattern(read, depth) / self.k_scale, read.gamma) - pressed
        return (error**2).sum(dim=(1, 2)).mean()


def tpsf(depth: Tensor, alpha: Tensor, beta_mm: Tensor, pixel_mm: float) -> Tensor:
    """Return HR patterns (n, H, W) of depth images (n, H, W) in 0..1, in alpha's unit times [mm^2]; Eq. 4-6.

    The plateau in the contact is the largest response anywhere.
    """
    response = alpha[:, None, None] * spread(depth, beta_mm, pixel_mm)
    return torch.where(depth >= 0.5, response.amax(dim=(1, 2), keepdim=True), response)


def degrade(pattern: Tensor, gamma: Tensor) -> Tensor:
    """Integrate HR patterns (n, H, W) with weights exp(-d/gamma^2), each taxel's divided by their largest; Eq. 7-8.

    The integral, (n, rows, cols) in the pattern's unit times [mm^2], reads alike at every scale.
    """
    height, width = pattern.shape[1:]
    # Distances count from the nearest pixel, which replaces the division by the largest weight and avoids 0/0. Their
    # differences are computed in float64, since a small gamma depends on their last digits.
    distance_mm = _distances_mm(height, width)
    beyond_mm = distance_mm - distance_mm.amin(dim=1, keepdim=True)
    weights = torch.exp(-beyond_mm.to(pattern) / gamma**2)
    area_mm2 = (USPA44.pitch_mm * USPA44.rows / height) * (USPA44.pitch_mm * USPA44.cols / width)
    return area_mm2 * (pattern.flatten(1) @ weights.T).reshape(-1, USPA44.rows, USPA44.cols)


@lru_cache
def _distances_mm(height: int, width: int) -> Tensor:
    """Return the distance of each taxel to each pixel, (taxels, H * W) in [mm]."""
    down_mm = ((torch.arange(height) + 0.5) / height - 0.5) * USPA44.rows * USPA44.pitch_mm
    right_mm = ((torch.arange(width) + 0.5) / width - 0.5) * USPA44.cols * USPA44.pitch_mm
    pixels_mm = torch.cartesian_prod(down_mm, right_mm).flip(1)
    return torch.cdist(torch.from_numpy(USPA44.taxel_centres_mm()), pixels_mm.double())


def fit_psf_net(
    net: PsfNet,
    counts: NDArray[np.floating],
    depth: NDArray[np.floating],
    indentation_mm: NDArray[np.floating],
    *,
    epochs: int,
    seed: int = 0,
) -> list[float]:
    """Train the network from its first weights, fit k_scale, and return the loss of every epoch.

    Scans are zeroed counts (n, 3, rows, cols), with depth images (n, H, W) in 0..1, 1 the surface's top, and
    indentations (n,). The seed is that of the weights and of the order of the scans.
    """
    scans, images = torch.as_tensor(counts, dtype=torch.float32), torch.as_tensor(depth, dtype=torch.float32)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for layer in net.layers:
            if isinstance(layer, nn.Linear):
                layer.reset_parameters()
    order = torch.Generator().manual_seed(seed)
    # Gamma learns faster, for a thousand weights of alpha and beta would make up for its staying.
    groups = [{"params": net.layers.parameters()}, {"params": [net.gamma], "lr": 20.0 * _RATE}]
    optimizer = torch.optim.Adam(groups, _RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs)
    losses: list[float] = []
    for _ in tracked(range(epochs), "PSF network", "epoch"):
        total = 0.0
        for index in torch.randperm(len(scans), generator=order).split(64):
            loss = net.loss(scans[index], images[index])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            total += float(loss.detach()) * len(index)
        schedule.step()
        losses.append(total / len(scans))
    with torch.no_grad():
        plateau = (net.pattern(net(scans), images) / net.k_scale).amax(dim=(1, 2))
        wanted = torch.as_tensor(indentation_mm, dtype=torch.float32)
        net.k_scale.copy_((plateau @ wanted) / (plateau @ plateau).clamp_min(_SMALLEST))
    return losses
