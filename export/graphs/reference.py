"""Network of a graph, restored from the graph itself.

A float32 graph has the weights under the network's own names, and next to its contract the name of the network. So
parity can be checked without the checkpoint. Networks whose batch normalisation was folded into the weights, those of
the paper, need their checkpoint.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import onnx
import torch
from onnx import numpy_helper

from edge.inference.bundled import INT8_SUFFIX
from edge.inference.contract import Contract
from export.errors import ExportError
from export.graphs.joined import branches
from train.networks.blocks import PatternNet
from train.networks.fusion import OneOrMoreNet
from train.networks.registry import build
from train.networks.symmetric import write_out

ORIGIN_KEY: Final = "tactile.origin"
ONE_TAP: Final = "one_tap"
"""Key of the origin of a graph's branch for a single tap, with the name of that model."""


def contract_in(model: onnx.ModelProto) -> Contract:
    """Return the contract of a graph."""
    return Contract.from_metadata({entry.key: entry.value for entry in model.metadata_props})


def in_float(path: Path) -> Path:
    """Return the path of the float32 graph of NAME-int8.onnx; for NAME.onnx its own."""
    return path.with_name(path.stem.removesuffix(INT8_SUFFIX) + path.suffix)


def origin(report: Mapping[str, Any]) -> dict[str, str]:
    """Return the metadata that identify a graph's network, from a checkpoint's report.

    Fine-tuning for int8 changes the weights, and so makes another network.
    """
    stated = {key: report[key] for key in ("network", "scale", "options", "training_sha256")}
    stated |= {ONE_TAP: report[ONE_TAP]} if ONE_TAP in report else {}
    return {ORIGIN_KEY: json.dumps(stated, sort_keys=True)}


def origin_of(model: onnx.ModelProto) -> dict[str, Any]:
    """Return the metadata that identify a graph's network.

    Raises:
        ExportError: the metadata are missing.
    """
    stated = {entry.key: entry.value for entry in model.metadata_props}.get(ORIGIN_KEY)
    if stated is None:
        raise ExportError(f"metadata key '{ORIGIN_KEY}' is missing: export the model again")
    return json.loads(stated)


def network_of(model: onnx.ModelProto) -> PatternNet:
    """Return the network of a float32 graph, in evaluation mode.

    Raises:
        ExportError: the graph does not identify its network, or lacks its weights.
    """
    made, parts = origin_of(model), branches(model)
    if parts is None:
        return _restored(made, model.graph)
    if ONE_TAP not in made:
        raise ExportError(
            f"the graph has a branch for a single tap, but '{ORIGIN_KEY}' no '{ONE_TAP}': export it again"
        )
    one, more = parts
    return OneOrMoreNet(_restored(made[ONE_TAP], one), _restored(made, more)).eval()


def _restored(made: Mapping[str, Any], graph: onnx.GraphProto) -> PatternNet:
    net = build(made["network"], made["scale"], **made["options"])
    write_out(net)
    held = {weight.name: torch.from_numpy(numpy_helper.to_array(weight).copy()) for weight in graph.initializer}
    lacking = [name for name in net.state_dict() if name not in held]
    if lacking:
        raise ExportError(
            f"the graph does not hold {lacking[0]} and {len(lacking) - 1} more weights: name its checkpoint"
        )
    net.load_state_dict({name: held[name].reshape(value.shape) for name, value in net.state_dict().items()})
    return net.eval()
