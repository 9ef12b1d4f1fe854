"""Fit the forward model and the checks by which a model states which patterns are not to be believed, into one file.

    python -m train.trust checkpoints/trust.json --data data/gripped.npz data/taps4.npz

`export.to_onnx` puts them into the contract of every model of the same folder, with limits set on validation presses.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from firmware_bridge.in_place import write_in_place
from train.data.presses import PressSet, join_presses, load_presses
from train.errors import DatasetError, TrainError
from train.learning.contact_check import fit_contact_network
from train.learning.tap_checks import fit_tap_network
from train.learning.trust_limits import fit_forward_model


def fit_trust(presses: PressSet, seed: int, shorten: int = 1) -> dict[str, Any]:
    """Fit forward model, check of contacts, and check of earlier taps by their poses; limits come at export.

    Raises:
        DatasetError: no sequence has several taps.
    """
    several = presses.pick(np.flatnonzero(presses.counts.any(axis=(2, 3, 4)).sum(axis=1) > 1))
    if not len(several):
        raise DatasetError("no sequences of several taps: add a file of 'make_presses --taps 4'")
    return {
        "forward": fit_forward_model(presses).to_json(),
        "contact": fit_contact_network(presses, seed, max(40_000 // shorten, 1)).to_json(),
        "tap": fit_tap_network(several, seed, max(20_000 // shorten, 1)).to_json(),
        "data_sha256": presses.sha256(),
    }


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m train.trust", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT.json", help="trust.json in the folder of the checkpoints")
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="files of train.data.make_presses")
    parser.add_argument("--shorten", type=int, default=1, help="divide the steps, to try things out (1)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    try:
        data = join_presses([*map(load_presses, options.data)])
        text = json.dumps(fit_trust(data, options.seed, options.shorten)) + "\n"
        options.out.parent.mkdir(parents=True, exist_ok=True)
        write_in_place(options.out, lambda draft: draft.write_text(text), lambda draft: json.loads(draft.read_text()))
    except TrainError as error:
        sys.exit(f"trust: {error}")
    except OSError as error:
        sys.exit(f"trust: {error.filename or options.out}: {error.strerror}")
    sys.stdout.write(f"{options.out}: {len(text) / 1e3:.0f} kB\n")


if __name__ == "__main__":
    main()
