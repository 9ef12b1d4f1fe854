"""Patterns of curved surfaces: several planes at different heights, each with its own PSF.

In the contact the pad follows the surface. Outside it, each plane spreads its indentation, and deeper planes spread
further. A flat surface is one plane, with the pattern of `train.physics.tpsf.tpsf_pattern`.

Source: Wu and Liu 2024, Section VII, which names this as future work without a method.
"""

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from train.physics.tpsf import BETA_MM, Kernel, spread

PLANES: Final = 4
"""Largest number of planes; twice as many change the error by less than 0.1 % of the indentation."""
EDGE_BETA_MM: Final = 0.6
"""Reach of a plane that just touches, fitted to the default layer under spheres and cylinders, see tests."""


def heights_pattern(
    depth_mm: NDArray[np.floating],
    touching: NDArray[np.bool_],
    indentation_mm: NDArray[np.floating],
    pixel_mm: float,
    planes: int = PLANES,
    beta_mm: float = BETA_MM,
    kernel: Kernel = "gaussian",
) -> NDArray[np.float32]:
    """Return the surface deformation under rigid surfaces of any shape, (n, H, W) in [mm].

    The planes divide the indentation into equal slices; only planes with touching pixels are computed. A plane at a
    share s of the indentation has an alpha that would lift the whole contact to that height, and a beta between
    EDGE_BETA_MM, at s = 0, and beta_mm, at s = 1.

    Args:
        depth_mm: (n, H, W), depth of each pixel below the highest point, in [mm].
        touching: (n, H, W), the area that the surface touches.
        indentation_mm: (n,), of the highest point, in [mm].
        pixel_mm: pixel size, in [mm].
        planes: largest number of planes, at least 1.
        beta_mm: reach of the kernel of a plane at the top, > 0, in [mm].
        kernel: see `train.physics.tpsf.spread`.

    Raises:
        ValueError: shapes do not fit, there is no plane, a beta is not positive, or the kernel is unknown.
    """
    if depth_mm.shape != touching.shape or depth_mm.ndim != 3 or indentation_mm.shape != depth_mm.shape[:1]:
        raise ValueError(
            f"depth of shape {depth_mm.shape}, contact {touching.shape}, indentation {indentation_mm.shape}, "
            "expected (n, H, W), (n, H, W), (n,)"
        )
    if planes < 1:
        raise ValueError(f"{planes} planes, expected at least 1")
    area = torch.from_numpy(np.ascontiguousarray(touching))
    total_mm = torch.as_tensor(np.asarray(indentation_mm, dtype=np.float32))[:, None, None]
    pressed_mm = total_mm - torch.as_tensor(np.asarray(depth_mm, dtype=np.float32))
    share = torch.where(area & (total_mm > 0), pressed_mm / total_mm.clamp_min(1e-30), 0.0).clamp(0.0, 1.0)
    plane_of = ((1.0 - share) * planes).long().clamp_max(planes - 1)
    around = torch.zeros_like(share)
    for plane in range(planes):
        members = area & (plane_of == plane)
        taps = members.flatten(1).any(dim=1).nonzero()[:, 0]
        if len(taps) == 0:
            continue
        slices = members[taps].float()
        height = (share[taps] * slices).sum(dim=(1, 2)) / slices.sum(dim=(1, 2))
        beta = beta_mm + (EDGE_BETA_MM - beta_mm) * (1.0 - height)
        full = spread(area[taps].float(), beta, pixel_mm, kernel).amax(dim=(1, 2))
        around[taps] += (height / full)[:, None, None] * spread(slices, beta, pixel_mm, kernel)
    return (total_mm * torch.where(area, share, around)).numpy()
