"""Workbench of the experiments: datasets made once and kept, and models run on them as the runtime does."""

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.inference.bundled import BUNDLE_DIR, DEFAULT_MODEL
from edge.inference.onnx_session import ModelSession
from firmware_bridge.scans.pad_constants import Pad
from train.data.frozen_presses import WIDE_TEST, FrozenPresses, load_frozen_presses
from train.data.make_presses import make_presses, quiet_workers
from train.data.presses import PressSet
from train.data.world import World
from train.report import Report

_QUICK_PRESSES: Final = 42

Figures = dict[str, NDArray[np.float64]]
"""Every metric of every frame, (n,) each, as returned by edge.evaluation.evaluate."""


@dataclass
class Workbench:
    """Folders of datasets and shipped models, with the files `used` of them; tiny sets if `quick`."""

    data_folder: Path = Path("data")
    quick: bool = False
    models: Path = BUNDLE_DIR
    used: set[Path] = field(default_factory=set)

    def use(self, path: Path) -> Path:
        """Return the path, which the head of the report is to name with its hash."""
        self.used.add(path)
        return path

    def presses(self, name: str, world: World, quick_taps: int = 1) -> PressSet:
        """Return the presses of that world, read if they exist, else made; in a quick run a few of `quick_taps`."""
        if self.quick:
            name = f"quick-{name}"
            world = replace(world, count=_QUICK_PRESSES, taps=quick_taps, per_pad=_QUICK_PRESSES // 2)
        self.data_folder.mkdir(parents=True, exist_ok=True)
        path = self.data_folder / f"{name}.npz"
        with nullcontext() if path.exists() else quiet_workers():
            return make_presses(world, path)

    def model(self, name: str = DEFAULT_MODEL) -> ModelSession:
        """Return a shipped model, in the session of the runtime."""
        return ModelSession(self.use(self.models / f"{name}.onnx"))

    def wide_test(self) -> FrozenPresses:
        """Return the wide frozen set."""
        wide = load_frozen_presses(self.use(WIDE_TEST))
        return wide.pick(np.arange(len(wide)) % 12 == 0) if self.quick else wide


SHORT: Final = {False: "model", True: "model, all known"}
"""Names of a model that is told nothing of a sensor, and of one that is told its pad's constants and its gains."""


class Inferred(NamedTuple):
    """Patterns and deviations (n, H, W) in [mm], zeros if the model gives none, and the median run time in [us]."""

    patterns: NDArray[np.float32]
    deviations: NDArray[np.float32]
    run_time_us: float


def known_pads(frozen: FrozenPresses, known: bool) -> list[Pad | None]:
    """Return all that can be known of each press's sensor, or nothing."""
    return [frozen.pad(index, gains=True) if known else None for index in range(len(frozen))]


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


def infer_presses(model: ModelSession, frozen: FrozenPresses, known: bool) -> Inferred:
    """Run a model on frozen presses, with all or nothing known of their sensors."""
    return infer(model, frozen.windows(model.contract.taps), known_pads(frozen, known))


def name_of(model: ModelSession) -> str:
    """Return a model's name and training, as reports begin."""
    return f"`{model.name}` (training {model.contract.training_sha256[:12]})"


Experiment = Callable[[Workbench, Report], None]
"""Function that measures with a workbench, and adds to a report what it says and its tables."""
