"""Networks to ONNX graphs: fixed shapes but for the batch, one file, nothing of the machine they were made on."""

import logging
import warnings
from typing import Final

import onnx
import torch
from torch import Tensor, nn

from edge.inference.contract import DEVIATION_NAME, INPUT_NAME, OUTPUT_NAME, PAD_NAME, TRACTION_NAME
from export.errors import ExportError
from firmware_bridge.geometry import SensorGeometry
from train.networks.blocks import PatternNet

OPSET: Final = 18
_TRACED: Final = 2
"""Windows that a graph of any batch is traced with: of one, the tracer would take the one for granted."""


def to_model(net: PatternNet, geometry: SensorGeometry, batch: int | str = 1) -> onnx.ModelProto:
    """The network as an ONNX graph, checked, without a contract yet.

    The exporter folds batch normalisation into the convolutions before it.

    Args:
        net: in evaluation mode.
        geometry: of the sensor.
        batch: windows in one run, or ANY_BATCH; onnxruntime is no slower for not knowing it.

    Raises:
        ExportError: the batch is not positive, or torch gives no graph.
    """
    if not isinstance(batch, str) and batch < 1:
        raise ExportError(f"a batch of {batch} asked for, expected 1 or more")
    traced = _TRACED if isinstance(batch, str) else batch
    example = torch.zeros(traced, 3 * net.taps, geometry.rows, geometry.cols)
    width = known_width(net)
    inputs = {INPUT_NAME: example} | ({PAD_NAME: torch.zeros(traced, width)} if width else {})
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns that torchvision is not there
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # torch's own, about torch's own
        program = torch.onnx.export(
            net,
            tuple(inputs.values()),
            dynamo=True,
            opset_version=OPSET,
            input_names=list(inputs),
            output_names=[OUTPUT_NAME, DEVIATION_NAME, TRACTION_NAME][: len(outputs(net, example))],
            dynamic_shapes=tuple({0: torch.export.Dim(batch)} for _ in inputs) if isinstance(batch, str) else None,
            verbose=False,
        )
    if program is None:
        raise ExportError("torch.onnx.export gave no program")
    model = program.model_proto
    graph = model.graph
    # Where a layer was traced from is the exporter's affair, and holds paths of the machine it ran on.
    del model.metadata_props[:]
    for node in graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    for value in (*graph.input, *graph.output, *graph.value_info, *graph.initializer):
        del value.metadata_props[:]
    onnx.checker.check_model(model, full_check=True)
    return model


def known_width(net: nn.Module) -> int:
    """Numbers that a network takes of what is known of a pad."""
    return getattr(net, "known", 0)


def outputs(net: nn.Module, windows: Tensor, pads: Tensor | None = None) -> tuple[Tensor, ...]:
    """The patterns, and their deviations and the tractions where the network gives any; without pads none is known."""
    with torch.inference_mode():
        given = net(windows) if pads is None else net(windows, pads)
    return given if isinstance(given, tuple) else (given,)
