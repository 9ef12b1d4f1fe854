"""Calibration of deviations: intervals, the share of pixels that they cover, and the factor that corrects it.

A deviation becomes an interval as that of a Laplace density, which the networks are trained with: errors of patterns
are mostly small and occasionally large. At 90 % that is 1.63 deviations; a Gaussian's 1.64 is nearly the same. The
factor is an empirical quantile, so that level is correct on the data of the calibration for any density of the errors;
the other levels are as accurate as the Laplace density.
"""

from math import log, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge.evaluation import metrics

LEVEL = 0.9


def half_width_mm(deviation_mm: ArrayLike, level: float = LEVEL) -> NDArray[np.floating]:
    """Return half the width of the interval that holds a share `level` of a Laplace density, in [mm].

    Raises:
        ValueError: the level is not between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"level is {level}, expected a share between 0 and 1")
    return np.asarray(deviation_mm) * (-log(1 - level) / sqrt(2))


def interval_coverage(truth: ArrayLike, pattern: ArrayLike, deviation: ArrayLike, level: float = LEVEL) -> float:
    """Return the share of pixels whose truth lies within their interval; arrays of one shape, in [mm].

    Raises:
        ValueError: shapes differ, there are no pixels, or the level is not between 0 and 1.
    """
    _errors(truth, pattern, deviation)
    return float(metrics.interval_coverage(pattern, truth, half_width_mm(deviation, level)).mean())


def calibrate(truth: ArrayLike, pattern: ArrayLike, deviation: ArrayLike, level: float = LEVEL) -> float:
    """Return the factor on the deviations with which their intervals cover a share `level` of these pixels.

    Raises:
        ValueError: shapes differ, there are no pixels, a deviation is not above zero, or the level is not between 0
            and 1.
    """
    errors = _errors(truth, pattern, deviation)
    widths = half_width_mm(deviation, level)
    if not np.all(widths > 0):
        raise ValueError("a deviation is not above zero: nothing can be scaled to cover its error")
    return float(np.quantile(errors / widths, level, method="higher"))


def _errors(truth: ArrayLike, pattern: ArrayLike, deviation: ArrayLike) -> NDArray[np.floating]:
    true, found = np.asarray(truth), np.asarray(pattern)
    if not true.shape == found.shape == np.shape(deviation) or not true.size:
        raise ValueError(
            f"truth, pattern and deviation of shapes {true.shape}, {found.shape} and {np.shape(deviation)},"
            " expected equal ones with pixels in them"
        )
    return np.abs(true - found)
