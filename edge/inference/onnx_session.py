"""Model session in onnxruntime, checked against its contract."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors  # pyright: ignore[reportAttributeAccessIssue]

from edge.errors import ModelError, WindowError
from edge.inference.contract import (
    DEVIATION_NAME,
    INPUT_NAME,
    OUTPUT_NAME,
    PAD_NAME,
    POSE_KEYS,
    POSE_WIDTH,
    POSES_NAME,
    TRACTION_NAME,
    Contract,
    scheduled_rows,
)
from edge.inference.onnx_guard import read_model
from firmware_bridge.errors import harmless

LOG_FATAL_ONLY: Final = 4
LONGEST_REASON: Final = 300
_PLACE: Final = re.compile(
    r"/\S+\.(?:cc|cpp|h):\d+ [\w:~<>]+(?: [\w:~<>&*]+)*\([^()]*(?:\([^()]*\)[^()]*)*\)(?: const)? "
)  # a function's file, line and signature
ORT_ERRORS: Final = (
    ort_errors.EPFail,
    ort_errors.Fail,
    ort_errors.InvalidArgument,
    ort_errors.InvalidGraph,
    ort_errors.InvalidProtobuf,
    ort_errors.NoModel,
    ort_errors.NotImplemented,
    ort_errors.RuntimeException,
    RuntimeError,  # other exceptions of its C++
    MemoryError,
    UnicodeDecodeError,  # names in its messages come from the file
)

onnxruntime.disable_telemetry_events()  # if it was imported before `edge`, which is too late for all of it


class ModelSession:
    """Model ready to run, on one thread without spinning."""

    def __init__(self, path: Path, *, taps: int | None = None) -> None:
        """Load, check and warm up, or raise a ModelError where the file is no model that keeps its contract.

        `taps` are the most that are given to a model that takes more, with poses; the name then states them.
        """
        self._path = path
        self.name = harmless(path.stem, kept="")
        self._session = load_session(path)
        try:
            self.contract = Contract.from_metadata(self._session.get_modelmeta().custom_metadata_map)
            _check_tensors("input", self._session.get_inputs(), self.contract.input_shapes)
            _check_tensors("output", self._session.get_outputs(), self.contract.output_shapes)
        except ModelError as error:
            raise ModelError(f"{path}: {error}") from error
        except UnicodeDecodeError as error:
            raise ModelError(f"{path}: its names or its contract are not UTF-8: export it again") from error
        if taps is not None:
            self.contract = replace(self.contract, taps=taps, unposed_taps=taps)
            self.name = self.name.replace("mtsr", f"mtsr{taps}", 1)
        self._names = tuple(self.contract.output_shapes)
        self._options = onnxruntime.RunOptions()
        # onnxruntime looks this entry up at every run, and where it is missing throws and catches an exception.
        self._options.add_run_config_entry("gpu_graph_id", "-1")
        self.deviation: NDArray[np.float32] | None = None
        self.traction: NDArray[np.float32] | None = None
        self._shape = (self.contract.taps, 3, self.contract.rows, self.contract.cols)
        self._unknown_pad = self.contract.pad_row(None)
        for taps in sorted({1 if self.contract.takes_poses else self.contract.taps, self.contract.taps}):
            for _ in range(10):  # the first runs are slower
                self.run(np.zeros((taps, *self._shape[1:]), dtype=np.float32))

    def run(
        self,
        window: NDArray[np.float32],
        pad: NDArray[np.float32] | None = None,
        poses: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """Return the pattern (H, W) of a window (taps, 3, rows, cols) in network input units, newest tap first.

        A model that takes poses (taps, 5) takes 1 to K taps, by default at those of the paper's schedule, with zeros
        for taps of zeros; any other takes K. The pad is the contract's `pad_row`, by default of an unknown one. Raises
        WindowError for a wrong shape or type or what is not finite, and ModelError where the model fails on it.
        """
        pads, rows = None if pad is None else [pad], None if poses is None else [poses]
        pattern = self.run_together([window], pads, rows)[0]
        if self.deviation is not None:
            self.deviation = self.deviation[0]
        if self.traction is not None:
            self.traction = self.traction[0]
        return pattern

    def run_together(
        self,
        windows: Sequence[NDArray[np.float32]],
        pads: Sequence[NDArray[np.float32]] | None = None,
        poses: Sequence[NDArray[np.float32]] | None = None,
    ) -> NDArray[np.float32]:
        """Return the patterns (n, H, W) of several windows, with poses of different numbers of taps; see `run`."""
        for window in windows:
            self._check_window(window)
        pads = [self._unknown_pad] * len(windows) if pads is None else pads
        for pad in pads:
            if pad.shape != self._unknown_pad.shape or pad.dtype != np.float32 or not np.isfinite(pad).all():
                expected = f"{self._unknown_pad.shape} float32, finite, as the contract's pad_row gives it"
                raise WindowError(f"pad is {pad.shape} {pad.dtype}, expected {expected}")
        feeds: dict[str, NDArray[np.float32]] = {}
        if self.contract.takes_poses:
            poses = [self._scheduled(window) for window in windows] if poses is None else poses
            taps = max(map(len, windows))
            feeds[INPUT_NAME] = np.zeros((len(windows), taps, *self._shape[1:]), dtype=np.float32)
            feeds[POSES_NAME] = np.zeros((len(windows), taps, POSE_WIDTH), dtype=np.float32)
            for index, (window, rows) in enumerate(zip(windows, poses, strict=True)):
                _check_poses(rows, len(window))
                feeds[INPUT_NAME][index, : len(window)] = window
                feeds[POSES_NAME][index, : len(window)] = rows
        elif poses is not None:
            raise WindowError(f"poses are given, but model '{self.name}' takes none: leave them out")
        else:
            feeds[INPUT_NAME] = np.array(windows).reshape(len(windows), -1, *self._shape[2:])
        if self._unknown_pad.size:
            feeds[PAD_NAME] = np.array(pads)
        run: Any = self._session.run
        try:
            outputs = dict(zip(self._names, run(self._names, feeds, self._options), strict=True))
        except ORT_ERRORS as error:
            raise ModelError(f"{self._path}: cannot be run: {_reason(error)}") from error
        pattern = outputs[OUTPUT_NAME]
        deviation, traction = outputs.get(DEVIATION_NAME), outputs.get(TRACTION_NAME)
        if not np.isfinite(pattern).all():
            raise ModelError(f"model '{self.name}' gave a pattern that is not finite: export it again")
        if traction is not None and not np.isfinite(traction).all():
            raise ModelError(f"model '{self.name}' gave a traction that is not finite: export it again")
        # NaN fails here too, since it is neither above nor below any number.
        if deviation is not None and not 0 < deviation.min() <= deviation.max() < np.inf:
            raise ModelError(f"model '{self.name}' gave a deviation that is not finite and above zero: export it again")
        self.deviation, self.traction = deviation, traction
        return pattern

    def _check_window(self, window: NDArray[np.float32]) -> None:
        shape, expected = window.shape, str(self._shape)
        if self.contract.takes_poses:
            expected = f"(1 to {self._shape[0]}, {expected.partition(', ')[2]}"
            fits = shape[1:] == self._shape[1:] and 1 <= shape[0] <= self._shape[0]
        else:
            fits = shape == self._shape
        if not fits or window.dtype != np.float32:
            raise WindowError(f"window is {shape} {window.dtype}, expected {expected} float32")
        if not np.isfinite(window).all():
            raise WindowError("window has values that are not finite")

    def _scheduled(self, window: NDArray[np.float32]) -> NDArray[np.float32]:
        rows = scheduled_rows(len(window), self.contract.angle_step_deg)
        rows[~window.any(axis=(1, 2, 3))] = 0
        return rows


def _check_poses(poses: NDArray[np.float32], taps: int) -> None:
    if poses.shape != (taps, POSE_WIDTH) or poses.dtype != np.float32:
        expected = f"({taps}, {POSE_WIDTH}) float32: {', '.join(POSE_KEYS)} of each tap of the window"
        raise WindowError(f"poses are {poses.shape} {poses.dtype}, expected {expected}")
    if not np.isfinite(poses).all():
        raise WindowError("poses have values that are not finite")
    if poses[0].any():
        raise WindowError(
            f"the newest tap's pose is {poses[0].tolist()}, expected zeros: give poses as that tap sees them"
        )


def session_options() -> onnxruntime.SessionOptions:
    """Return the session options of the runtime."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = LOG_FATAL_ONLY
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    # A second lock after `read_model`. No file can lie below the null device; and without the format a file might be
    # read as onnxruntime's own, which `read_model` does not check.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)
    options.add_session_config_entry("session.load_model_format", "ONNX")
    return options


def load_session(path: Path) -> onnxruntime.InferenceSession:
    """Load any ONNX file with the runtime's session options, without a contract, or raise a ModelError."""
    content = read_model(path)
    try:
        # The fallback would try the same again, and print on stdout, where records go. In a stranger's file the folding
        # of constants can last hours.
        return onnxruntime.InferenceSession(
            content,
            session_options(),
            providers=["CPUExecutionProvider"],
            enable_fallback=0,
            disabled_optimizers=["ConstantFolding"],
        )
    except ORT_ERRORS as error:
        reason = f"{_reason(error)}: export it again, or install a newer onnxruntime"
        raise ModelError(f"{path}: not a model that onnxruntime can load: {reason}") from error


def _reason(error: Exception) -> str:
    """Return onnxruntime's message without the place in its source, which may take all the room."""
    text = _PLACE.sub("", " ".join(str(error).split()))
    return text if len(text) <= LONGEST_REASON else f"{text[:LONGEST_REASON]}..."


def _check_tensors(role: str, tensors: Sequence[Any], shapes: Mapping[str, tuple[int | str, ...]]) -> None:
    got = ", ".join(f"{tensor.name} {tensor.type} {list(tensor.shape)}" for tensor in tensors)
    expected = ", ".join(f"{name} tensor(float) {list(shape)}" for name, shape in shapes.items())
    if got != expected:
        raise ModelError(f"graph {role} is {got}, but its contract states {expected}")
