"""Networks to ONNX graphs: fixed shapes except for the batch, one file, without traces of the machine.

A float32 graph has the weights under the network's own names, and next to its contract the name of the network, so that
train.networks.graph_weights can restore it. Networks whose batch normalisation was folded into the weights, those of
the paper, need their checkpoint.
"""

import logging
import warnings
from pathlib import Path
from typing import Final

import onnx
import torch
from torch import Tensor, nn

from edge.inference.bundled import INT8_SUFFIX
from edge.inference.contract import (
    ANY_TAPS,
    DEVIATION_NAME,
    INPUT_NAME,
    OUTPUT_NAME,
    PAD_NAME,
    POSE_WIDTH,
    POSES_NAME,
    TRACTION_NAME,
    Contract,
)
from export.errors import ExportError
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from train.networks.blocks import PatternNet

OPSET: Final = 18
_ARGUMENTS: Final = {INPUT_NAME: "window", POSES_NAME: "poses", PAD_NAME: "pad"}
"""Argument of a network's forward for each input of its graph."""
_TRACED: Final = 2
"""Windows with which a graph of any batch is traced: with one window, the tracer would take the size 1 as fixed."""


def to_model(net: PatternNet, batch: int | str = 1, pad: SensorGeometry = USPA44) -> onnx.ModelProto:
    """Return the network as a checked ONNX graph of `batch` windows a run, or ANY_BATCH, without a contract.

    The exporter folds batch normalisation into the convolutions before it.

    Raises:
        ExportError: the batch is not positive, or torch returns no graph.
    """
    if not isinstance(batch, str) and batch < 1:
        raise ExportError(f"a batch of {batch} asked for, expected 1 or more")
    traced = _TRACED if isinstance(batch, str) else batch
    example = torch.zeros(traced, 3 * net.taps, pad.rows, pad.cols)
    width, free = known_width(net), {0: torch.export.Dim(batch)} if isinstance(batch, str) else {}
    inputs, dims = {INPUT_NAME: example}, {INPUT_NAME: free}
    if net.takes_poses:
        inputs[INPUT_NAME] = example.unflatten(1, (net.taps, 3))
        inputs[POSES_NAME] = torch.zeros(traced, net.taps, POSE_WIDTH)
        dims[INPUT_NAME] = dims[POSES_NAME] = free | {1: torch.export.Dim(ANY_TAPS)}
    if width:
        inputs[PAD_NAME], dims[PAD_NAME] = torch.zeros(traced, width), free
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns that torchvision is not installed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # raised inside torch about torch
        warnings.filterwarnings("ignore", "# The axis name", UserWarning)  # two inputs share an axis, as they must
        program = torch.onnx.export(
            net,
            kwargs={_ARGUMENTS[name]: given for name, given in inputs.items()},
            dynamo=True,
            opset_version=OPSET,
            input_names=list(inputs),
            output_names=[OUTPUT_NAME, DEVIATION_NAME, TRACTION_NAME][: len(outputs(net, example))],
            dynamic_shapes={_ARGUMENTS[name]: shape for name, shape in dims.items()} if any(dims.values()) else None,
            verbose=False,
        )
    if program is None:
        raise ExportError("torch.onnx.export gave no program")
    model = program.model_proto
    graph = model.graph
    # The place where a layer was traced is of no use in the model, and includes paths of the machine.
    del model.metadata_props[:]
    for node in graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    for value in (*graph.input, *graph.output, *graph.value_info, *graph.initializer):
        del value.metadata_props[:]
    onnx.checker.check_model(model, full_check=True)
    return model


def known_width(net: nn.Module) -> int:
    """Return the number of pad inputs of a network."""
    return getattr(net, "known", 0)


def outputs(
    net: nn.Module, windows: Tensor, pads: Tensor | None = None, poses: Tensor | None = None
) -> tuple[Tensor, ...]:
    """Return the patterns, and deviations and tractions if any.

    Args:
        net: in evaluation mode.
        windows: (n, 3K, rows, cols) in network units.
        pads: inputs of the pads; without them all constants are absent.
        poses: of the taps, for a network that takes them; without them those of the paper's schedule.
    """
    known = {"pad": pads, "poses": poses}
    with torch.inference_mode():
        given = net(windows, **{name: one for name, one in known.items() if one is not None})
    return given if isinstance(given, tuple) else (given,)


def contract_in(model: onnx.ModelProto) -> Contract:
    """Return the contract of a graph."""
    return Contract.from_metadata({entry.key: entry.value for entry in model.metadata_props})


def in_float(path: Path) -> Path:
    """Return the path of the float32 graph of NAME-int8.onnx; for NAME.onnx its own."""
    return path.with_name(path.stem.removesuffix(INT8_SUFFIX) + path.suffix)
