"""Graphs in 8-bit integers, with ranges of activations from training taps.

Activations are unsigned, weights signed with a scale for each channel, inputs and outputs in float. Ranges are
percentiles over training taps: what lies beyond any touch saturates. Layers that take most of the time are quantised:
the trunk's, and what reads it before the outputs. Those on smaller grids, which read the taxels, stay in float: they
take a tenth of the time, and no later layer recovers their losses. A network that takes poses also quantises what
encodes its earlier taps, a third of its time with four taps. Its layers that read logarithms stay in float, for a step
of their range is a factor; so do those that compare taps: in int8 they made a pattern 2.9 times its largest value too
large on windows beyond any touch.
"""

import contextlib
import io
import logging
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static

from edge.inference.contract import INPUT_NAME, PAD_NAME, POSES_NAME, Contract
from export.graph import ExportError
from firmware_bridge.pad_geometry import AXES
from train.data.press_batches import Batch
from train.data.presses import PressSet
from train.learning.checkpoint import batches_of
from train.learning.training_loop import Recipe

_FEWEST: Final = 32
# Beginnings of the names of the weights whose convolutions are quantised; the paper's networks have others.
LAYERS: Final = ("trunk.", "leave.0.", "uncertainty.0.", "encode.", "send.", "ask.", "hear.")
PASSING_ON: Final = {"Relu": any, "Add": any, "Concat": all}  # operations quantised if any or all of their inputs are


def calibration_batch(taps: PressSet, contract: Contract) -> Batch:
    """Draw windows with their pad inputs from training taps as in training, light contacts included."""
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
        self._left = ({name: given[row : row + 1] for name, given in inputs.items()} for row in range(count))

    def get_next(self) -> dict[str, NDArray[np.float32]] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        return next(self._left, None)


def quantised(model: onnx.ModelProto, seen: Batch) -> onnx.ModelProto:
    """Return a float graph with quantise and dequantise nodes, whose ranges are measured on the batch `seen`."""
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
