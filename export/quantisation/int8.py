"""Graphs in 8-bit integers: unsigned activations, signed weights with a scale for each channel, float in and out.

Only layers that take most of the time are quantised: the convolutions of the largest grid except for those of the
outputs. Those of smaller grids, which read the taxels, stay in float: they take a tenth of the time, and no later layer
recovers their losses (docs/log.md).
"""

import contextlib
import io
import logging
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from onnx import NodeProto
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static

from edge.inference.contract import INPUT_NAME, PAD_NAME, POSES_NAME, Contract
from edge.inference.onnx_session import LOG_FATAL_ONLY
from export.errors import ExportError
from firmware_bridge.pad_geometry import AXES
from train.data.batch import Batch
from train.data.batches import Draw
from train.data.dataset import Sequences
from train.data.presses import PressSet
from train.learning.checkpoint import batches_of
from train.learning.training_loop import Recipe

_PERCENTILE: Final = 99.999
"""Percentage of a layer's values within its range; larger values are cut.

With the whole range the bundled models lose .03 to .07 dB more, because a few large values make all steps coarser.
"""
_PASSING_ON: Final = {"Relu": any, "Add": any, "Concat": all}
"""Operations that are quantised if any or all of their inputs are."""


_CALIBRATED_ON: Final = 512
_FEWEST: Final = 32
_SET_FORCE_N: Final = (0.3, 8.0)
"""Force of the taps from which ranges are measured, in [N], so that light taps weigh as much as firm ones."""


def calibration_batch(taps: Sequences | PressSet, contract: Contract) -> Batch:
    """Draw windows with their pad inputs from training taps as in training, light contacts included.

    Raises:
        DatasetError: the sequences have fewer taps than the network takes.
        ExportError: there are too few sequences for meaningful ranges.
    """
    if len(taps) < _FEWEST:
        raise ExportError(f"{len(taps)} sequences to take ranges of, expected {_FEWEST} or more")
    given = (1 / contract.taps,) * contract.taps
    if contract.takes_poses:  # its batches have one number of taps each: all, of which some are left out below
        given = (*[0.0] * (contract.taps - 1), 1.0)
    recipe = Recipe(1, batch=min(len(taps), _CALIBRATED_ON), given=given)
    draw = Draw(set_force_n=_SET_FORCE_N)
    batch = batches_of(taps, contract.scale, recipe, 0, draw, posed=contract.takes_poses)(0)
    if contract.takes_poses:
        there = torch.arange(contract.taps) <= torch.arange(len(batch.window))[:, None] % contract.taps
        batch = replace(batch, window=batch.window * there.repeat_interleave(len(AXES), dim=1)[:, :, None, None])
    return batch


class _Inputs(CalibrationDataReader):
    def __init__(self, inputs: dict[str, NDArray[np.float32]], batch: int) -> None:
        filled = {
            name: np.concatenate([given, np.resize(given, (-len(given) % batch, *given.shape[1:]))])
            for name, given in inputs.items()
        }
        count = len(filled[INPUT_NAME])
        self._left = iter(
            {name: given[first : first + batch] for name, given in filled.items()} for first in range(0, count, batch)
        )

    def get_next(self) -> dict[str, NDArray[np.float32]] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        return next(self._left, None)


def quantised(model: onnx.ModelProto, seen: Batch, *, every: bool = False) -> onnx.ModelProto:
    """Return the graph with quantise and dequantise nodes around all nodes that may be quantised.

    Args:
        model: in float.
        seen: batch from which the ranges are measured, light contacts included.
        every: quantise all convolutions, not only the expensive ones.

    Raises:
        ExportError: no node of the graph may be quantised.
    """
    nodes, batch = integer_nodes(model, every=every), model.graph.input[0].type.tensor_type.shape.dim[0].dim_value or 1
    if not nodes:
        raise ExportError("no convolution of the graph may be quantised: export it without --int8")
    inputs = {INPUT_NAME: seen.window.numpy()}
    if seen.poses is not None:
        inputs[INPUT_NAME] = seen.window.unflatten(1, (-1, len(AXES))).numpy()
        inputs[POSES_NAME] = seen.poses.numpy()
    if seen.pad is not None and any(given.name == PAD_NAME for given in model.graph.input):
        inputs[PAD_NAME] = seen.pad.numpy()
    with tempfile.TemporaryDirectory() as drafts, _quiet():
        path = Path(drafts) / "int8.onnx"
        quantize_static(
            onnx.ModelProto.FromString(model.SerializeToString()),
            path,
            _Inputs(inputs, batch),
            quant_format=QuantFormat.QDQ,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            per_channel=True,
            op_types_to_quantize=["Conv", *_PASSING_ON],
            nodes_to_quantize=nodes,
            calibrate_method=CalibrationMethod.Percentile,
            extra_options={"CalibPercentile": _PERCENTILE},
        )
        integers = onnx.load(path)
    onnx.checker.check_model(integers, full_check=True)
    return integers


def integer_nodes(model: onnx.ModelProto, *, every: bool = False) -> list[str]:
    """Return the names of the nodes to quantise, in the graph's order; `every`: with all convolutions."""
    shapes = _shapes(model)
    made_by = {name: node for node in model.graph.node for name in node.output}
    convs = [node for node in model.graph.node if node.op_type == "Conv"]
    largest = max((_pixels(shapes, node) for node in convs), default=0)
    last = _last_convolutions(model, made_by)
    chosen = {node.name for node in convs if every or (_pixels(shapes, node) == largest and node.name not in last)}
    for node in model.graph.node:  # every node comes after those of its inputs
        takes = [made_by[name].name for name in node.input if name in made_by]
        if takes and _PASSING_ON.get(node.op_type, _never)(name in chosen for name in takes):
            chosen.add(node.name)
    return [node.name for node in model.graph.node if node.name in chosen]


def convolutions(model: onnx.ModelProto) -> tuple[int, int]:
    """Return how many convolutions onnxruntime runs in int8 after optimising a graph, and their total number."""
    with tempfile.TemporaryDirectory() as drafts:
        path = Path(drafts) / "optimised.onnx"
        options = onnxruntime.SessionOptions()
        options.log_severity_level = LOG_FATAL_ONLY
        options.optimized_model_filepath = str(path)
        onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
        kinds = [node.op_type for node in onnx.load(path).graph.node if "Conv" in node.op_type]
    return kinds.count("QLinearConv"), len(kinds)


def _never(_: Iterable[bool]) -> bool:
    return False


def _last_convolutions(model: onnx.ModelProto, made_by: dict[str, NodeProto]) -> set[str]:
    """Return the convolutions from which an output is computed without another convolution or a Gemm in between."""
    found, behind = set(), [value.name for value in model.graph.output]
    while behind:
        node = made_by.get(behind.pop())
        if node is None:
            continue
        if node.op_type == "Conv":
            found.add(node.name)
        elif node.op_type != "Gemm":  # a layer of its own, which sees what convolutions made
            behind += node.input
    return found


def _shapes(model: onnx.ModelProto) -> dict[str, list[int]]:
    inferred = onnx.shape_inference.infer_shapes(model)
    return {
        value.name: [length.dim_value for length in value.type.tensor_type.shape.dim]
        for value in (*inferred.graph.value_info, *inferred.graph.output)
    }


def _pixels(shapes: dict[str, list[int]], node: NodeProto) -> int:
    height, width = shapes[node.output[0]][-2:]
    return height * width


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
