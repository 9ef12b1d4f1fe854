"""Graphs in 8-bit integers: unsigned activations, signed weights with a scale for each channel, float in and out.

Ranges are percentiles over training taps. For a network that takes poses they are widened to what windows beyond any
touch give: its layers exchange values between taps, which such windows take far out of every range. Those of the newest
tap's own layers are widened a little only, since coarser steps there cost most (docs/decisions.md).
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
import onnxruntime
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static

from edge.inference.contract import INPUT_NAME, PAD_NAME, POSES_NAME, Contract
from edge.inference.onnx_session import LOG_FATAL_ONLY
from edge.inference.pose_input import scheduled_rows
from export.errors import ExportError
from export.graphs.parity import batches
from export.quantisation.integer_nodes import PASSING_ON, integer_nodes, newest_values, takes_poses
from firmware_bridge.pad_geometry import AXES
from train.data.press_batches import Batch
from train.data.presses import PressSet
from train.learning.checkpoint import batches_of
from train.learning.training_loop import Recipe
from train.surfaces.poses import ANGLE_STEP_DEG

_PERCENTILE: Final = 99.999
"""Percentage of a layer's values within its range; larger values are cut.

With the whole range the bundled models lose .03 to .07 dB more, because a few large values make all steps coarser.
"""
_WIDEST: Final = np.float32(1.3)
"""Factor by which windows beyond any touch may widen the ranges of the newest tap's own layers."""
MOST_VALUE: Final = 255
_CALIBRATED_ON: Final = 512
_FEWEST: Final = 32


def calibration_batch(taps: PressSet, contract: Contract) -> Batch:
    """Draw windows with their pad inputs from training taps as in training, light contacts included.

    Raises:
        ExportError: there are too few sequences for meaningful ranges.
    """
    if len(taps) < _FEWEST:
        raise ExportError(f"{len(taps)} sequences to take ranges of, expected {_FEWEST} or more")
    given = (1 / contract.taps,) * contract.taps
    if contract.takes_poses:  # its batches have one number of taps each: all, of which some are left out below
        given = (*[0.0] * (contract.taps - 1), 1.0)
    recipe = Recipe(1, batch=min(len(taps), _CALIBRATED_ON), given=given)
    batch = batches_of(taps, contract.scale, recipe, 0, posed=contract.takes_poses)(0)
    if contract.takes_poses:
        there = torch.arange(contract.taps) <= torch.arange(len(batch.window))[:, None] % contract.taps
        batch = replace(batch, window=batch.window * there.repeat_interleave(len(AXES), dim=1)[:, :, None, None])
    return batch


class _Inputs(CalibrationDataReader):
    def __init__(self, inputs: dict[str, NDArray[np.float32]], batch: int) -> None:
        self._left = batches(inputs, batch)

    def get_next(self) -> dict[str, NDArray[np.float32]] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        return next(self._left, None)


def quantised(model: onnx.ModelProto, seen: Batch, *, beyond: NDArray[np.float32] | None = None) -> onnx.ModelProto:
    """Return the graph with quantise and dequantise nodes around all nodes that may be quantised.

    Args:
        model: in float.
        seen: batch from which the ranges are measured, light contacts included.
        beyond: windows (n, 3K, rows, cols) that widen the ranges to their own; None for none.

    Raises:
        ExportError: no node of the graph may be quantised.
    """
    nodes, batch = integer_nodes(model), model.graph.input[0].type.tensor_type.shape.dim[0].dim_value or 1
    if not nodes:
        raise ExportError("no convolution of the graph may be quantised: export it without --int8")
    touches = _Inputs(_inputs(model, seen), batch)
    if beyond is None:
        return _quantised(model, nodes, touches)
    poses = torch.from_numpy(scheduled_rows(beyond.shape[1] // len(AXES), ANGLE_STEP_DEG))
    windows = torch.from_numpy(beyond)
    pads = None if seen.pad is None else seen.pad.new_zeros(len(beyond), seen.pad.shape[1])
    far = replace(seen, window=windows, pad=pads, poses=poses.expand(len(beyond), -1, -1).contiguous())
    whole = _quantised(model, nodes, _Inputs(_inputs(model, far), batch), CalibrationMethod.MinMax)
    ranges = rounded_ranges(_quantised(model, nodes, touches))
    bounded = newest_values(model)
    for name, (far_low, far_high) in rounded_ranges(whole).items():
        low, high = ranges[name]
        lowest, highest = (_WIDEST * low, _WIDEST * high) if name in bounded else (far_low, far_high)
        ranges[name] = (min(low, max(far_low, lowest)), max(high, min(far_high, highest)))
    return _quantised(model, nodes, _Inputs(_inputs(model, far), batch), CalibrationMethod.MinMax, ranges)


def _quantised(
    model: onnx.ModelProto,
    nodes: list[str],
    windows: CalibrationDataReader,
    method: CalibrationMethod = CalibrationMethod.Percentile,
    ranges: dict[str, tuple[np.float32, np.float32]] | None = None,
) -> onnx.ModelProto:
    """Return the graph with some nodes quantised, with the ranges that windows give or those that are given."""
    given = {name: [{"rmin": low, "rmax": high}] for name, (low, high) in (ranges or {}).items()}
    with tempfile.TemporaryDirectory() as drafts, _quiet():
        path = Path(drafts) / "int8.onnx"
        quantize_static(
            onnx.ModelProto.FromString(model.SerializeToString()),
            path,
            windows,
            quant_format=QuantFormat.QDQ,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            per_channel=True,
            op_types_to_quantize=["Conv", *PASSING_ON],
            nodes_to_quantize=nodes,
            calibrate_method=method,
            extra_options={"CalibPercentile": _PERCENTILE, "TensorQuantOverrides": given},
        )
        integers = onnx.load(path)
    onnx.checker.check_model(integers, full_check=True)
    return integers


def _inputs(model: onnx.ModelProto, seen: Batch) -> dict[str, NDArray[np.float32]]:
    """Return the inputs of a graph for a batch, by name."""
    inputs = {INPUT_NAME: seen.window.numpy()}
    if takes_poses(model) and seen.poses is not None:
        inputs[INPUT_NAME] = seen.window.unflatten(1, (-1, len(AXES))).numpy()
        inputs[POSES_NAME] = seen.poses.numpy()
    if seen.pad is not None and any(given.name == PAD_NAME for given in model.graph.input):
        inputs[PAD_NAME] = seen.pad.numpy()
    return inputs


def rounded_ranges(integers: onnx.ModelProto) -> dict[str, tuple[np.float32, np.float32]]:
    """Return the range of every value that a quantised graph rounds, by its name in the graph in float."""
    held = {weight.name: weight for weight in integers.graph.initializer}
    found: dict[str, tuple[np.float32, np.float32]] = {}
    for node in integers.graph.node:
        if node.op_type == "QuantizeLinear":
            scale, zero = (np.float32(numpy_helper.to_array(held[name])) for name in node.input[1:3])
            found[node.input[0]] = (scale * -zero, scale * (MOST_VALUE - zero))
    return found


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
