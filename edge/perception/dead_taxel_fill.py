"""Estimate of dead taxels from the living ones.

Readings are modelled as drawn from one of several kinds of contact, each a zero-mean Gaussian of any scale: the edge of
a figure, a face over the whole pad. The living taxels give the probability of each kind, and each kind an estimate.
"""

import math
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.errors import EdgeError
from firmware_bridge.recording.npz_recording import read_npz

WIDENING: Final = (1.0, 1.05, 1.12, 1.19, 1.29, 1.36, 1.47, 1.61, 1.79)
"""Factors on deviations with 0 to 8 of sixteen taxels dead, so that 90 % intervals hold 90 % of pixels of validation
presses. They may be too small on contacts unlike those of training."""
MOST_KINDS: Final = 64
_AXES: Final = 3


class TaxelEstimator:
    """Estimator of dead taxels of a grid (rows, cols), fitted on readings of simulated presses.

    Covariances (kinds, 3 taxels, 3 taxels) are of zeroed counts about zero, of any scale, x of all taxels first,
    row-major, then y, z.

    Raises:
        EdgeError: the covariances are of another grid, or not positive definite.
    """

    def __init__(self, covariances: NDArray[np.floating], grid_shape: tuple[int, int]) -> None:
        channels = _AXES * grid_shape[0] * grid_shape[1]
        shape = covariances.shape
        if len(shape) != 3 or shape[1:] != (channels, channels) or not 0 < shape[0] <= MOST_KINDS:
            raise EdgeError(
                f"covariances are {shape}, expected (1 to {MOST_KINDS}, {channels}, {channels}): freeze them again"
            )
        exact = covariances.astype(np.float64)
        if not np.isfinite(exact).all() or not (np.linalg.eigvalsh(exact)[:, 0] > -ridge_of(exact)).all():
            raise EdgeError("covariances are not positive definite: freeze them again")
        self._grid_shape = grid_shape
        self._covariances = ridged(exact)

    def filler(self, dead: NDArray[np.bool_]) -> "Filler":
        """Return the filler for the taxels `dead` (rows, cols), some of which must be alive."""
        if dead.shape != self._grid_shape or dead.all():
            raise EdgeError(
                f"{np.count_nonzero(dead)} dead taxels of {dead.shape}, expected fewer, of {self._grid_shape}"
            )
        return Filler(dead, self._covariances)


class Filler:
    """Filler for the same dead taxels scan after scan; computes once all that does not depend on readings."""

    def __init__(self, dead: NDArray[np.bool_], covariances: NDArray[np.float64]) -> None:
        off = np.tile(dead.ravel(), _AXES)
        self._dead, self._live = np.flatnonzero(off), np.flatnonzero(~off)
        living = covariances[:, self._live[:, None], self._live]
        self._kinds = Kinds(living)
        self._maps = np.linalg.solve(living, covariances[:, self._live[:, None], self._dead]).transpose(0, 2, 1)

    def __call__(self, zeroed: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return one scan (3, rows, cols) in zeroed counts with estimates in the place of dead taxels."""
        living = zeroed.ravel()[self._live].astype(np.float64)
        counts = zeroed.copy()
        counts.flat[self._dead] = self._kinds.weigh(living[None])[0] @ (self._maps @ living)
        return counts


class Kinds:
    """Probabilities of kinds of contact, equally frequent, by their covariances (kinds, n, n) of readings of any scale.

    Source: Tyler 1987, angular central Gaussian.
    """

    def __init__(self, covariances: NDArray[np.float64]) -> None:
        factors = np.linalg.cholesky(covariances)
        self._whiteners = np.linalg.inv(factors)
        self._log_sizes = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)

    def weigh(self, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the probability of each kind, (m, kinds), from readings (m, n)."""
        square = np.square(self._whiteners @ readings.T).sum(axis=1) + np.finfo(np.float64).tiny
        log_weight = -readings.shape[1] / 2 * np.log(square) - self._log_sizes[:, None]
        weight = np.exp(log_weight - log_weight.max(axis=0))
        return (weight / weight.sum(axis=0)).T


def ridged(covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return covariances (kinds, n, n) with the ridge added to the diagonal of each."""
    return covariances + ridge_of(covariances)[:, None, None] * np.eye(covariances.shape[1])


def ridge_of(covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ridge in squared counts for each of (kinds, n, n), for gains and noise of the individual sensor."""
    return 2e-3 * np.trace(covariances, axis1=1, axis2=2) / covariances.shape[1]


def widening(dead_share: float) -> float:
    """Return the factor on deviations where this share of the taxels is dead; at most half of them are."""
    return WIDENING[min(math.ceil(dead_share * 16), len(WIDENING) - 1)]


def load_estimator(path: Path, grid_shape: tuple[int, int]) -> TaxelEstimator:
    """Load the covariances that `train.freeze` computed from simulated presses.

    Raises:
        EdgeError: the file cannot be read, or is of another grid.
    """
    try:
        covariances = read_npz(path, ["covariances"], 1 << 24)["covariances"]
    except (OSError, ValueError, KeyError) as error:
        raise EdgeError(f"{path} cannot be read ({error}): make it with 'python -m train.freeze'") from error
    return TaxelEstimator(covariances, grid_shape)
