"""Give models the checks of another, without their checkpoints, so that all judge a reading alike.

python -m export.checks edge/models/stsr.onnx edge/models/mtsr7.onnx edge/models/mtsr7-int8.onnx

A model of one's own gets those of a bundled one in the same way. Each keeps its check of earlier taps, if it has one.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import onnx
from google.protobuf.message import DecodeError

from edge.errors import EdgeError
from edge.inference.onnx_session import ModelSession
from export.errors import ExportError
from export.graphs.graph import contract_in
from firmware_bridge.in_place import write_in_place

_SAME = ("pad_inputs", "takes_gains", "counts_per_unit", "output_full_scale", "sensor")
"""Keys of the contract on which the checks depend."""


def give_checks(source: Path, path: Path) -> None:
    """Put the checks of the model at `source` into the one at `path`.

    Raises:
        ExportError: the source has no checks, or the models differ in what the checks depend on.
    """
    theirs = contract_in(onnx.load(source))
    model = onnx.load(path)
    contract = contract_in(model)
    trust, own = theirs.read_trust(), contract.read_trust()
    if trust is None:
        raise ExportError(f"{source} has no checks")
    differing = [key for key in _SAME if getattr(contract, key) != getattr(theirs, key)]
    if own is None and contract.takes_poses != theirs.takes_poses:
        differing.append("takes_poses")
    if differing:
        raise ExportError(f"{path} differs from {source} in {', '.join(differing)}: make its checks with train.trust")
    trust = trust if own is None else replace(trust, tap=own.tap)
    made = replace(contract, trust=trust.to_json()).to_metadata()
    stated = {entry.key: entry.value for entry in model.metadata_props} | made
    del model.metadata_props[:]
    for key, value in stated.items():
        model.metadata_props.add(key=key, value=value)
    write_in_place(path, lambda draft: draft.write_bytes(model.SerializeToString(deterministic=True)), ModelSession)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m export.checks", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", type=Path, metavar="FROM.onnx", help="model that has the checks")
    parser.add_argument("models", type=Path, nargs="+", metavar="TO.onnx", help="models that get them, in place")
    options = parser.parse_args(arguments)
    try:
        for path in options.models:
            give_checks(options.source, path)
    except (ExportError, EdgeError, OSError, DecodeError) as error:
        sys.exit(f"checks: {error}")


if __name__ == "__main__":
    main()
