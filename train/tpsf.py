"""HR truth by the tactile PSF: the contact's depth spread by a kernel, with a plateau where it touches.

Source: Wu and Liu 2024, Eq. 4-6.
"""

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

Kernel = Literal["gaussian", "exponential"]
BETA_MM: Final = 1.0
"""Fits the surface of the default layer best: 2.4 % of the indentation over the 18 surfaces, see tests."""


def tpsf_pattern(
    touching: NDArray[np.bool_],
    indentation_mm: NDArray[np.floating],
    pixel_mm: float,
    beta_mm: float = BETA_MM,
    kernel: Kernel = "gaussian",
) -> NDArray[np.float32]:
    """Surface deformation of flat contacts, (n, H, W) in [mm].

    The kernel's intensity alpha is set by what is known of a rigid flat contact: where it touches, the pad is
    pressed in by the indentation. So Eq. 6's plateau, the maximum of the response, equals it.

    Args:
        touching: (n, H, W), the area that the surface touches.
        indentation_mm: (n,), in [mm].
        pixel_mm: pixel size, in [mm].
        beta_mm: reach of the kernel, > 0, in [mm].
        kernel: "gaussian" exp(-r^2/beta^2), or "exponential" exp(-r/beta) as Eq. 4 prints it.

    Raises:
        ValueError: beta is not positive, or the kernel is unknown.
    """
    if not beta_mm > 0:
        raise ValueError(f"beta is {beta_mm} mm, expected a positive length")
    response = _spread(touching.astype(np.float32), pixel_mm, beta_mm, kernel)
    peak = response.max(axis=(1, 2), keepdims=True)
    share = np.divide(response, peak, out=np.zeros_like(response), where=peak > 0)
    share[touching] = 1.0
    return (share * indentation_mm[:, None, None]).astype(np.float32)


def _spread(maps: NDArray[np.float32], pixel_mm: float, beta_mm: float, kernel: Kernel) -> NDArray[np.float32]:
    """Convolve (n, H, W) with the kernel, nothing outside the map."""
    height, width = maps.shape[1:]
    rows_mm = np.arange(-height + 1, height) * pixel_mm
    cols_mm = np.arange(-width + 1, width) * pixel_mm
    radius_mm = np.hypot(rows_mm[:, None], cols_mm[None, :])
    if kernel == "gaussian":
        weights = np.exp(-((radius_mm / beta_mm) ** 2))
    elif kernel == "exponential":
        weights = np.exp(-radius_mm / beta_mm)
    else:
        raise ValueError(f"kernel {kernel!r}, expected 'gaussian' or 'exponential'")
    shape = (3 * height - 2, 3 * width - 2)
    spectrum = np.fft.rfft2(weights.astype(np.float32), s=shape)
    spread = np.fft.irfft2(np.fft.rfft2(maps, s=shape) * spectrum, s=shape)
    # The FFT leaves rounding noise where nothing is near; a deformation is never negative here.
    return np.maximum(spread[:, height - 1 : 2 * height - 1, width - 1 : 2 * width - 1], 0).astype(np.float32)
