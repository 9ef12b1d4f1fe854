"""Shipped model applied to windows and pads through the session of the runtime."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.bundled import DEFAULT_MODEL
from edge.inference.onnx_session import ModelSession
from firmware_bridge.scans.pad_constants import Pad
from train.data.frozen_presses import FrozenPresses

NOTHING, FORCE, PAD, ALL = KNOWN = ("nothing", "counts per newton", "pad", "pad and gains")
"""Levels of knowledge about a sensor: nothing, one constant of its pad, all constants, and these with taxel gains."""
SHORT: Final = {NOTHING: "model", FORCE: "model, counts/N known", PAD: "model, pad known", ALL: "model, all known"}
"""Names of the levels in tables."""


@dataclass(frozen=True, slots=True)
class Inferred:
    """Output of a model for n windows.

    Attributes:
        patterns: (n, H, W) in [mm].
        traction_kpa: (n, 3, h, w), or None if the model has no traction output.
        run_time_us: median of a window on one thread, scaling included, in [us].
    """

    patterns: NDArray[np.float32]
    traction_kpa: NDArray[np.float32] | None
    run_time_us: float


def load_shipped(folder: Path) -> ModelSession:
    """Load the shipped model.

    Raises:
        ModelError: it does not exist, or cannot be used.
    """
    return ModelSession(folder / f"{DEFAULT_MODEL}.onnx")


def known_pads(frozen: FrozenPresses, known: str) -> list[Pad | None]:
    """Return the constants of each press's sensor that a level of KNOWN provides."""
    if known == NOTHING:
        return [None] * len(frozen)
    pads = [frozen.pad(index, gains=known == ALL) for index in range(len(frozen))]
    return [Pad(counts_per_newton=pad.counts_per_newton) for pad in pads] if known == FORCE else [*pads]


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
    patterns, tractions, times_s = [], [], []
    for number, (window, pad) in enumerate(zip(windows, pads, strict=True)):
        gains = None
        if contract.takes_gains and pad is not None and pad.gains is not None:
            gains = np.asarray(pad.gains, dtype=np.float32).reshape(window.shape[1:])
        row = contract.pad_row(pad)
        started_s = time.perf_counter()
        pattern = model.run(contract.scale_window(window, gains), row, None if poses is None else poses[number])
        times_s.append(time.perf_counter() - started_s)
        patterns.append(pattern.copy())
        tractions.append(None if model.traction is None else model.traction.copy())
    return Inferred(
        np.stack(patterns),
        None if any(one is None for one in tractions) else np.stack(tractions),
        1e6 * float(np.median(times_s)),
    )


def infer_presses(model: ModelSession, frozen: FrozenPresses, known: str) -> Inferred:
    """Run a model on frozen presses with the constants that a level of KNOWN provides."""
    return infer(model, frozen.windows(model.contract.taps), known_pads(frozen, known))
