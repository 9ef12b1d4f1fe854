"""Count of the multiply-accumulates of any ONNX file, from a profile by onnxruntime.

The runtime has no ONNX library to read a graph with, and shapes are often not written in one. So the graph is run once
as it is, with no optimisation that would fuse its nodes, and the profile holds the shapes of every node.
"""

import json
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import onnxruntime

from edge.bench.contenders import random_feeds
from edge.errors import ModelError
from edge.inference.onnx_guard import read_model
from edge.inference.onnx_session import ORT_ERRORS, session_options

Shape = Sequence[int]


@dataclass(frozen=True, slots=True)
class Macs:
    """Multiply-accumulates of one run.

    Attributes:
        count: of all convolutions and matrix products.
        uncounted: operators with further multiply-accumulates, which are not counted.
    """

    count: int
    uncounted: tuple[str, ...]


def _convolution(weight: int) -> Callable[[list[Shape], Shape], int]:
    # Every output value is the sum of as many products as one row of the weights has numbers.
    return lambda inputs, output: math.prod(output) * math.prod(inputs[weight][1:])


def _transposed(inputs: list[Shape], output: Shape) -> int:
    # Every input value goes into as many sums as one row of the weights has numbers.
    del output
    return math.prod(inputs[0]) * math.prod(inputs[1][1:])


def _product(inputs: list[Shape], output: Shape) -> int:
    return math.prod(output) * inputs[0][-1]


def _gemm(inputs: list[Shape], output: Shape) -> int:
    # Either factor may be stored turned, but the output's first dimension is the first factor's own.
    return math.prod(output) * (math.prod(inputs[0]) // output[0])


_COUNTED: Final[dict[str, Callable[[list[Shape], Shape], int]]] = {
    "Conv": _convolution(1),
    "ConvInteger": _convolution(1),
    "QLinearConv": _convolution(3),
    "ConvTranspose": _transposed,
    "Gemm": _gemm,
    "MatMul": _product,
    "MatMulInteger": _product,
    "QLinearMatMul": _product,
}
_UNCOUNTED: Final = frozenset({"LSTM", "GRU", "RNN", "Einsum", "Attention", "MultiHeadAttention", "DeformConv"})


def macs_of(path: Path, taps: int = 1) -> Macs:
    """Run a file once, on random numbers, and count.

    Args:
        path: of the file.
        taps: of the window, where the file takes any number.

    Raises:
        ModelError: it cannot be run.
    """
    options = session_options()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.enable_profiling = True
    # Weights that a kernel has packed its own way are missing from its inputs.
    options.add_session_config_entry("session.disable_prepacking", "1")
    with tempfile.TemporaryDirectory() as folder:
        options.profile_file_prefix = str(Path(folder) / "macs")
        try:
            session = onnxruntime.InferenceSession(
                read_model(path), options, providers=["CPUExecutionProvider"], enable_fallback=0
            )
            session.run(None, random_feeds(session, path, taps))
        except ORT_ERRORS as error:
            raise ModelError(f"{path}: cannot be run to count its multiply-accumulates: {error}") from error
        events = json.loads(Path(session.end_profiling()).read_text())
    return counted(events)


def counted(events: Sequence[dict[str, Any]]) -> Macs:
    """Return the multiply-accumulates in the events of a profile."""
    count, uncounted = 0, set[str]()
    for event in events:
        details = event.get("args", {})
        # Only the event of a node's own work holds shapes.
        if "input_type_shape" not in details:
            continue
        operator = details["op_name"]
        if operator in _COUNTED:
            inputs, outputs = _shapes(details["input_type_shape"]), _shapes(details["output_type_shape"])
            count += _COUNTED[operator](inputs, outputs[0])
        elif operator in _UNCOUNTED:
            uncounted.add(operator)
    return Macs(count, tuple(sorted(uncounted)))


def _shapes(tensors: Sequence[dict[str, list[int]]]) -> list[Shape]:
    return [shape for tensor in tensors for shape in tensor.values()]
