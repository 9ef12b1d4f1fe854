"""Shipped model applied to windows and pads through the session of the runtime."""

import time
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.inference.onnx_session import ModelSession
from firmware_bridge.scans.pad_constants import Pad
from train.data.frozen_presses import FrozenPresses

NOTHING, ALL = "nothing", "pad and gains"
"""Levels of knowledge about a sensor: nothing, or all constants of its pad with the taxels' gains."""
SHORT: Final = {NOTHING: "model", ALL: "model, all known"}
"""Names of the levels in tables."""


class Inferred(NamedTuple):
    """Patterns and deviations (n, H, W) in [mm], zeros if the model gives none, and the median run time in [us]."""

    patterns: NDArray[np.float32]
    deviations: NDArray[np.float32]
    run_time_us: float


def known_pads(frozen: FrozenPresses, known: str) -> list[Pad | None]:
    """Return what a level of knowledge provides of each press's sensor."""
    return [frozen.pad(index, gains=True) if known == ALL else None for index in range(len(frozen))]


def infer(
    model: ModelSession,
    windows: NDArray[np.float32],
    pads: Sequence[Pad | None],
    poses: NDArray[np.float32] | None = None,
) -> Inferred:
    """Run a model as the runtime does, on each window of as many taps as it takes, (n, taps, 3, rows, cols) as read.

    `pads` are the constants that are known of each sensor; poses are (n, taps, 5), None for the paper's schedule.
    """
    contract = model.contract
    patterns, deviations, times_s = [], [], []
    for number, (window, pad) in enumerate(zip(windows, pads, strict=True)):
        gains = None
        if contract.takes_gains and pad is not None and pad.gains is not None:
            gains = np.asarray(pad.gains, dtype=np.float32).reshape(window.shape[1:])
        row = contract.pad_row(pad)
        started_s = time.perf_counter()
        pattern = model.run(contract.scale_window(window, gains), row, None if poses is None else poses[number])
        times_s.append(time.perf_counter() - started_s)
        patterns.append(pattern.copy())
        deviations.append(np.zeros_like(pattern) if model.deviation is None else model.deviation.copy())
    return Inferred(np.stack(patterns), np.stack(deviations), 1e6 * float(np.median(times_s)))


def infer_presses(model: ModelSession, frozen: FrozenPresses, known: str) -> Inferred:
    """Run a model on frozen presses with what a level of knowledge provides."""
    return infer(model, frozen.windows(model.contract.taps), known_pads(frozen, known))
