"""Fit of the forward model of edge.inference.forward_model, and limits of the checks of a model's contract."""

import json
import math
from pathlib import Path
from typing import Final

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from edge.errors import ModelError
from edge.inference.contract import Contract
from edge.inference.forward_model import ForwardModel, condensed, features, forward_model
from edge.inference.small_network import small_network
from edge.inference.trust import QUIET_UNITS, Trust
from firmware_bridge.pad_geometry import AXES
from train.data.press_batches import COUNTS_PER_UNIT
from train.data.presses import PressSet
from train.errors import CheckpointError
from train.learning.contact_check import contact_check
from train.learning.tap_checks import tap_check
from train.physics.pad_draws import INPUTS, input_scale
from train.physics.sensor_noise import Nuisances

UNFAMILIAR: Final = 0.005
"""Share of simulated contacts whose readings are said to be those of no contact."""
FOREIGN: Final = 0.01
"""Share of earlier taps that are dropped although they belong."""


def load_trust(path: Path, validation: PressSet | None = None) -> Trust:
    """Return the forward model and checks of a file of train.trust, or those of a model with their limits.

    Args:
        path: of the file, or NAME.onnx.
        validation: presses of several taps, on pads of their own, by which limits are set.

    Raises:
        CheckpointError: absent or damaged, or without presses to set limits by.
    """
    try:
        if path.suffix == ".onnx":
            model = onnx.load(path, load_external_data=False)
            contract = Contract.from_metadata({entry.key: entry.value for entry in model.metadata_props})
            trust = contract.read_trust()
            if trust is None:
                raise ValueError("this model has no checks")
            if (contract.pad_inputs, contract.counts_per_unit) != (tuple(input_scale()), COUNTS_PER_UNIT):
                raise ValueError("this model has other inputs than a network of this release")
            return trust
        fitted = json.loads(path.read_text())
        forward = forward_model(fitted["forward"], len(INPUTS))
        contact, tap = (small_network(fitted[name]) for name in ("contact", "tap"))
    except (OSError, ValueError, KeyError, TypeError, DecodeError, ModelError) as error:
        reason = getattr(error, "strerror", None) or error
        raise CheckpointError(f"{path}: {reason}; make it with 'python -m train.trust {path} --data ...'") from error
    if validation is None:
        raise CheckpointError(f"{path}: its limits are set by presses: give --validation, or a model that has checks")
    return Trust(forward, contact_check(contact, validation, UNFAMILIAR), tap_check(tap, validation, FOREIGN))


_RIDGE: Final = 1e-6
_UNIT: Final = np.array(COUNTS_PER_UNIT)


def fit_forward_model(presses: PressSet) -> ForwardModel:
    """Fit the operator to the newest press of each sequence, read without nuisances, by least squares.

    Errors are relative to the amplitude.
    """
    clean = (presses.counts[:, 0] / _UNIT[:, None, None]).reshape(len(presses), -1)
    z = clean.reshape(len(clean), len(AXES), -1)[:, AXES.index("z")]
    size = np.sqrt((z**2).mean(axis=1))[:, None] + QUIET_UNITS
    maps = zip(presses.patterns.astype(np.float32), presses.traction_kpa.astype(np.float32), strict=True)
    inputs = condensed(np.stack([features(*one) for one in maps])) / size
    constants = presses.constants.astype(np.float64)
    columns = np.concatenate([inputs, *(inputs * constants[:, [number]] for number in range(len(INPUTS)))], axis=1)
    normal = columns.T @ columns
    normal += _RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal))
    weights = np.linalg.solve(normal, columns.T @ (clean / size))
    operator = weights.reshape(1 + len(INPUTS), inputs.shape[1], -1).transpose(0, 2, 1)
    left = (clean / size - columns @ weights).reshape(len(presses), len(AXES), -1)
    found = ForwardModel(
        operator=operator.astype(np.float32),
        noise=_noise().astype(np.float32),
        model_error=np.sqrt(np.mean(left**2, axis=(0, 2))).astype(np.float32),
    )
    return forward_model(found.to_json(), len(INPUTS))  # as the contract holds it


def _noise() -> NDArray[np.float64]:
    """Return the deviation of x, y, z from drift, the earth's field and noise, in network units."""
    usual = Nuisances()
    drift = usual.thermal_drift_counts * np.array([1 / 8, 1 / 8, 1.0])
    field = usual.earth_field_counts * math.sqrt(2 / 3)
    return np.sqrt(drift**2 + field**2 + usual.noise_counts**2) / _UNIT
