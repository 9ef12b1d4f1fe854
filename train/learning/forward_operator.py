"""Fit of the forward model of edge.inference.forward_model to simulated presses."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.familiarity import QUIET_UNITS
from edge.inference.forward_model import ForwardModel, condensed, features, forward_model
from firmware_bridge.pad_geometry import AXES
from train.data.batches import COUNTS_PER_UNIT
from train.data.presses import PressSet
from train.physics.pad_draws import INPUTS
from train.physics.sensor_noise import Nuisances

_RIDGE: Final = 1e-6
_UNIT: Final = np.array(COUNTS_PER_UNIT)


def fit_forward_model(presses: PressSet) -> ForwardModel:
    """Fit the operator to the newest press of each sequence, read without nuisances, by least squares.

    Errors are relative to the amplitude.
    """
    clean = _units(presses.counts[:, 0])
    size = _amplitude(clean)[:, None]
    inputs = condensed(np.stack([features(*maps) for maps in zip(*_maps(presses), strict=True)])) / size
    constants = presses.constants.astype(np.float64)
    columns = np.concatenate([inputs, *(inputs * constants[:, [number]] for number in range(len(INPUTS)))], axis=1)
    weights = _least_squares(columns, clean / size)
    operator = weights.reshape(1 + len(INPUTS), inputs.shape[1], -1).transpose(0, 2, 1)
    left = (clean / size - columns @ weights).reshape(len(presses), len(AXES), -1)
    found = ForwardModel(
        operator=operator.astype(np.float32),
        noise=_noise().astype(np.float32),
        model_error=np.sqrt(np.mean(left**2, axis=(0, 2))).astype(np.float32),
    )
    return forward_model(found.to_json(), len(INPUTS))  # as the contract holds it


def _maps(presses: PressSet) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    return presses.patterns.astype(np.float32), presses.traction_kpa.astype(np.float32)


def _units(counts: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return readings (n, 3, rows, cols) in counts as (n, channels) in network units."""
    return (counts / _UNIT[:, None, None]).reshape(len(counts), -1)


def _amplitude(readings: NDArray[np.float64]) -> NDArray[np.float64]:
    z = readings.reshape(len(readings), len(AXES), -1)[:, AXES.index("z")]
    return np.sqrt((z**2).mean(axis=1)) + QUIET_UNITS


def _least_squares(columns: NDArray[np.floating], values: NDArray[np.floating]) -> NDArray[np.float64]:
    normal = columns.T @ columns
    normal += _RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal))
    return np.linalg.solve(normal, columns.T @ values)


def _noise() -> NDArray[np.float64]:
    """Return the deviation of x, y, z from drift, the earth's field and noise, in network units."""
    usual = Nuisances()
    drift = usual.thermal_drift_counts * np.array([1 / 8, 1 / 8, 1.0])
    field = usual.earth_field_counts * math.sqrt(2 / 3)
    return np.sqrt(drift**2 + field**2 + usual.noise_counts**2) / _UNIT
