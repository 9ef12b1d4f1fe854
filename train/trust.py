"""Fit the forward model and the checks by which a model states which patterns are not to be believed, into one file.

    python -m train.trust checkpoints/trust.json --data data/gripped.npz data/taps4.npz

`export.to_onnx` puts them into the contract of every model of the same folder, with limits set on validation presses.
"""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx
from google.protobuf.message import DecodeError

from edge.errors import ModelError
from edge.inference.contract import Contract
from edge.inference.trust_model import (
    DAMAGE,
    QUIET_UNITS,
    ForwardModel,
    Trust,
    condensed,
    features,
    forward_model,
    small_network,
)
from firmware_bridge.in_place import check_writable, write_in_place
from firmware_bridge.pad_geometry import AXES
from train.data.press_batches import COUNTS_PER_UNIT
from train.data.presses import PressSet, join_presses, load_presses
from train.errors import CheckpointError, DatasetError, ended_by_errors
from train.learning.checks import contact_check, fit_contact_network, fit_tap_network, tap_check
from train.physics.pad_draws import INPUTS, input_scale
from train.physics.sensor_noise import Nuisances

UNFAMILIAR: Final = 0.005  # share of simulated contacts whose readings are said to be those of no contact
FOREIGN: Final = 0.01  # share of earlier taps that are dropped although they belong


def load_trust(path: Path, validation: PressSet | None = None) -> Trust:
    """Return the forward model and checks of a file of this command, or those of NAME.onnx with their limits.

    The limits of a file's are set by `validation`, presses of several taps. CheckpointError if one of them is missing.
    """
    try:
        if path.suffix == ".onnx":
            return _trust_of(onnx.load(path, load_external_data=False))
        fitted = json.loads(path.read_text())
        forward = forward_model(fitted["forward"], len(INPUTS))
        contact, tap = (small_network(fitted[name]) for name in ("contact", "tap"))
    except (OSError, DecodeError, ModelError, *DAMAGE) as error:
        reason = getattr(error, "strerror", None) or error
        raise CheckpointError(f"{path}: {reason}; make it with 'python -m train.trust {path} --data ...'") from error
    if validation is None:
        raise CheckpointError(f"{path}: its limits are set by presses: give --validation, or a model that has checks")
    return Trust(forward, contact_check(contact, validation, UNFAMILIAR), tap_check(tap, validation, FOREIGN))


def _trust_of(model: onnx.ModelProto) -> Trust:
    contract = Contract.from_metadata({entry.key: entry.value for entry in model.metadata_props})
    trust = contract.read_trust()
    if trust is None:
        raise ValueError("this model has no checks")
    if (contract.pad_inputs, contract.counts_per_unit) != (tuple(input_scale()), COUNTS_PER_UNIT):
        raise ValueError("this model has other inputs than a network of this release")
    return trust


def fit_trust(presses: PressSet, seed: int, contact_steps: int = 40_000, tap_steps: int = 20_000) -> dict[str, Any]:
    """Fit forward model, check of contacts, and check of earlier taps, or DatasetError where all have one tap."""
    several = presses.pick(np.flatnonzero(presses.counts.any(axis=(2, 3, 4)).sum(axis=1) > 1))
    if not len(several):
        raise DatasetError("no sequences of several taps: add a file of 'make_presses --taps 4'")
    return {
        "forward": fit_forward_model(presses).to_json(),
        "contact": fit_contact_network(presses, seed, contact_steps).to_json(),
        "tap": fit_tap_network(several, seed, tap_steps).to_json(),
        "data_sha256": presses.sha256(),
    }


def fit_forward_model(presses: PressSet) -> ForwardModel:
    """Fit the operator to the newest press of each sequence, read without nuisances, by least squares.

    Errors are relative to the amplitude. The noise is the deviation of x, y, z from drift, the earth's field and noise.
    """
    unit = np.array(COUNTS_PER_UNIT)
    clean = (presses.counts[:, 0] / unit[:, None, None]).reshape(len(presses), -1)
    z = clean.reshape(len(clean), len(AXES), -1)[:, AXES.index("z")]
    size = np.sqrt((z**2).mean(axis=1))[:, None] + QUIET_UNITS
    maps = zip(presses.patterns.astype(np.float32), presses.traction_kpa.astype(np.float32), strict=True)
    inputs = condensed(np.stack([features(pattern, traction) for pattern, traction in maps])) / size
    constants = presses.constants.astype(np.float64)
    columns = np.concatenate([inputs, *(inputs * constants[:, [number]] for number in range(len(INPUTS)))], axis=1)
    normal = columns.T @ columns
    normal += 1e-6 * np.trace(normal) / len(normal) * np.eye(len(normal))
    weights = np.linalg.solve(normal, columns.T @ (clean / size))
    operator = weights.reshape(1 + len(INPUTS), inputs.shape[1], -1).transpose(0, 2, 1)
    left = (clean / size - columns @ weights).reshape(len(presses), len(AXES), -1)
    usual = Nuisances()
    drift = usual.thermal_drift_counts * np.array([1 / 8, 1 / 8, 1.0])
    field = usual.earth_field_counts * math.sqrt(2 / 3)
    noise = np.sqrt(drift**2 + field**2 + usual.noise_counts**2) / unit
    model_error = np.sqrt(np.mean(left**2, axis=(0, 2)))
    fitted = ForwardModel(operator.astype(np.float32), noise.astype(np.float32), model_error.astype(np.float32))
    return forward_model(fitted.to_json(), len(INPUTS))  # as the contract holds it


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m train.trust", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT.json", help="trust.json in the folder of the checkpoints")
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="files of train.data.make_presses")
    options = parser.parse_args(arguments)
    with ended_by_errors("trust"):
        options.out.parent.mkdir(parents=True, exist_ok=True)
        check_writable(options.out)  # before minutes are spent on it
        data = join_presses([*map(load_presses, options.data)])
        text = json.dumps(fit_trust(data, seed=1)) + "\n"
        write_in_place(options.out, lambda draft: draft.write_text(text), lambda draft: json.loads(draft.read_text()))
    sys.stdout.write(f"{options.out}: {len(text) / 1e3:.0f} kB\n")


if __name__ == "__main__":
    main()
