"""Networks to ONNX graphs of any number of windows, in float32 or 8-bit integers, without traces of the machine.

A float32 graph has the weights under the network's own names, and next to its contract the name of the network, so that
train.learning.checkpoint can restore it. Networks whose batch normalisation was folded into the weights, those of the
paper, need their checkpoint.

In integers activations are unsigned, weights signed with a scale for each channel, inputs and outputs in float. Ranges
are percentiles over training taps: what lies beyond any touch saturates. Layers that take most of the time are
quantised: the trunk's, and what reads it before the outputs. Those on smaller grids, which read the taxels, stay in
float: they take a tenth of the time, and no later layer recovers their losses. A network that takes poses also
quantises what encodes its earlier taps, a third of its time with four taps. Its layers that read logarithms stay in
float, for a step of their range is a factor; so do those that compare taps: in int8 they made a pattern 2.9 times its
largest value too large on windows beyond any touch.
"""

import contextlib
import io
import logging
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static
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
    Contract,
)
from edge.inference.onnx_session import LOG_FATAL_ONLY
from firmware_bridge.pad_geometry import AXES, USPA44, SensorGeometry
from train.data.press_batches import Batch
from train.data.presses import PressSet
from train.errors import TrainError
from train.learning.checkpoint import batches_of
from train.learning.training_loop import Recipe
from train.networks.blocks import PatternNet


class ExportError(TrainError):
    """Root of all errors of the export."""


class ParityError(ExportError, ArithmeticError):
    """Failed comparison: the ONNX graph does not compute what the network computes."""


_ARGUMENTS: Final = {INPUT_NAME: "window", POSES_NAME: "poses", PAD_NAME: "pad"}
"""Argument of a network's forward for each input of its graph."""
_TRACED: Final = 2  # windows with which a graph is traced: with one window, the tracer would take the size 1 as fixed


def to_model(net: PatternNet, pad: SensorGeometry = USPA44) -> onnx.ModelProto:
    """Return the network as a checked ONNX graph of any number of windows a run, without a contract.

    The exporter folds batch normalisation into the convolutions before it. ExportError if torch returns none.
    """
    example = torch.zeros(_TRACED, 3 * net.taps, pad.rows, pad.cols)
    free = {0: torch.export.Dim(ANY_BATCH)}
    inputs, dims = {INPUT_NAME: example}, {INPUT_NAME: free}
    if net.takes_poses:
        inputs[INPUT_NAME] = example.unflatten(1, (net.taps, 3))
        inputs[POSES_NAME] = torch.zeros(_TRACED, net.taps, POSE_WIDTH)
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
    """Return the patterns, and deviations and tractions if any, of windows (n, 3K, rows, cols) in network units.

    Without `pads` all constants are absent, without `poses` they are those of the paper's schedule.
    """
    known = {"pad": pads, "poses": poses}
    with torch.inference_mode():
        given = net(windows, **{name: one for name, one in known.items() if one is not None})
    return given if isinstance(given, tuple) else (given,)


_FEWEST: Final = 32
LAYERS: Final = ("trunk.", "leave.0.", "uncertainty.0.", "encode.", "send.", "ask.", "hear.")
"""Beginnings of the names of the weights whose convolutions are quantised; the paper's networks have others."""
PASSING_ON: Final = {"Relu": any, "Add": any, "Concat": all}
"""Operations that are quantised if any or all of their inputs are."""


def calibration_batch(taps: PressSet, contract: Contract) -> Batch:
    """Draw windows with their pad inputs from training taps as in training, light contacts included.

    ExportError if there are too few sequences.
    """
    if len(taps) < _FEWEST:
        raise ExportError(f"{len(taps)} sequences to take ranges of, expected {_FEWEST} or more")
    given = (1 / contract.taps,) * contract.taps
    if contract.takes_poses:  # its batches have one number of taps each: all, of which some are left out below
        given = (*[0.0] * (contract.taps - 1), 1.0)
    recipe = Recipe(1, batch=min(len(taps), 512), given=given)
    batch = batches_of(taps, contract.scale, recipe, 0, posed=contract.takes_poses)(0)
    if contract.takes_poses:
        there = torch.arange(contract.taps) <= torch.arange(len(batch.window))[:, None] % contract.taps
        batch = replace(batch, window=batch.window * there.repeat_interleave(len(AXES), dim=1)[:, :, None, None])
    return batch


class _Inputs(CalibrationDataReader):
    def __init__(self, inputs: dict[str, NDArray[np.float32]]) -> None:
        count = len(inputs[INPUT_NAME])
        self._left = ({name: given[one : one + 1] for name, given in inputs.items()} for one in range(count))

    def get_next(self) -> dict[str, NDArray[np.float32]] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        return next(self._left, None)


def quantised(model: onnx.ModelProto, seen: Batch) -> onnx.ModelProto:
    """Return a float graph with quantise and dequantise nodes around all nodes that may be quantised.

    Ranges are measured on the batch `seen`, light contacts included. ExportError if no node may be quantised.
    """
    nodes = integer_nodes(model)
    if not nodes:
        raise ExportError("no convolution of the graph may be quantised: export it without --int8")
    with tempfile.TemporaryDirectory() as drafts, _quiet():
        path = Path(drafts) / "int8.onnx"
        quantize_static(
            onnx.ModelProto.FromString(model.SerializeToString()),
            path,
            _Inputs(_inputs(model, seen)),
            quant_format=QuantFormat.QDQ,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            per_channel=True,
            op_types_to_quantize=["Conv", *PASSING_ON],
            nodes_to_quantize=nodes,
            calibrate_method=CalibrationMethod.Percentile,
            # Larger values are cut: with the whole range the bundled models lose 0.03 to 0.07 dB more, because a few
            # large values make all steps coarser.
            extra_options={"CalibPercentile": 99.999},
        )
        integers = onnx.load(path)
    onnx.checker.check_model(integers, full_check=True)
    return integers


def _inputs(model: onnx.ModelProto, seen: Batch) -> dict[str, NDArray[np.float32]]:
    """Return the inputs of a graph for a batch, by name."""
    names, inputs = {given.name for given in model.graph.input}, {INPUT_NAME: seen.window.numpy()}
    if POSES_NAME in names and seen.poses is not None:
        inputs[INPUT_NAME] = seen.window.unflatten(1, (-1, len(AXES))).numpy()
        inputs[POSES_NAME] = seen.poses.numpy()
    if PAD_NAME in names and seen.pad is not None:
        inputs[PAD_NAME] = seen.pad.numpy()
    return inputs


def convolutions(model: onnx.ModelProto) -> tuple[int, int]:
    """Return how many convolutions onnxruntime runs in int8 after optimising a graph, and their total number."""
    with tempfile.TemporaryDirectory() as drafts:
        path = Path(drafts) / "optimised.onnx"
        options = onnxruntime.SessionOptions()
        options.log_severity_level = LOG_FATAL_ONLY
        options.optimized_model_filepath = str(path)
        onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
        optimised = onnx.load(path)
    kinds = [node.op_type for node in optimised.graph.node if "Conv" in node.op_type]
    return kinds.count("QLinearConv"), len(kinds)


@contextlib.contextmanager
def _quiet() -> Iterator[Any]:
    """Silence the quantiser's messages, which advise steps that do not apply here."""
    root, before = logging.getLogger(), logging.getLogger().level
    root.setLevel(logging.ERROR)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        root.setLevel(before)


def integer_nodes(model: onnx.ModelProto) -> list[str]:
    """Return the names of the nodes to quantise, in the graph's order."""
    chosen: set[str] = set()
    made_by = {name: node.name for node in model.graph.node for name in node.output}
    for node in model.graph.node:  # every node comes after those of its inputs
        takes = [made_by[name] in chosen for name in node.input if name in made_by]
        passes = node.op_type in PASSING_ON and takes and PASSING_ON[node.op_type](takes)
        if passes or (node.op_type == "Conv" and node.input[1].startswith(LAYERS)):
            chosen.add(node.name)
    return [node.name for node in model.graph.node if node.name in chosen]
