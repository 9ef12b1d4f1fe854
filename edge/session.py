"""One model in onnxruntime: checked against its contract, arrays bound once."""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors  # pyright: ignore[reportAttributeAccessIssue]

from edge.contract import DEVIATION_NAME, INPUT_NAME, OUTPUT_NAME, Contract
from edge.errors import ModelError, WindowError

WARM_UP_RUNS: Final = 20
LOG_FATAL_ONLY: Final = 4
LOAD_ERRORS: Final = (
    ort_errors.Fail,
    ort_errors.InvalidArgument,
    ort_errors.InvalidGraph,
    ort_errors.InvalidProtobuf,
    ort_errors.NoModel,
    ort_errors.NotImplemented,
    ort_errors.RuntimeException,
)


class ModelSession:
    """A model ready to run, one window at a time, on one thread without spinning.

    Build it on the thread that runs it: onnxruntime makes denormals zero once in a process, on the thread that builds
    the first session and on threads which that one starts later. Everything else on them computes like this as well.
    """

    def __init__(self, path: Path) -> None:
        """Load, check and warm up.

        Raises:
            ModelError: no such file, not a model, weights in a side file, no contract, or a graph
                that does not keep the contract; the key or tensor is named.
        """
        self.name = path.stem
        session = _load(path)
        try:
            self.contract = Contract.from_metadata(session.get_modelmeta().custom_metadata_map)
            if self.contract.batch != 1:
                raise ModelError(
                    f"contract key 'batch' is {self.contract.batch}, but windows are run one at a time here: export it "
                    "without --batch"
                )
            _check_tensors("input", session.get_inputs(), {INPUT_NAME: self.contract.window_shape})
            _check_tensors("output", session.get_outputs(), self.contract.output_shapes)
        except ModelError as error:
            raise ModelError(f"{path}: {error}") from error
        self._input = np.zeros(self.contract.window_shape, dtype=np.float32)
        self._session = session
        self._binding = session.io_binding()
        self._bind(self._binding.bind_input, INPUT_NAME, self._input)
        outputs = {}
        for name, shape in self.contract.output_shapes.items():
            output = np.zeros(shape, dtype=np.float32)
            self._bind(self._binding.bind_output, name, output)
            outputs[name] = output[0]
            outputs[name].setflags(write=False)
        self._pattern: NDArray[np.float32] = outputs[OUTPUT_NAME]
        self._deviation: NDArray[np.float32] | None = outputs.get(DEVIATION_NAME)
        window = np.zeros((self.contract.taps, 3, self.contract.rows, self.contract.cols), dtype=np.float32)
        for _ in range(WARM_UP_RUNS):
            self.run(window)

    @property
    def deviation(self) -> NDArray[np.float32] | None:
        """Standard deviation of each pixel of the last run's pattern, in its unit, or None where the model has none.

        (H, W) float32 above zero: the session's own array, read-only, and overwritten by the next run.
        """
        return self._deviation

    def run(self, window: NDArray[np.float32]) -> NDArray[np.float32]:
        """Infer the pattern of one window.

        Args:
            window: (taps, 3, rows, cols) float32, newest first, in network input units.

        Returns:
            (H, W) float32 in the contract's output unit: the session's own array, read-only, and
            overwritten by the next run.

        Raises:
            WindowError: wrong shape or type, or not finite.
            ModelError: the model gave a pattern that is not finite, or a deviation that is not finite and above zero.
        """
        expected = (self.contract.taps, 3, self.contract.rows, self.contract.cols)
        if window.shape != expected or window.dtype != np.float32:
            raise WindowError(f"window is {window.shape} {window.dtype}, expected {expected} float32")
        if not np.isfinite(window).all():
            raise WindowError("window has values that are not finite")
        self._input[...] = window.reshape(self._input.shape)
        self._session.run_with_iobinding(self._binding)
        if not np.isfinite(self._pattern).all():
            raise ModelError(f"model '{self.name}' gave a pattern that is not finite: export it again")
        deviation = self._deviation
        # Not a number is neither above nor below anything, so it fails here too.
        if deviation is not None and not 0 < deviation.min() <= deviation.max() < np.inf:
            raise ModelError(f"model '{self.name}' gave a deviation that is not finite and above zero: export it again")
        return self._pattern

    @staticmethod
    def _bind(bind: Callable[..., None], name: str, array: NDArray[np.float32]) -> None:
        bind(name, "cpu", 0, np.float32, array.shape, array.ctypes.data)


def _load(path: Path) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = LOG_FATAL_ONLY
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.add_session_config_entry("session.set_denormal_as_zero", "1")
    # A model is one file. Nothing can lie below the null device, so weights kept in a side file
    # are refused even where that file happens to be in reach.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except LOAD_ERRORS as error:
        if "xternal" in str(error):
            raise ModelError(f"{path}: keeps its weights in a side file, expected one file: export it again") from error
        raise ModelError(f"{path}: not a model that onnxruntime can load: {error}") from error


def _check_tensors(role: str, tensors: Sequence[Any], shapes: Mapping[str, tuple[int, ...]]) -> None:
    got = ", ".join(f"{tensor.name} {tensor.type} {list(tensor.shape)}" for tensor in tensors)
    expected = ", ".join(f"{name} tensor(float) {list(shape)}" for name, shape in shapes.items())
    if got != expected:
        raise ModelError(f"graph {role} is {got}, but its contract says {expected}")
