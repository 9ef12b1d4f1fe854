"""Tactile PSF: the depth of a contact spread by a Gaussian point-spread function, with a plateau in the contact.

`tpsf_pattern` is of flat contacts, where the indentation is an input and replaces alpha. `heights_pattern` is of curved
ones: several planes at different heights, each with its own PSF. In the contact the pad follows the surface; outside it
each plane spreads its indentation, and deeper planes spread further. Convolutions are integrals over the pad, in
[mm^2], so that a pattern does not depend on the scale at which it is drawn.

Source: Wu and Liu 2024, Eq. 4-6; Section VII names curved surfaces as future work without a method.
"""

from functools import lru_cache
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

BETA_MM: Final = 1.3  # best fit to the default layer's surface: 2.6 % of the indentation over the 18 surfaces
PLANES: Final = 4  # largest number of planes; twice as many change the error by less than 0.1 % of the indentation
EDGE_BETA_MM: Final = 0.6  # of a plane that just touches, fitted to the default layer under spheres and cylinders


def tpsf_pattern(
    touching: NDArray[np.bool_], indentation_mm: NDArray[np.floating], pixel_mm: float, beta_mm: float = BETA_MM
) -> NDArray[np.float32]:
    """Return the surface deformation of flat contacts, (n, H, W) in [mm], of areas (n, H, W) and indentations (n,).

    Alpha follows from the rigid flat contact: there the pad is pressed in by the indentation, which is the plateau.
    """
    area = torch.from_numpy(np.ascontiguousarray(touching))
    response = spread(area.float(), torch.tensor([beta_mm], dtype=torch.float32), pixel_mm)
    level = response.amax(dim=(1, 2), keepdim=True)
    share = torch.where(level > 0, response / level.clamp_min(torch.finfo(response.dtype).tiny), 0.0)
    share[area] = 1.0
    depth_mm = torch.as_tensor(np.asarray(indentation_mm, dtype=np.float32))
    return (share * depth_mm[:, None, None]).numpy()


def heights_pattern(
    depth_mm: NDArray[np.floating],
    touching: NDArray[np.bool_],
    indentation_mm: NDArray[np.floating],
    pixel_mm: float,
) -> NDArray[np.float32]:
    """Return the surface deformation under rigid surfaces of any shape, (n, H, W) in [mm].

    Depths (n, H, W) are below the highest point, whose indentation is (n,); `touching` (n, H, W) is the contact area.

    The planes divide the indentation into equal slices; only planes with touching pixels are computed. A plane at a
    share s of the indentation has an alpha that would lift the whole contact to that height, and a beta between
    EDGE_BETA_MM, at s = 0, and BETA_MM, at s = 1.
    """
    area = torch.from_numpy(np.ascontiguousarray(touching))
    total_mm = torch.as_tensor(np.asarray(indentation_mm, dtype=np.float32))[:, None, None]
    pressed_mm = total_mm - torch.as_tensor(np.asarray(depth_mm, dtype=np.float32))
    share = torch.where(area & (total_mm > 0), pressed_mm / total_mm.clamp_min(1e-30), 0.0).clamp(0.0, 1.0)
    plane_of = ((1.0 - share) * PLANES).long().clamp_max(PLANES - 1)
    around = torch.zeros_like(share)
    for plane in range(PLANES):
        members = area & (plane_of == plane)
        taps = members.flatten(1).any(dim=1).nonzero()[:, 0]
        if len(taps) == 0:
            continue
        slices = members[taps].float()
        height = (share[taps] * slices).sum(dim=(1, 2)) / slices.sum(dim=(1, 2))
        beta = BETA_MM + (EDGE_BETA_MM - BETA_MM) * (1.0 - height)
        full = spread(area[taps].float(), beta, pixel_mm).amax(dim=(1, 2))
        around[taps] += (height / full)[:, None, None] * spread(slices, beta, pixel_mm)
    return (total_mm * torch.where(area, share, around)).numpy()


def spread(maps: Tensor, beta_mm: Tensor, pixel_mm: float) -> Tensor:
    """Convolve maps (n, H, W), zero outside, with exp(-r^2/beta^2), beta (n,) or (1,); in their unit times [mm^2]."""
    height, width = maps.shape[1:]
    down = _curve(height, beta_mm, pixel_mm)
    right = down if width == height else _curve(width, beta_mm, pixel_mm)
    return pixel_mm**2 * (down @ (maps @ right))


def _curve(length: int, beta_mm: Tensor, pixel_mm: float) -> Tensor:
    """Return the Gaussian's factor along one axis, between any two pixels of a line: (n, length, length)."""
    place_mm = torch.arange(length, dtype=beta_mm.dtype, device=beta_mm.device) * pixel_mm
    distance_mm = place_mm[:, None] - place_mm[None, :]
    return torch.exp(-((distance_mm / beta_mm[:, None, None]) ** 2))


def resample(
    patterns: NDArray[np.floating] | NDArray[np.bool_], from_scale: float, to_scale: float
) -> NDArray[np.float32]:
    """Resample maps (n, H, W) from one number of pixels per pitch to another: (n, H', W'), in the same unit.

    Towards a finer scale a pixel is repeated: no detail is added. Of a mask, the share of each pixel that is set.
    """
    maps = np.asarray(patterns, dtype=np.float32)
    if from_scale == to_scale:
        return maps.copy()
    down, right = (_shares(length, from_scale, to_scale) for length in maps.shape[1:])
    return np.matmul(down, maps @ right.T)


def resample_touching(touching: NDArray[np.bool_], from_scale: float, to_scale: float) -> NDArray[np.bool_]:
    """Resample masks (n, H, W): a pixel touches if at least half of its area does."""
    # Shares are sums of rounded fractions: half an area may come out slightly below 0.5.
    return resample(touching, from_scale, to_scale) >= 0.5 - 1e-5


@lru_cache
def _shares(length: int, from_scale: float, to_scale: float) -> NDArray[np.float32]:
    """Return the share of each old pixel in each new one along a line, (new, old); rows sum to 1."""
    count = round(length * to_scale / from_scale)
    new = np.arange(count + 1) / count
    old = np.arange(length + 1) / length
    overlap = np.minimum(new[1:, None], old[None, 1:]) - np.maximum(new[:-1, None], old[None, :-1])
    shares = (np.maximum(overlap, 0.0) * count).astype(np.float32)
    shares.setflags(write=False)
    return shares
