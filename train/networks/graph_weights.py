"""Networks restored from ONNX graphs: a float32 graph holds the weights of its network, and its metadata say which."""

import json
from collections.abc import Mapping
from typing import Any, Final

import onnx
import torch
from onnx import numpy_helper

from train.errors import CheckpointError
from train.networks.blocks import PatternNet
from train.networks.registry import build
from train.networks.symmetric import read_back

ORIGIN_KEY: Final = "tactile.origin"
_STATED: Final = ("network", "scale", "options", "training_sha256")


def origin(report: Mapping[str, Any]) -> dict[str, str]:
    """Return the metadata that identify a graph's network, from a checkpoint's report."""
    return {ORIGIN_KEY: json.dumps({key: report[key] for key in _STATED}, sort_keys=True)}


def origin_of(model: onnx.ModelProto) -> dict[str, Any]:
    """Return the metadata that identify a graph's network.

    Raises:
        CheckpointError: the metadata are missing.
    """
    stated = {entry.key: entry.value for entry in model.metadata_props}.get(ORIGIN_KEY)
    if stated is None:
        raise CheckpointError(f"metadata key '{ORIGIN_KEY}' is missing: export the model again")
    return json.loads(stated)


def network_of(model: onnx.ModelProto) -> PatternNet:
    """Return the network of a float32 graph, in evaluation mode.

    Raises:
        CheckpointError: the graph does not identify its network, or lacks its weights.
    """
    made = origin_of(model)
    net = build(made["network"], made["scale"], **made["options"])
    held = {weight.name: torch.from_numpy(numpy_helper.to_array(weight).copy()) for weight in model.graph.initializer}
    lacking = read_back(net, held)
    if lacking:
        more = f" and {len(lacking) - 1} more weights" if len(lacking) > 1 else ""
        raise CheckpointError(f"the graph does not hold {lacking[0]}{more}: name its checkpoint")
    return net.eval()
