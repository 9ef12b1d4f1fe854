"""Errors of a pattern against its truth, by training and runtime alike.

All functions of a full scale take (..., H, W) arrays of one shape and the declared full scale L in the same unit, and
return one value per pattern, shape (...). Equal maps are perfect also where they are constant.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge.perception.pattern_description import touched

_WINDOW_RADIUS_PX: Final = 5


def psnr_db(pattern: ArrayLike, truth: ArrayLike, full_scale: float) -> NDArray[np.float64]:
    """Return the peak signal-to-noise ratio, 10 log10(L^2 / mean squared error), in [dB].

    Source: Wu and Liu 2024, Eq. 11, with the square and the 1/N that the equation lacks.
    """
    a, b = _pair(pattern, truth, full_scale)
    mse = np.mean((a - b) ** 2, axis=(-2, -1))
    with np.errstate(divide="ignore"):
        return 10.0 * np.log10(full_scale**2 / mse)


def rmse_percent(pattern: ArrayLike, truth: ArrayLike, full_scale: float) -> NDArray[np.float64]:
    """Return the root mean squared error in [% of full scale]."""
    a, b = _pair(pattern, truth, full_scale)
    return 100.0 * np.sqrt(np.mean((a - b) ** 2, axis=(-2, -1))) / full_scale


def ssim_global(pattern: ArrayLike, truth: ArrayLike, full_scale: float) -> NDArray[np.float64]:
    """Return the structural similarity over one window as large as the pattern.

    Source: Wu and Liu 2024, Eq. 12-13, with C = (0.01 L)^2 and (0.03 L)^2.
    """
    a, b = _pair(pattern, truth, full_scale)
    count = a.shape[-2] * a.shape[-1]
    return _similarity(a, b, full_scale, lambda maps: maps.mean(axis=(-2, -1)), count / (count - 1))


def ssim(pattern: ArrayLike, truth: ArrayLike, full_scale: float) -> NDArray[np.float64]:
    """Return the structural similarity, mean over 11 x 11 Gaussian windows, of sigma 1.5, inside the pattern.

    Source: Wang et al. 2004; the same figure as scikit-image.
    """
    a, b = _pair(pattern, truth, full_scale)
    if min(a.shape[-2:]) <= 2 * _WINDOW_RADIUS_PX:
        raise ValueError(f"pattern of shape {a.shape[-2:]} is smaller than the 11 x 11 window of ssim")
    return _similarity(a, b, full_scale, _blur, 1.0).mean(axis=(-2, -1))


def contact_iou(pattern: ArrayLike, touching: NDArray[np.bool_], level: float) -> NDArray[np.float64]:
    """Return overlap over union of the touched pixels and those that truly touch, (..., H, W); 1 if both are empty."""
    contact = _touched(pattern, touching, level)
    union = np.sum(contact | touching, axis=(-2, -1))
    overlap = np.sum(contact & touching, axis=(-2, -1))
    return np.where(union > 0, overlap / np.maximum(union, 1), 1.0)


def boundary_distance_mm(
    pattern: ArrayLike, touching: NDArray[np.bool_], level: float, pixel_mm: float
) -> NDArray[np.float64]:
    """Return the distance between the outlines of two contacts: pixel of one to nearest of the other, mean of both.

    It takes (n, H, W). If both contacts are empty it is 0, if only one is, the map's diagonal.
    """
    contact = _touched(pattern, touching, level)
    distance_px = np.zeros(len(contact))
    for i, outlines in enumerate(zip(_outlines(contact), _outlines(touching), strict=True)):
        points, true_points = (np.argwhere(pixels).astype(np.float32) for pixels in outlines)
        if len(points) and len(true_points):
            between = np.hypot(*(points[:, None] - true_points[None]).transpose(2, 0, 1))
            distance_px[i] = (between.min(axis=0).mean() + between.min(axis=1).mean()) / 2
        elif len(points) or len(true_points):
            distance_px[i] = np.hypot(*contact.shape[1:])
    return distance_px * pixel_mm


def _touched(pattern: ArrayLike, touching: NDArray[np.bool_], level: float) -> NDArray[np.bool_]:
    contact = touched(np.asarray(pattern), level)
    if contact.shape != touching.shape:
        raise ValueError(f"pattern of shape {contact.shape} against contact of shape {touching.shape}, expected equal")
    return contact


def _outlines(touching: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the touched pixels (n, H, W) next to an untouched one or at the map's edge."""
    around = np.pad(touching, ((0, 0), (1, 1), (1, 1)))
    inside = around[:, :-2, 1:-1] & around[:, 2:, 1:-1] & around[:, 1:-1, :-2] & around[:, 1:-1, 2:]
    return touching & ~inside


def interval_coverage(pattern: ArrayLike, truth: ArrayLike, half_width: ArrayLike) -> NDArray[np.float64]:
    """Return the share of pixels whose truth is within `half_width` of the pattern, (..., H, W) in the same unit."""
    errors = np.abs(np.asarray(pattern) - np.asarray(truth))
    if errors.shape != np.shape(half_width):
        raise ValueError(
            f"half width of shape {np.shape(half_width)} for errors of shape {errors.shape}, expected equal"
        )
    return np.mean(errors <= half_width, axis=(-2, -1))


def _pair(pattern: ArrayLike, truth: ArrayLike, full_scale: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    a, b = np.asarray(pattern, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if a.shape != b.shape or a.ndim < 2:
        raise ValueError(f"pattern of shape {a.shape} against truth of shape {b.shape}, expected equal (..., H, W)")
    if not full_scale > 0:
        raise ValueError(f"full scale is {full_scale}, expected a positive number")
    return a, b


def _similarity(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    full_scale: float,
    mean: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    sampled: float,
) -> NDArray[np.float64]:
    """Return the similarity within windows, over which `mean` averages; `sampled` corrects their variances."""
    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b, covariance = (
        sampled * (mean(x * y) - mean_x * mean_y)
        for x, y, mean_x, mean_y in ((a, a, mean_a, mean_a), (b, b, mean_b, mean_b), (a, b, mean_a, mean_b))
    )
    c1, c2 = (0.01 * full_scale) ** 2, (0.03 * full_scale) ** 2
    return ((2 * mean_a * mean_b + c1) * (2 * covariance + c2)) / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))


def _blur(maps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Gaussian means over the windows that lie inside the map."""
    offsets_px = np.arange(-_WINDOW_RADIUS_PX, _WINDOW_RADIUS_PX + 1)
    weights = np.exp(-0.5 * (offsets_px / 1.5) ** 2)
    weights /= weights.sum()
    windows = np.lib.stride_tricks.sliding_window_view
    rows = windows(maps, weights.size, axis=-2) @ weights
    return windows(rows, weights.size, axis=-1) @ weights
