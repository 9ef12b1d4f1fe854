"""Peer without a learned shape: linear-Gaussian fusion of taps with known poses, the idea of TactileAR.

A pattern is a Gaussian field with an isotropic covariance, fitted to training patterns. A tap's readings are a linear
operator of the cells under the pad, which its pose puts into the field; all else is Gaussian error with its
covariance: what the operator leaves, and the sensor's drift and gains, which all taps share. The estimate is that of a
Kalman filter over the taps, computed in one step; a second one counts errors of the poses, by how readings change with
them.
"""

from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from edge.inference.familiarity import QUIET_UNITS
from edge.inference.forward_model import pooling
from firmware_bridge.pad_geometry import AXES, USPA44
from train.data.batches import COUNTS_PER_UNIT
from train.data.generation_config import SEED
from train.data.press_batches import read_presses
from train.data.presses import PressSet
from train.physics.sensor_noise import GAIN_SPREAD, Nuisances

_SIDE_MM: Final = USPA44.rows * USPA44.pitch_mm
_UNIT: Final = np.array(COUNTS_PER_UNIT)
_READINGS: Final = len(AXES) * USPA44.rows * USPA44.cols
_LENGTHS_MM: Final = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.5, 7.0, 12.0, 40.0)
"""Lengths of the Gaussians whose sum is the covariance of patterns; the longest is nearly a constant."""
_RIDGE: Final = 1e-5
_TABLE_STEP_MM2: Final = 0.02
SHARED: Final = 0.45
"""Share of the operator's error that all taps have in common: one pad, one shape."""
_DEPTH_SPREAD: Final = 0.087
"""Spread of an earlier tap's depth over the newest one's: drawn evenly from .85 to 1.15."""
DOUBT: Final = 2.0
"""Regularisation with the highest PSNR of four taps on validation presses of all families, in all four schedules.
SHARED was chosen with it."""
_DRIFT_OF_TAXEL: Final = 0.25
"""Share of the drift that is a taxel's own."""


@dataclass(frozen=True)
class KalmanFusion:
    """Linear map from taps and their poses to a pattern.

    Attributes:
        operator: (48, cells), from the means of a pattern's cells to readings in network units.
        left: (48, 48), covariance of what the operator leaves, over the square of the readings' amplitude.
        weights: weight of each of _LENGTHS_MM in the covariance of patterns over that amplitude, in [mm^2].
        shared: share of `left` that all taps have in common, because they are of one pad and one shape.
        doubt: factor on `left`.
    """

    operator: NDArray[np.float64]
    left: NDArray[np.float64]
    weights: NDArray[np.float64]
    shared: float = SHARED
    doubt: float = DOUBT

    def __call__(
        self, windows: NDArray[np.floating], poses: NDArray[np.floating], side_px: int = 40
    ) -> NDArray[np.float32]:
        """Return the newest tap's patterns (n, side_px, side_px) in [mm].

        Args:
            windows: (n, K, 3, rows, cols), zeroed counts, newest tap first.
            poses: (n, K, 5), each tap's x, y in [mm] and turn in [deg] in the newest one's axes, and the standard
                deviations of its place and turn.
            side_px: pixels along a side.
        """
        table = _Table(self.weights, _SIDE_MM / self._side)
        fine = _Table(self.weights, 0.0)
        pixels = _centres(side_px)
        found = [self._pattern(*one, table, fine, pixels) for one in zip(windows, poses, strict=True)]
        return np.array(found, dtype=np.float32).reshape(-1, side_px, side_px)

    @property
    def _side(self) -> int:
        return round(self.operator.shape[1] ** 0.5)

    def _pattern(
        self,
        window: NDArray[np.floating],
        poses: NDArray[np.floating],
        table: "_Table",
        fine: "_Table",
        pixels: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        poses = poses.astype(np.float64)
        readings = (window / _UNIT[:, None, None]).reshape(len(window), -1).astype(np.float64)
        size = np.sqrt(np.mean(readings.reshape(-1, len(AXES), 16)[:, AXES.index("z")] ** 2)) + QUIET_UNITS
        own = _centres(self._side)
        places = [_placed(own, pose) for pose in poses]
        covariance = self._errors(readings, poses[:, 2], float(size))
        for a, b in product(range(len(places)), repeat=2):
            if b <= a:
                block = size**2 * self.operator @ table(places[a], places[b]) @ self.operator.T
                covariance[a, :, b] += block
                if b < a:
                    covariance[b, :, a] += block.T
        square = covariance.reshape(readings.size, readings.size)
        solved = np.linalg.solve(square, readings.ravel()).reshape(readings.shape)
        if poses[1:, 3:].any():
            slopes = self._slopes(own, poses, places, solved, table) * size**2
            for tap in range(1, len(poses)):
                spread = slopes[tap] * poses[tap, [3, 3, 4]]
                covariance[tap, :, tap] += spread @ spread.T
            solved = np.linalg.solve(square, readings.ravel()).reshape(readings.shape)
        cells = solved @ self.operator
        found = sum(fine(pixels, place) @ weight for place, weight in zip(places, cells, strict=True))
        return np.maximum(size**2 * np.asarray(found), 0)

    def _errors(self, readings: NDArray[np.float64], turn_deg: NDArray[np.float64], size: float) -> NDArray[np.float64]:
        """Return the covariance (K, 48, K, 48) of readings about those of the pattern."""
        taps = len(readings)
        same = np.eye(taps)
        blocks = np.einsum("ab,ij->aibj", self.shared + (1 - self.shared) * same, self.doubt * size**2 * self.left)
        usual = Nuisances()
        taxel = np.eye(_READINGS)
        axis = np.kron(np.eye(len(AXES)), np.ones((16, 16)))
        unit = np.repeat(_UNIT, 16)
        drift = usual.thermal_drift_counts * np.repeat([1 / 8, 1 / 8, 1.0], 16) / unit
        blocks += (np.outer(drift, drift) * (axis + _DRIFT_OF_TAXEL**2 * taxel))[None, :, None]
        turned = np.cos(np.radians(turn_deg[:, None] - turn_deg))
        earth = 1 / 3 + np.stack([turned, turned, np.ones_like(turned)]) / 3  # zeroed at another attitude
        field = (usual.earth_field_counts / unit) ** 2
        blocks += np.einsum("iab,ij->aibj", np.repeat(earth, 16, axis=0), axis * np.sqrt(np.outer(field, field)))
        blocks += np.einsum("ab,ij->aibj", same, taxel * (usual.noise_counts / unit) ** 2)
        for channel in range(_READINGS):
            blocks[:, channel, :, channel] += GAIN_SPREAD**2 * np.outer(readings[:, channel], readings[:, channel])
        for tap in range(1, taps):
            blocks[tap, :, tap] += _DEPTH_SPREAD**2 * np.outer(readings[tap], readings[tap])
        return blocks

    def _slopes(
        self,
        own: NDArray[np.float64],
        poses: NDArray[np.float64],
        places: list[NDArray[np.float64]],
        solved: NDArray[np.floating],
        table: "_Table",
    ) -> NDArray[np.float64]:
        """Return by how much a tap's readings change per mm of x, y and per degree, (K, 48, 3)."""
        slopes = np.zeros((len(poses), _READINGS, 3))
        for tap in range(1, len(poses)):
            for column, step in enumerate((0.3, 0.3, 1.0)):
                ends: list[NDArray[np.float64]] = []
                for sign in (-1, 1):
                    moved = poses[tap].copy()
                    moved[column] += sign * step
                    at = _placed(own, moved)
                    cells = solved @ self.operator
                    ends.append(sum((table(at, one) @ c for one, c in zip(places, cells, strict=True)), np.zeros(1)))
                slopes[tap, :, column] = self.operator @ (ends[1] - ends[0]) / (2 * step)
        return slopes


class _Table:
    """Covariance of a field's values by distance; of means over cells of a width, or of points against such cells."""

    def __init__(self, weights: NDArray[np.float64], width_mm: float, most_mm: float = 60.0) -> None:
        square = np.arange(0, most_mm**2, _TABLE_STEP_MM2) + _TABLE_STEP_MM2 / 2
        self._values = _covariances(square, width_mm**2 / 6) @ weights

    def __call__(self, some: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the covariance (n, m) between places (n, 2) and (m, 2) in [mm]."""
        apart = np.square(some).sum(1)[:, None] + np.square(others).sum(1) - 2 * some @ others.T
        return self._values[(apart.clip(0) / _TABLE_STEP_MM2).astype(np.int64)]


def _covariances(square_mm2: NDArray[np.float64], widening_mm2: float) -> NDArray[np.float64]:
    """Return each Gaussian (..., lengths) of squared distances; means over cells widen and lower it."""
    length2 = np.square(_LENGTHS_MM)
    wide = length2 + widening_mm2
    return length2 / wide * np.exp(-square_mm2[..., None] / (2 * wide))


def _centres(side: int) -> NDArray[np.float64]:
    """Return x, y of the centres of side x side cells from the pad's centre, (side^2, 2) in [mm]."""
    along = ((np.arange(side) + 0.5) / side - 0.5) * _SIDE_MM
    x, y = np.meshgrid(along, along)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _placed(own: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return places on a pad in the newest tap's axes."""
    cosine, sine = np.cos(np.radians(pose[2])), np.sin(np.radians(pose[2]))
    return own @ np.array([[cosine, sine], [-sine, cosine]]) + pose[:2]


def fit(presses: PressSet, side: int = 16) -> KalmanFusion:
    """Fit operator and covariances to the newest press of each sequence.

    Args:
        presses: to train on.
        side: cells of a pattern along a side.
    """
    plain = Nuisances().without("gain_spread", "thermal_drift_counts", "earth_field_counts", "noise_counts")
    read = read_presses(presses.with_taps(1), plain, SEED)[:, 0]
    readings = (read / _UNIT[:, None, None]).reshape(len(read), -1)
    size = np.sqrt(np.mean(readings.reshape(-1, len(AXES), 16)[:, AXES.index("z")] ** 2, axis=1)) + QUIET_UNITS
    readings /= size[:, None]
    patterns = presses.patterns.astype(np.float32) / size[:, None, None].astype(np.float32)
    pool = pooling(patterns.shape[-1], side)
    cells = np.einsum("ai,nij,bj->nab", pool, patterns, pool, optimize=True).reshape(len(read), -1)
    normal = cells.T @ cells
    normal += _RIDGE * np.trace(normal) * np.eye(len(normal)) / len(normal)
    operator = np.linalg.solve(normal, cells.T @ readings).T
    rest = readings - cells @ operator.T
    return KalmanFusion(operator, rest.T @ rest / len(rest), _fit_covariance(patterns))


def _fit_covariance(patterns: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the weights of the Gaussians nearest to the mean products of pixels by their distance."""
    length = patterns.shape[-1]
    spectra = np.fft.rfft2(patterns, s=(2 * length, 2 * length))
    sums = np.fft.irfft2((np.abs(spectra) ** 2).mean(axis=0), s=(2 * length, 2 * length))
    overlap = length - np.abs(np.fft.fftfreq(2 * length, 1 / (2 * length)))
    pairs = np.outer(overlap, overlap)
    lag_mm = (length - overlap) * _SIDE_MM / length
    square = lag_mm[:, None] ** 2 + lag_mm**2
    used = pairs >= length**2 / 4
    weight = np.sqrt(pairs[used])
    columns = _covariances(square[used], 0.0) * weight[:, None]
    weights, _ = nnls(columns, sums[used] / pairs[used] * weight)
    return weights
