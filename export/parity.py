"""Parity between a graph and its network, on readings and on extreme windows."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray

from edge.evaluation.test_set import FrozenSet
from edge.inference.contract import (
    DEVIATION_NAME,
    INPUT_NAME,
    OUTPUT_NAME,
    PAD_NAME,
    POSES_NAME,
    TRACTION_NAME,
    Contract,
    scheduled_rows,
)
from edge.inference.onnx_session import LOG_FATAL_ONLY
from export.graph import ParityError, outputs
from train.networks.blocks import PatternNet
from train.surfaces.poses import ANGLE_STEP_DEG

# Largest accepted differences between torch and a float32 graph, on readings and on extreme windows. Both compute in
# float32 but add in another order: measured 2e-6 and, in a deviation at the full range, 3e-5.
TOLERANCE: Final = 1e-5
EXTREME_TOLERANCE: Final = 5e-5
FULL_RANGE_COUNTS: Final = 32768  # of a zeroed reading from rest, as its deformation wraps around


class GraphRun:
    """Graph in onnxruntime, optimised as in the runtime, for comparison without a contract and bound arrays."""

    def __init__(self, model: onnx.ModelProto) -> None:
        options = onnxruntime.SessionOptions()
        options.log_severity_level = LOG_FATAL_ONLY
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
        inputs = {given.name: given.shape for given in self._session.get_inputs()}
        self._pad_width = inputs[PAD_NAME][1] if PAD_NAME in inputs else 0
        self._takes_poses = POSES_NAME in inputs
        self.outputs: list[str] = [output.name for output in self._session.get_outputs()]

    def __call__(
        self,
        windows: NDArray[np.float32],
        pads: NDArray[np.float32] | None = None,
        poses: NDArray[np.float32] | None = None,
    ) -> list[NDArray[np.float32]]:
        """Return each output (n, ...) of windows (n, 3K, rows, cols) in network units, which are run one by one.

        Without pads (n, width) no constants are stated, without poses (n, K, 5) they are the paper's schedule.
        """
        count = len(windows)
        inputs = {INPUT_NAME: windows}
        if self._takes_poses:
            inputs[INPUT_NAME] = windows.reshape(count, -1, 3, *windows.shape[2:])
            taps = inputs[INPUT_NAME].shape[1]
            scheduled = np.tile(scheduled_rows(taps, ANGLE_STEP_DEG), (count, 1, 1))
            inputs[POSES_NAME] = scheduled if poses is None else poses
        if self._pad_width:
            inputs[PAD_NAME] = np.zeros((count, self._pad_width), np.float32) if pads is None else pads
        runs = [
            self._session.run(None, {name: given[place : place + 1] for name, given in inputs.items()})
            for place in range(count)
        ]
        return [np.concatenate(maps) for maps in zip(*runs, strict=True)]


def run_network(net: PatternNet, *given: NDArray[np.float32] | None) -> list[NDArray[np.float32]]:
    """Return each output of a network for windows, pads and poses, as a `GraphRun` does of its graph."""
    parts = [None if arrays is None else torch.from_numpy(arrays).split(256) for arrays in given]
    count = max(len(part) for part in parts if part is not None)
    runs = [outputs(net, *part) for part in zip(*(part or [None] * count for part in parts), strict=True)]
    return [torch.cat(maps).numpy() for maps in zip(*runs, strict=True)]


def differences(
    names: Sequence[str],
    expected: Sequence[NDArray[np.float32]],
    got: Sequence[NDArray[np.float32]],
    full_scale: float,
) -> dict[str, float]:
    """Return the largest difference in each output over some windows, (n, ...), as a share.

    It is a share of full scale (deviations have none) or, if that is larger, of the network's largest value for the
    same window: a pattern that is cut at zero may be small where all values before it are large. ParityError if shapes
    differ, or a value is not finite.
    """
    shapes = [[maps.shape for maps in given] for given in (expected, got)]
    if shapes[0] != shapes[1]:
        raise ParityError(f"outputs of shape {shapes[1]}, expected {shapes[0]}")
    measured = {}
    sizes = {name: np.abs(maps).reshape(len(maps), -1).max(axis=1) for name, maps in zip(names, expected, strict=True)}
    for name, true, mine in zip(names, expected, got, strict=True):
        if not np.isfinite(true).all():
            raise ParityError(f"torch gives a {name} that is not finite")
        if not np.isfinite(mine).all():
            raise ParityError(f"the {name} is not finite")
        same_unit = [size for other, size in sizes.items() if (other == TRACTION_NAME) == (name == TRACTION_NAME)]
        # Differences of small tractions are relative to that of 40 N evenly on the pad, in [kPa].
        unit = {OUTPUT_NAME: full_scale, TRACTION_NAME: 100.0}.get(name, 0.0)
        # Around a pixel that changes regions a deviation is another one: one pixel in ten may be so.
        share = 0.9 if name == DEVIATION_NAME else 1.0
        distance = np.quantile(np.abs(mine - true).reshape(len(true), -1), share, axis=1, method="higher")
        measured[name] = float((distance / np.maximum(unit, np.max(same_unit, axis=0))).max())
    return measured


def accepted(output: str, tolerance: float) -> float:
    """Return the largest accepted difference in an output, where it is `tolerance` in a pattern."""
    # A pixel at the contact level lies inside or outside by its last bit; that moves the regions around it, and with
    # their sizes the factors of the deviations in the whole window: measured 0.0002.
    return max(tolerance, 1e-3) if output == DEVIATION_NAME else tolerance


def _example_pads(count: int, width: int) -> NDArray[np.float32]:
    """Draw pad inputs as in `Contract.pad_row`, (count, width); every third pad is without constants."""
    rng, constants = np.random.default_rng(0), width // 2
    flags = rng.integers(0, 2, (count, constants))
    values = rng.uniform(-1, 1, (count, constants)) * flags
    pads = np.concatenate([values, flags, rng.uniform(0, 1, (count, width % 2))], axis=1).astype(np.float32)
    pads[::3] = 0
    return pads


def _example_poses(count: int, contract: Contract) -> NDArray[np.float32]:
    """Draw poses of all taps within reach, (count, K, 5); every third window has the paper's schedule."""
    far_mm = contract.reach_mm / np.sqrt(2)
    most = np.array([far_mm, far_mm, 180, 2, 10])
    poses = np.random.default_rng(0).uniform(most * (-1, -1, -1, 0, 0), most, (count, contract.taps, 5))
    poses[::3] = scheduled_rows(contract.taps, contract.angle_step_deg)
    poses[:, 0] = 0
    return poses.astype(np.float32)


def check_parity(net: PatternNet, model: onnx.ModelProto, frozen: FrozenSet, contract: Contract) -> float:
    """Return the largest difference between torch and a float32 graph, on readings and extreme windows.

    ParityError if it is too large, or a value is not finite.
    """
    run = GraphRun(model)
    largest = 0.0
    for windows, tolerance in (
        (read_windows(frozen, contract), TOLERANCE),
        (np.concatenate([*extreme_windows(contract).values()]), EXTREME_TOLERANCE),
    ):
        pads = _example_pads(len(windows), net.known) if net.known else None
        poses = _example_poses(len(windows), contract) if contract.takes_poses else None
        expected = run_network(net, windows, pads, poses)
        off = differences(run.outputs, expected, run(windows, pads, poses), contract.output_full_scale)
        for output, relative in off.items():
            if not relative <= (most := accepted(output, tolerance)):
                raise ParityError(
                    f"onnxruntime and torch differ by {relative:.2e} in the {output}, expected at most {most:.0e}"
                )
        largest = max(largest, *off.values())
    return largest


def read_windows(frozen: FrozenSet, contract: Contract, count: int | None = 100) -> NDArray[np.float32]:
    """Return about `count` readings of the frozen set, of all forces, or all: (n, 3K, rows, cols) in network units."""
    # Odd, because an even step could always select the same frame of a tap.
    step = 1 if count is None else max(1, len(frozen) // count) | 1
    windows = frozen.windows(contract.taps)[::step]
    return np.stack([contract.scale_window(window) for window in windows]).reshape(
        len(windows), -1, contract.rows, contract.cols
    )


def extreme_windows(contract: Contract) -> Mapping[str, NDArray[np.float32]]:
    """Return windows outside every test set, by name: each (1, 3K, rows, cols) in network units."""
    full = np.full((contract.taps, 3, contract.rows, contract.cols), FULL_RANGE_COUNTS, dtype=np.float32)
    hot = np.zeros_like(full)
    hot[0, 2, 0, 0] = FULL_RANGE_COUNTS
    sudden = np.zeros_like(full)
    sudden[0] = full[0]
    press = np.zeros_like(full)
    press[:, 2, 1:3, 1:3] = 1000
    counts = {
        "zeros": np.zeros_like(full),
        "a count in one taxel": hot / FULL_RANGE_COUNTS,
        "one hot taxel": hot,
        "full range": full,
        "full range, negative": -full,
        "10 x full range": 10 * full,
        "1000 x full range": 1000 * full,
        "rest to full load in one scan": sudden,
    }
    for given in range(1, contract.taps):
        present = (np.arange(contract.taps) < given)[:, None, None, None]
        counts[f"{given} of {contract.taps} taps"] = np.where(present, press, 0).astype(np.float32)
    windows = {
        name: contract.scale_window(window).reshape(1, -1, contract.rows, contract.cols)
        for name, window in counts.items()
    }
    # Bits of 1e-40: written as a number it would be zero wherever a program has set denormals to zero.
    return windows | {"denormals": np.full(windows["zeros"].shape, 0x000116C2, dtype=np.uint32).view(np.float32)}
