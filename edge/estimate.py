"""What stands for dead taxels: nothing, where the network makes up for them best, else an estimate from the living.

Readings are taken as drawn from one of two zero-mean Gaussians: `trained`, whose covariance is that of simulated taps,
or `smooth`, the same with a part that varies little from taxel to taxel, as real grips do. Which of them, the living
taxels tell, whatever their scale. Networks were trained with dead taxels at rest, and on taps like those of training
they make up for them better than any linear estimate; on anything else they do not (reports/dead.md).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.errors import EdgeError
from edge.result import Filled
from firmware_bridge.npz import read_npz

RIDGE: Final = 1e-3
"""Of the mean variance, added to every channel: gains and noise of a sensor of its own."""
SMOOTH_SHARE: Final = 4.0
"""Of the smooth part's variance to the taps'."""
SMOOTH_PITCHES: Final = 3.0
"""Over which it falls by exp(-1/2)."""
UNLIKE_TRAINED: Final = 1.0
"""Log likelihood ratio a living channel, from which readings are `smooth`: 99 of 100 simulated taps lie below .5, 99 of
100 scans of real grips above 1.5, with 0 to 8 taxels dead."""
HYSTERESIS: Final = 0.25
"""By which it must pass that line to change what is filled in from scan to scan."""
WIDENING: Final = (1.0, 1.05, 1.16, 1.28, 1.43, 1.71, 1.95, 2.44, 3.8)
"""Of deviations with so many taxels dead, that 90 % intervals hold 90 % of pixels: at the validation position, the
larger of STSR's and MTSR-4's. On readings unlike those of training nobody knows the truth; there it may be too little.
"""
MOST_BYTES: Final = 1 << 24
_AXES: Final = 3
_Z: Final = 2


@dataclass(frozen=True, slots=True)
class Readings:
    """Readings with something in the place of dead taxels.

    Attributes:
        counts: (3, rows, cols) float32, for the network; finite.
        z_counts: summed z, of dead taxels the estimated one.
        filled: what stands for them.
    """

    counts: NDArray[np.float32]
    z_counts: float
    filled: Filled


class TaxelEstimator:
    """Estimates dead taxels by the covariance of simulated taps.

    Args:
        covariance: (3 taxels, 3 taxels) of zeroed counts about zero, x of all taxels first, row-major, then y, z.
        grid_shape: (rows, cols).

    Raises:
        EdgeError: the covariance is of another grid, or not one.
    """

    def __init__(self, covariance: NDArray[np.floating], grid_shape: tuple[int, int]) -> None:
        channels = _AXES * grid_shape[0] * grid_shape[1]
        if covariance.shape != (channels, channels) or not np.isfinite(covariance).all():
            raise EdgeError(
                f"covariance is {covariance.shape}, expected {(channels, channels)}, finite: freeze it again"
            )
        self._grid_shape = grid_shape
        exact = covariance.astype(np.float64)
        if not np.linalg.eigvalsh((exact + exact.T) / 2)[0] > -RIDGE * np.trace(exact) / channels:
            raise EdgeError("covariance is not positive definite: freeze it again")
        self._trained = exact + RIDGE * np.trace(exact) / channels * np.eye(channels)
        self._smooth = self._trained + SMOOTH_SHARE * _smooth_part(exact, grid_shape)

    def filler(self, dead: NDArray[np.bool_]) -> "Filler":
        """What fills in for `dead` (rows, cols), some of which live."""
        if dead.shape != self._grid_shape or dead.all():
            raise EdgeError(
                f"{np.count_nonzero(dead)} dead taxels of {dead.shape}, expected fewer, of {self._grid_shape}"
            )
        return Filler(dead, self._trained, self._smooth)


class Filler:
    """Fills in for the same dead taxels scan after scan; all that does not depend on readings is worked out before."""

    def __init__(self, dead: NDArray[np.bool_], trained: NDArray[np.float64], smooth: NDArray[np.float64]) -> None:
        off = np.tile(dead.ravel(), _AXES)
        self._dead, self._live = np.flatnonzero(off), np.flatnonzero(~off)
        count = len(self._live)
        whiteners, maps, log_sizes = [], [], []
        for covariance in (trained, smooth):
            living = covariance[np.ix_(self._live, self._live)]
            factor = np.linalg.cholesky(living)
            whiteners.append(np.linalg.inv(factor))
            maps.append(np.linalg.solve(living, covariance[np.ix_(self._live, self._dead)]).T)
            log_sizes.append(2 * np.log(np.diag(factor)).sum() / count)
        # One product does all: both whitenings, both estimates.
        self._matrix = np.concatenate(whiteners + maps)
        self._count = count
        self._bias = log_sizes[0] - log_sizes[1]
        self._z = self._dead >= _Z * dead.size
        self._unlike: bool | None = None

    def __call__(self, zeroed: NDArray[np.float32]) -> Readings:
        """Fill in one scan (3, rows, cols) in zeroed counts; what dead taxels read in it is not looked at."""
        counts, said = zeroed.copy(), self._matrix @ zeroed.ravel()[self._live]
        count, dead = self._count, len(self._dead)
        of_trained, of_smooth = said[:count], said[count : 2 * count]
        tiny = np.finfo(np.float64).tiny
        surprise = np.log((of_trained @ of_trained + tiny) / (of_smooth @ of_smooth + tiny)) + self._bias
        margin = 0.0 if self._unlike is None else -HYSTERESIS if self._unlike else HYSTERESIS
        unlike = self._unlike = bool(surprise > UNLIKE_TRAINED + margin)
        estimate = said[2 * count + dead * unlike :][:dead]
        counts.flat[self._dead] = estimate if unlike else 0
        z_counts = float(counts[_Z].sum()) + (0.0 if unlike else float(estimate[self._z].sum()))
        return Readings(counts, z_counts, "neighbours" if unlike else "rest")


def load_estimator(path: Path, grid_shape: tuple[int, int]) -> TaxelEstimator:
    """Read what `train.freeze` found of simulated taps.

    Raises:
        EdgeError: the file cannot be read, or is of another grid.
    """
    try:
        covariance = read_npz(path, ["covariance"], MOST_BYTES)["covariance"]
    except (OSError, ValueError, KeyError) as error:
        raise EdgeError(f"{path} cannot be read ({error}): make it with 'python -m train.freeze'") from error
    return TaxelEstimator(covariance, grid_shape)


def _smooth_part(covariance: NDArray[np.float64], grid_shape: tuple[int, int]) -> NDArray[np.float64]:
    """Each axis by itself, as strong as the covariance has it on average."""
    rows, cols = np.indices(grid_shape).reshape(2, -1)
    square = (rows[:, None] - rows) ** 2 + (cols[:, None] - cols) ** 2
    kernel = np.exp(-square / (2 * SMOOTH_PITCHES**2))
    variances: NDArray[np.float64] = np.diag(covariance).reshape(_AXES, -1).mean(axis=1)
    return np.kron(np.diag(variances), kernel).astype(np.float64)
