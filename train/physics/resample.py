"""Patterns at another scale: a pixel is the mean over its area, so edges stay in place and volume is kept.

Averaging over the pixel is the anti-aliasing. Unlike torch's and scikit-image's resizing it keeps the mean of any map
exactly, also at ratios that are not integers.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray


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
