"""Patterns without a network: what a model has to beat."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.errors import EdgeError

CONTACT_LEVEL: Final = 0.5
"""Share of a pattern's maximum from which these methods call a pixel touched: the edge of a blurred step."""

Method = Callable[[NDArray[np.floating]], NDArray[np.floating]]
"""Newest taps (n, 3, rows, cols) in zeroed counts to patterns (n, H, W) in [mm]."""


def fitted_methods(path: Path, scale: int) -> dict[str, Method]:
    """The methods by name, with what was fitted on training taps.

    Args:
        path: npz of bilinear_gain () in mm per count, and linear_map (features, pixels).
        scale: pattern pixels per taxel pitch.

    Raises:
        EdgeError: the file cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            gain, matrix = float(arrays["bilinear_gain"]), arrays["linear_map"]
    except (OSError, ValueError, KeyError) as error:
        raise EdgeError(f"{path} cannot be read ({error}): make it with 'python -m train.freeze'") from error

    def by_gain(newest: NDArray[np.floating]) -> NDArray[np.floating]:
        return bilinear(newest[:, 2], scale) * gain

    def by_map(newest: NDArray[np.floating]) -> NDArray[np.floating]:
        rows, cols = newest.shape[-2:]
        return (newest.reshape(len(newest), -1) @ matrix).reshape(-1, rows * scale, cols * scale)

    return {"bilinear": by_gain, "linear map": by_map}


def bilinear(taxel_values: NDArray[np.floating], scale: int) -> NDArray[np.float64]:
    """Interpolate taxels (..., rows, cols) to (..., rows*scale, cols*scale).

    A taxel sits in the middle of its scale x scale pixels; outside the outer taxels the value is held.
    """
    rows, cols = taxel_values.shape[-2:]
    return _weights(rows, scale) @ taxel_values @ _weights(cols, scale).T


def _weights(taxels: int, scale: int) -> NDArray[np.float64]:
    """Interpolation matrix (taxels*scale, taxels) along one axis."""
    position = np.clip((np.arange(taxels * scale) + 0.5) / scale - 0.5, 0, taxels - 1)
    low = np.minimum(np.floor(position).astype(int), max(taxels - 2, 0))
    matrix = np.zeros((taxels * scale, taxels))
    pixel = np.arange(taxels * scale)
    matrix[pixel, low] = 1 - (position - low)
    matrix[pixel, np.minimum(low + 1, taxels - 1)] += position - low
    return matrix


def fit_gain(interpolated: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
    """The one factor that brings interpolated maps nearest to the truth, least squares; shapes equal."""
    x, y = np.asarray(interpolated, dtype=np.float64).ravel(), np.asarray(truth, dtype=np.float64).ravel()
    return float(x @ y / (x @ x))


def fit_linear_map(
    readings: NDArray[np.floating], patterns: NDArray[np.floating], ridge: float = 1e-4
) -> NDArray[np.float32]:
    """Least-squares matrix (features, pixels) with readings @ matrix ~ patterns.

    Args:
        readings: (n, features).
        patterns: (n, pixels).
        ridge: weight of the penalty on the matrix, as a share of the mean feature energy.
    """
    x, y = np.asarray(readings, dtype=np.float64), np.asarray(patterns, dtype=np.float64)
    gram = x.T @ x
    penalty = ridge * np.trace(gram) / gram.shape[0]
    return np.linalg.solve(gram + penalty * np.eye(gram.shape[0]), x.T @ y).astype(np.float32)
