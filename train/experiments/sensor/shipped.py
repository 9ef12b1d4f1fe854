"""Shipped model applied to windows and pads through the session of the runtime."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.onnx_session import ModelSession
from firmware_bridge.scans.pad_constants import Pad
from train.data.frozen_presses import FrozenPresses
from train.experiments.support.workbench import Figures
from train.report import Row, with_interval

NOTHING, ALL = "nothing", "pad and gains"
"""Levels of knowledge about a sensor: nothing, or all constants of its pad with the taxels' gains."""
SHORT: Final = {NOTHING: "model", ALL: "model, all known"}
"""Names of the levels in tables."""


@dataclass(frozen=True, slots=True)
class Inferred:
    """Output of a model for n windows.

    Attributes:
        patterns: (n, H, W) in [mm].
        deviations: (n, H, W) in [mm]; zeros if the model gives none.
        run_time_us: median of a window on one thread, scaling included, in [us].
    """

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
    """Run a model as the runtime does, window by window.

    Args:
        model: the session.
        windows: (n, taps, 3, rows, cols) in zeroed counts as read, with as many taps as the model takes.
        pads: constants that are available for each of the n sensors.
        poses: (n, taps, 5) of the taps, for a model that takes them; None for the paper's schedule.
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


def pattern_cells(figures: Figures, groups: NDArray[np.integer]) -> Row:
    """Return errors of patterns as cells of a row, with the interval by group."""
    return {
        "PSNR dB": with_interval(figures["psnr_db"], groups),
        "IoU": round(float(figures["contact_iou"].mean()), 3),
        "edge mm": round(float(figures["boundary_mm"].mean()), 3),
        "RMSE %": round(float(figures["rmse_percent"].mean()), 2),
    }
