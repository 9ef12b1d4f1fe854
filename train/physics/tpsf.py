"""Tactile PSF: the depth of a contact spread by a point-spread function, with a plateau in the contact.

Two functions: `tpsf` for training, in torch and differentiable; `tpsf_pattern` for truth, where the indentation is an
input and replaces alpha. Convolutions are integrals over the pad, in [mm^2], so that a pattern does not depend on the
scale at which it is drawn.

Source: Wu and Liu 2024, Eq. 4-6.
"""

from typing import Final, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Kernel = Literal["gaussian", "exponential"]
Plateau = Literal["response", "outside", "none"]
BETA_MM: Final = 1.3
"""Reach with the best fit to the default layer's surface: 2.6 % of the indentation over the 18 surfaces, see tests."""

_FFT_STEPS: Final = 16
"""Rounding noise of an FFT over some hundred pixels each way, in steps of its largest response."""


def tpsf_pattern(
    touching: NDArray[np.bool_],
    indentation_mm: NDArray[np.floating],
    pixel_mm: float,
    beta_mm: float = BETA_MM,
    kernel: Kernel = "gaussian",
    plateau: Plateau = "response",
) -> NDArray[np.float32]:
    """Return the surface deformation of flat contacts, (n, H, W) in [mm].

    The kernel's intensity alpha follows from the rigid flat contact: in it, the pad is pressed in by the indentation,
    so the plateau equals it.

    Args:
        touching: (n, H, W), the area that the surface touches.
        indentation_mm: (n,), in [mm].
        pixel_mm: pixel size, in [mm].
        beta_mm: reach of the kernel, > 0, in [mm].
        kernel: see `spread`.
        plateau: see `tpsf`; with "none" the largest response equals the indentation.

    Raises:
        ValueError: beta is not positive, or the kernel or the plateau is unknown.
    """
    area = torch.from_numpy(np.ascontiguousarray(touching))
    response = spread(area.float(), torch.tensor([beta_mm], dtype=torch.float32), pixel_mm, kernel)
    level = _level(response, area, plateau)
    share = torch.where(level > 0, response / level.clamp_min(torch.finfo(response.dtype).tiny), 0.0)
    if plateau != "none":
        share[area] = 1.0
    depth_mm = torch.as_tensor(np.asarray(indentation_mm, dtype=np.float32))
    return (share * depth_mm[:, None, None]).numpy()


def tpsf(
    depth: Tensor,
    alpha: Tensor,
    beta_mm: Tensor,
    pixel_mm: float,
    kernel: Kernel = "gaussian",
    plateau: Plateau = "response",
) -> Tensor:
    """Return HR patterns (n, H, W) of depth images, in alpha's unit times [mm^2], differentiable in alpha and beta.

    Args:
        depth: (n, H, W) depth images normalised to 0..1; 1 is the surface's top.
        alpha: (n,) or (1,), intensity of the PSF, >= 0.
        beta_mm: (n,) or (1,), its reach, > 0, in [mm].
        pixel_mm: pixel size, in [mm].
        kernel: see `spread`.
        plateau: value in the contact: "response", the largest response anywhere, as printed in Eq. 6;
            "outside", the largest outside the contact, as in the authors' code (anywhere, if all of the face
            touches); "none", no plateau: the plain PSF.

    Raises:
        ValueError: the kernel or the plateau is unknown, or beta is not positive.

    Source: Wu and Liu 2024, Eq. 4-6.
    """
    response = alpha[:, None, None] * spread(depth, beta_mm, pixel_mm, kernel)
    touching = depth >= 0.5
    level = _level(response, touching, plateau)
    return response if plateau == "none" else torch.where(touching, level, response)


def spread(maps: Tensor, beta_mm: Tensor, pixel_mm: float, kernel: Kernel = "gaussian") -> Tensor:
    """Convolve maps (n, H, W) with the PSF of alpha 1, zero outside the map; the maps' unit times [mm^2].

    The Gaussian is a product of two curves and takes two matrix products, faster than the FFT of the other kernel.

    Args:
        maps: (n, H, W).
        beta_mm: (n,) or (1,), reach of the kernel, > 0, in [mm].
        pixel_mm: pixel size, in [mm].
        kernel: "gaussian" exp(-r^2/beta^2), or "exponential" exp(-r/beta) as printed in Eq. 4.

    Raises:
        ValueError: beta is not positive, or the kernel is unknown.
    """
    if kernel == "gaussian":
        _check(beta_mm, kernel)
        height, width = maps.shape[1:]
        down = _curve(height, beta_mm, pixel_mm)
        right = down if width == height else _curve(width, beta_mm, pixel_mm)
        return pixel_mm**2 * (down @ (maps @ right))
    return spread_by_fft(maps, beta_mm, pixel_mm, kernel)


def spread_by_fft(maps: Tensor, beta_mm: Tensor, pixel_mm: float, kernel: Kernel) -> Tensor:
    """Convolve as `spread` does, by FFT, for any kernel of the radius."""
    _check(beta_mm, kernel)
    height, width = maps.shape[1:]
    shape = (2 * height, 2 * width)
    down_mm, right_mm = (_offsets_mm(length, pixel_mm, maps) for length in maps.shape[1:])
    ratio = torch.hypot(down_mm[:, None], right_mm[None, :]) / beta_mm[:, None, None]
    weights = torch.exp(-(ratio**2)) if kernel == "gaussian" else torch.exp(-ratio)
    spectrum = torch.fft.rfft2(maps, s=shape) * torch.fft.rfft2(weights)
    response = torch.fft.irfft2(spectrum, s=shape)[:, :height, :width]
    # The FFT leaves rounding noise far from any contact, which must not become a plateau.
    noise = _FFT_STEPS * torch.finfo(response.dtype).eps * response.detach().amax(dim=(1, 2), keepdim=True)
    return pixel_mm**2 * torch.where(response > noise, response, 0.0)


def _check(beta_mm: Tensor, kernel: str) -> None:
    if kernel not in get_args(Kernel):
        raise ValueError(f"kernel {kernel!r}, expected {' or '.join(map(repr, get_args(Kernel)))}")
    if not bool((beta_mm > 0).all()):
        raise ValueError(f"beta is {float(beta_mm.min())} mm, expected a positive length")


def _curve(length: int, beta_mm: Tensor, pixel_mm: float) -> Tensor:
    """Return one factor of the Gaussian, between any two pixels of a line: (n, length, length)."""
    place_mm = torch.arange(length, dtype=beta_mm.dtype, device=beta_mm.device) * pixel_mm
    distance_mm = place_mm[:, None] - place_mm[None, :]
    return torch.exp(-((distance_mm / beta_mm[:, None, None]) ** 2))


def _offsets_mm(length: int, pixel_mm: float, like: Tensor) -> Tensor:
    """Return offsets 0, 1, ..., -2, -1 pixels on a line padded to twice its length, so that nothing wraps round."""
    return torch.fft.fftfreq(2 * length, 1 / (2 * length), dtype=like.dtype, device=like.device) * pixel_mm


def _level(response: Tensor, touching: Tensor, plateau: str) -> Tensor:
    """Return the height of the plateau, (n, 1, 1)."""
    highest = response.amax(dim=(1, 2), keepdim=True)
    if plateau in ("response", "none"):
        return highest
    if plateau != "outside":
        raise ValueError(f"plateau {plateau!r}, expected {' or '.join(map(repr, get_args(Plateau)))}")
    outside = torch.where(touching, 0.0, response).amax(dim=(1, 2), keepdim=True)
    return torch.where(touching.all(dim=2, keepdim=True).all(dim=1, keepdim=True), highest, outside)
