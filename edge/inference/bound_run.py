"""Arrays of a run in onnxruntime, bound once to a session for each number of windows and of taps."""

from collections.abc import Callable

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from edge.inference.contract import (
    ANY_BATCH,
    ANY_TAPS,
    DEVIATION_NAME,
    INPUT_NAME,
    OUTPUT_NAME,
    PAD_NAME,
    POSES_NAME,
    TRACTION_NAME,
    Contract,
)

Outputs = tuple[NDArray[np.float32], NDArray[np.float32] | None, NDArray[np.float32] | None]
"""Patterns (n, H, W), deviations and tractions of a run; None where the model has none."""


class BoundRun:
    """Arrays for so many windows of so many taps, bound to a session; poses and pad are None where it takes none.

    Attributes:
        bindings: one for each call that a run needs.
    """

    def __init__(self, session: onnxruntime.InferenceSession, contract: Contract, count: int, taps: int) -> None:
        inputs, outputs = (
            {
                name: np.zeros([count, *(taps if size == ANY_TAPS else size for size in shape[1:])], dtype=np.float32)
                for name, shape in shapes.items()
            }
            for shapes in (contract.input_shapes, contract.output_shapes)
        )
        at_once = count if contract.batch == ANY_BATCH else 1
        self.bindings = [session.io_binding() for _ in range(0, count, at_once)]
        for index, binding in enumerate(self.bindings):
            part = slice(index * at_once, (index + 1) * at_once)
            for name, given in inputs.items():
                _bind(binding.bind_input, name, given[part])
            for name, output in outputs.items():
                _bind(binding.bind_output, name, output[part])
        for output in outputs.values():
            output.setflags(write=False)
        self.window = inputs[INPUT_NAME]
        self.poses = inputs.get(POSES_NAME)
        self.pad = inputs.get(PAD_NAME)
        self.outputs: Outputs = (outputs[OUTPUT_NAME], outputs.get(DEVIATION_NAME), outputs.get(TRACTION_NAME))

    def put(self, index: int, window: NDArray[np.float32], poses: NDArray[np.float32]) -> None:
        """Put in a window with poses; absent taps are zeros."""
        if self.poses is None:
            raise ValueError("the model takes no poses")
        taps = len(window)
        self.window[index, :taps], self.window[index, taps:] = window, 0
        self.poses[index, :taps], self.poses[index, taps:] = poses, 0


def _bind(bind: Callable[..., None], name: str, array: NDArray[np.float32]) -> None:
    bind(name, "cpu", 0, np.float32, array.shape, array.ctypes.data)
