"""Model that takes poses, as a real graph and without onnxruntime: each tap counts by a sum of its pose's numbers."""

from pathlib import Path

import numpy as np
from edge_samples import FakeModel, make_contract, save_graph, tiny_deviation
from onnx import helper

from edge.inference.contract import DEVIATION_NAME, INPUT_NAME, OUTPUT_NAME, POSES_NAME, Contract

WEIGHTS = np.array([0.5, 0.25, 0.0625, 2.0, 0.125], dtype=np.float32)
"""Weights of dx, dy, turn and the errors, all different, so that a number that is lost or exchanged shows."""


def make_posed_contract(**changes) -> Contract:
    return make_contract(**({"taps": 7, "takes_poses": True, "reach_mm": 10.0} | changes))


def posed_pattern(window: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return the model's pattern for a window (taps, 3, rows, cols) and its poses (taps, 5)."""
    z = sum(tap[2] * (1 + pose @ WEIGHTS) for tap, pose in zip(window, poses, strict=True))
    return np.kron(z, np.ones((10, 10)))


def write_posed_model(path: Path, contract: Contract | None = None) -> Path:
    contract = contract or make_posed_contract()
    scale = contract.scale
    nodes = [
        helper.make_node("Mul", [POSES_NAME, "weights"], ["weighed"]),
        helper.make_node("ReduceSum", ["weighed", "numbers"], ["sum"], keepdims=0),
        helper.make_node("Add", ["sum", "one"], ["shares"]),
        helper.make_node("Unsqueeze", ["shares", "grid"], ["share"]),
        helper.make_node("Gather", [INPUT_NAME, "z"], ["normal"], axis=2),
        helper.make_node("Mul", ["normal", "share"], ["parts"]),
        helper.make_node("ReduceSum", ["parts", "taps"], ["whole"], keepdims=1),
        helper.make_node("ConvTranspose", ["whole", "square"], ["squares"], strides=[scale, scale]),
        helper.make_node("Squeeze", ["squares", "taps"], [OUTPUT_NAME]),
    ]
    if contract.interval_factor is not None:
        nodes += [
            helper.make_node("Abs", [OUTPUT_NAME], ["size"]),
            helper.make_node("Add", ["size", "one"], ["doubted"]),
            helper.make_node("Mul", ["doubted", "doubt"], [DEVIATION_NAME]),
        ]
    constants = {
        "weights": WEIGHTS,
        "numbers": np.array([2]),
        "one": np.array(1, dtype=np.float32),
        "grid": np.array([2, 3]),
        "z": np.array(2),
        "taps": np.array([1]),
        "square": np.ones((1, 1, scale, scale), dtype=np.float32),
        "doubt": np.array(0.01, dtype=np.float32),
    }
    return save_graph(path, nodes, contract, constants, contract.to_metadata())


class PosedModel(FakeModel):
    """The model without onnxruntime."""

    def __init__(self, contract: Contract | None = None) -> None:
        super().__init__(contract or make_posed_contract())

    def run(self, window: np.ndarray, pad: np.ndarray | None = None, poses: np.ndarray | None = None) -> np.ndarray:
        assert poses is not None and len(poses) == len(window)
        super().run(window, pad)
        pattern = posed_pattern(window, poses).astype(np.float32)
        if self.contract.interval_factor is not None:
            self.deviation = tiny_deviation(pattern)
        return pattern
