"""Networks to ONNX graphs of any number of windows, in float32, without traces of the machine.

A graph has the weights under the network's own names, so that train.learning.checkpoint can restore it. Networks whose
batch normalisation was folded into the weights, those of the paper, need their checkpoint.
"""

import logging
import warnings
from typing import Final

import onnx
import torch
from torch import Tensor

from edge.inference.contract import (
    ANY_BATCH,
    ANY_TAPS,
    DEVIATION_NAME,
    INPUT_NAME,
    OUTPUT_NAME,
    PAD_NAME,
    POSE_WIDTH,
    POSES_NAME,
    TRACTION_NAME,
)
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from train.errors import TrainError
from train.networks.blocks import PatternNet


class ExportError(TrainError):
    """Root of all errors of the export."""


class ParityError(ExportError, ArithmeticError):
    """Failed comparison: the ONNX graph does not compute what the network computes."""


_ARGUMENTS: Final = {INPUT_NAME: "window", POSES_NAME: "poses", PAD_NAME: "pad"}  # of a network's forward, by input
_TRACED: Final = 2  # windows, or earlier taps, with which a graph is traced: the tracer takes the size 1 as fixed


def to_model(net: PatternNet, pad: SensorGeometry = USPA44) -> onnx.ModelProto:
    """Return the network as a checked ONNX graph of any number of windows a run, without a contract."""
    example = torch.zeros(_TRACED, 3 * net.taps, pad.rows, pad.cols)
    free = {0: torch.export.Dim(ANY_BATCH)}
    inputs, dims = {INPUT_NAME: example}, {INPUT_NAME: free}
    if net.takes_poses:
        taps = max(net.taps, 1 + _TRACED)
        inputs[INPUT_NAME] = torch.zeros(_TRACED, taps, 3, pad.rows, pad.cols)
        inputs[POSES_NAME] = torch.zeros(_TRACED, taps, POSE_WIDTH)
        dims[INPUT_NAME] = dims[POSES_NAME] = free | {1: torch.export.Dim(ANY_TAPS)}
    if net.known:
        inputs[PAD_NAME], dims[PAD_NAME] = torch.zeros(_TRACED, net.known), free
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns that torchvision is not installed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # raised inside torch about torch
        warnings.filterwarnings("ignore", "# The axis name", UserWarning)  # two inputs share an axis, as they must
        program = torch.onnx.export(
            net,
            kwargs={_ARGUMENTS[name]: given for name, given in inputs.items()},
            dynamo=True,
            opset_version=18,
            input_names=list(inputs),
            output_names=[OUTPUT_NAME, DEVIATION_NAME, TRACTION_NAME][: len(outputs(net, example))],
            dynamic_shapes={_ARGUMENTS[name]: shape for name, shape in dims.items()},
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


def outputs(
    net: PatternNet, windows: Tensor, pads: Tensor | None = None, poses: Tensor | None = None
) -> tuple[Tensor, ...]:
    """Return the patterns, and deviations and tractions if any, of windows (n, 3K, rows, cols) in network units."""
    stated = {"pad": pads, "poses": poses}
    with torch.inference_mode():
        given = net(windows, **{name: values for name, values in stated.items() if values is not None})
    return given if isinstance(given, tuple) else (given,)
