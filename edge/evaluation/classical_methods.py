"""Classical methods: patterns without a network, which a model has to beat."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.errors import EdgeError
from firmware_bridge.recording.npz_recording import read_npz

CONTACT_LEVEL: Final = 0.5  # share of the maximum from which a pixel is touched: the edge of a blurred step

# Function from newest taps (n, 3, rows, cols) in zeroed counts to patterns (n, H, W) in [mm].
Method = Callable[[NDArray[np.floating]], NDArray[np.floating]]


def fitted_methods(path: Path, scale: int) -> dict[str, Method]:
    """Return the methods by name, as fitted on training taps, at a scale in pixels per pitch, or raise an EdgeError."""
    try:
        arrays = read_npz(path, ("bilinear_gain", "linear_map", "bicubic_gain"), 1 << 28)
        gain, matrix, cubic_gain = float(arrays["bilinear_gain"]), arrays["linear_map"], float(arrays["bicubic_gain"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise EdgeError(f"{path} cannot be read ({error}): make it with 'python -m train.freeze'") from error

    def by_map(newest: NDArray[np.floating]) -> NDArray[np.floating]:
        rows, cols = newest.shape[-2:]
        return (newest.reshape(len(newest), -1) @ matrix).reshape(-1, rows * scale, cols * scale)

    return {
        "bilinear": lambda newest: bilinear(newest[:, 2], scale) * gain,
        "linear map": by_map,
        "bicubic": lambda newest: bicubic(newest[:, 2], scale) * cubic_gain,
    }


def bilinear(taxel_values: NDArray[np.floating], scale: int) -> NDArray[np.float64]:
    """Interpolate taxels, each in the middle of its pixels, to (..., rows*scale, cols*scale); outside they are held."""
    rows, cols = taxel_values.shape[-2:]
    return _weights(rows, scale) @ taxel_values @ _weights(cols, scale).T


def _weights(taxels: int, scale: int) -> NDArray[np.float64]:
    """Return the interpolation matrix (taxels*scale, taxels) along one axis."""
    position = np.clip((np.arange(taxels * scale) + 0.5) / scale - 0.5, 0, taxels - 1)
    return np.maximum(0, 1 - np.abs(position[:, None] - np.arange(taxels)))


def bicubic(taxel_values: NDArray[np.floating], scale: int) -> NDArray[np.float64]:
    """Interpolate as `bilinear` does, yet by cubic convolution; the curve between taxels may overshoot.

    Source: Keys 1981, Eq. 4, with a = -1/2 (Catmull-Rom), which alone is exact on parabolas.
    """
    rows, cols = taxel_values.shape[-2:]
    return _cubic_weights(rows, scale) @ taxel_values @ _cubic_weights(cols, scale).T


def _cubic_weights(taxels: int, scale: int) -> NDArray[np.float64]:
    """Return the interpolation matrix (taxels*scale, taxels) along one axis, over the two taxels on either side."""
    position = (np.arange(taxels * scale) + 0.5) / scale - 0.5
    matrix, a = np.zeros((taxels * scale, taxels)), -0.5
    for offset in (-1, 0, 1, 2):
        neighbour = np.floor(position).astype(int) + offset
        x = np.abs(position - neighbour)  # in pitches, 0 to 2
        near, far = (a + 2) * x**3 - (a + 3) * x**2 + 1, a * (x**3 - 5 * x**2 + 8 * x - 4)
        np.add.at(matrix, (np.arange(len(matrix)), np.clip(neighbour, 0, taxels - 1)), np.where(x <= 1, near, far))
    return matrix


def fit_gain(interpolated: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
    """Return the one factor that brings interpolated maps nearest to the truth, least squares; shapes equal."""
    x, y = np.asarray(interpolated, dtype=np.float64).ravel(), np.asarray(truth, dtype=np.float64).ravel()
    return float(x @ y / (x @ x))


def fit_linear_map(
    readings: NDArray[np.floating], patterns: NDArray[np.floating], ridge: float = 1e-4
) -> NDArray[np.float32]:
    """Return the matrix of least squares with readings (n, features) @ matrix ~ patterns (n, pixels).

    The ridge is the weight of the penalty on the matrix, as a share of the mean feature energy.
    """
    x, y = np.asarray(readings, dtype=np.float64), np.asarray(patterns, dtype=np.float64)
    gram = x.T @ x
    penalty = ridge * np.trace(gram) / gram.shape[0]
    return np.linalg.solve(gram + penalty * np.eye(gram.shape[0]), x.T @ y).astype(np.float32)
