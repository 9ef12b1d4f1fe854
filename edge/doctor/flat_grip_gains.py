"""Gains of all channels from grips of a flat face larger than the pad.

While such a grip grows from light to strong, the slope of a taxel's z over the mean z of the pad separates its gain
from the pad's unevenness and from drift, which only add an offset. While the face is dragged sideways, the slope of x
over mean x does the same. One regression over all readings of a grip gives both, in whatever order they come.

What else the slopes depend on (border taxels, tilt, thickness, bulge) was simulated on many sensors; the joint normal
distribution of features and log-gains in the table gives the gains with their intervals (`train.learning.flat_grips`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.errors import EdgeError
from firmware_bridge.pad_geometry import AXES, USPA44
from firmware_bridge.recording.npz_reader import read_npz
from firmware_bridge.scans.pad_constants import GAINS, LEVEL_90, Pad

TAXELS: Final = USPA44.taxel_count
LEAST_COUNTS: Final = 300.0
"""Mean z below which a reading is not used: the face need not touch the whole pad."""
MOST_SHEAR_COUNTS: Final = 1390.0
"""Largest x or y of a reading that is used; chips are clipped at 1400."""
LEAST_DRAG_COUNTS: Final = 25.0
"""Least standard deviation of mean x or y within the grips that counts as a drag."""
FEATURES: Final = 6 * TAXELS
"""Logarithms of the slopes of z, of x and of y; slopes of x and y over mean z; logarithms of z over its mean."""
_MOST_BYTES: Final = 1 << 20
_BINS: Final = 12
"""Parts of a grip's range of mean z that have equal weight, however long a person holds each."""
_LEAST_SLOPE: Final = 0.05
_RIDGE: Final = (1e-3, 100.0, 100.0)
"""Added to the squares of mean z, x and y: without a drag, x and y follow z and must not explain it."""
_TILT: Final = 0.07
"""Tilt of a grip at which it counts half: a tilted face rocks as well, which changes the slopes."""


@dataclass(frozen=True, slots=True)
class FlatGripTable:
    """Joint normal distribution of the features of three flat grips and of the log-gains, over simulated sensors.

    Attributes:
        mean: (FEATURES + GAINS,).
        covariance: (FEATURES + GAINS, FEATURES + GAINS).
        widening: factor on deviations, so that 90 % intervals hold nine in ten gains of other simulated sensors.
    """

    mean: NDArray[np.floating]
    covariance: NDArray[np.floating]
    widening: float

    def gains(self, grips: Sequence[NDArray[np.floating]]) -> Pad | None:
        """Return the gains with half widths of their 90 % intervals; None where no grip was strong enough.

        Args:
            grips: zeroed readings (n, 3, rows, cols) of each, with z rising under pressure.
        """
        features = grip_features(grips)
        if features is None:
            return None
        there = np.flatnonzero(np.isfinite(features))
        covariance = self.covariance.astype(np.float64)
        gains = np.arange(FEATURES, FEATURES + GAINS)
        map_ = np.linalg.solve(covariance[np.ix_(there, there)], covariance[np.ix_(there, gains)]).T
        log_gains = self.mean[gains] + map_ @ (features[there] - self.mean[there])
        left = np.diag(covariance[np.ix_(gains, gains)] - map_ @ covariance[np.ix_(there, gains)])
        half = LEVEL_90 * self.widening * np.sqrt(left.clip(0))
        return Pad(
            gains=tuple(np.exp(log_gains).round(4).tolist()), gain_half_widths=tuple(half.clip(0, 1).round(4).tolist())
        )


def load_table(path: Path) -> FlatGripTable:
    """Load the table that `train.learning.flat_grips` has made.

    Raises:
        EdgeError: the file cannot be read, or is of another pad.
    """
    try:
        arrays = read_npz(path, ["mean", "covariance", "widening"], _MOST_BYTES)
        table = FlatGripTable(arrays["mean"], arrays["covariance"], float(arrays["widening"]))
        size = FEATURES + GAINS
        if table.mean.shape != (size,) or table.covariance.shape != (size, size):
            raise ValueError(f"covariance is {table.covariance.shape}, expected {(size, size)}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise EdgeError(
            f"{path} cannot be read ({error}): make it with 'python -m train.learning.flat_grips'"
        ) from error
    return table


def grip_features(grips: Sequence[NDArray[np.floating]]) -> NDArray[np.floating] | None:
    """Return the features of a sensor's grips; NaN for those of an axis without a drag, None without a strong grip."""
    used = [found for found in map(_used, grips) if found is not None]
    if not used:
        return None
    even = [_even_weight(means[:, 0]) for _, means in used]
    trust = [1 / (_TILT**2 + _tilt(read, means, weight) ** 2) for (read, means), weight in zip(used, even, strict=True)]
    bulge = _slopes(used, even)[0, : 2 * TAXELS]
    even = [one * share / sum(trust) for one, share in zip(even, trust, strict=True)]
    grown = _slopes(used, even)
    dragged = _slopes(used, [np.full(len(means), 1 / len(means)) for _, means in used])
    along = [grown[0, 2 * TAXELS :], dragged[1, :TAXELS], dragged[2, TAXELS : 2 * TAXELS]]
    features = [np.log(one.clip(_LEAST_SLOPE)) for one in along]
    drags = np.sqrt(np.mean([means[:, 1:].var(axis=0) for _, means in used], axis=0))
    for axis in np.flatnonzero(drags < LEAST_DRAG_COUNTS):
        features[1 + axis][:] = np.nan
    level = np.sum(
        [w @ read[:, 2 * TAXELS :] / (w @ means[:, 0]) * w.sum() for w, (read, means) in zip(even, used, strict=True)],
        axis=0,
    )
    return np.concatenate([*features, bulge, np.log(level.clip(_LEAST_SLOPE))])


def _used(grip: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the readings (n, GAINS) of a grip that are strong and unclipped, and their means of z, x and y, (n, 3)."""
    read = grip.reshape(len(grip), GAINS).astype(np.float64)
    x, y, z = (read[:, axis * TAXELS : (axis + 1) * TAXELS].mean(axis=1) for axis in range(len(AXES)))
    fit = (z > LEAST_COUNTS) & (np.abs(read[:, : 2 * TAXELS]).max(axis=1) < MOST_SHEAR_COUNTS)
    if np.count_nonzero(fit) <= len(AXES) or np.ptp(z[fit]) < LEAST_COUNTS:
        return None
    return read[fit], np.stack([z, x, y], axis=1)[fit]


def _tilt(read: NDArray[np.float64], means: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    """Return the tilt of the face in a grip: the plane in z's level over that in its slope, per pitch."""
    z, mean = read[:, 2 * TAXELS :], means[:, 0]
    centred = (mean - weight @ mean) * weight
    off = weight @ z / (weight @ mean) - centred @ z / (centred @ mean)
    row, col = np.divmod(np.arange(TAXELS), USPA44.cols) - np.full((2, 1), 1.5)
    return float(np.hypot(off @ row, off @ col) / (row @ row))


def _slopes(
    used: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]], weights: Sequence[NDArray[np.float64]]
) -> NDArray[np.floating]:
    """Return the slopes (3, GAINS) of readings over the means of z, x and y, with a level of its own for each grip."""
    square, product = np.diag(_RIDGE), np.zeros((3, GAINS))
    for (read, means), weight in zip(used, weights, strict=True):
        centred = (means - weight @ means / weight.sum()).T * weight
        square += centred @ means
        product += centred @ read
    return np.linalg.solve(square, product)


def _even_weight(z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return weights of sum 1 by which each part of the range of z counts alike."""
    span = np.ptp(z)
    part = ((z - z.min()) / max(span, 1e-9) * _BINS).astype(int).clip(0, _BINS - 1)
    count = np.bincount(part, minlength=_BINS)
    weight = 1.0 / count[part]
    return np.asarray(weight / weight.sum(), dtype=np.float64)
