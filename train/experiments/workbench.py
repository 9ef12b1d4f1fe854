"""Workbench of the experiments: datasets and networks made once and kept, and models run as the runtime does."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from timeit import repeat
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from edge.evaluation.test_set import FrozenSet
from edge.inference.bundled import BUNDLE_DIR, DEFAULT_MODEL
from edge.inference.onnx_session import ModelSession
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import Pad
from train.data.frozen_presses import WIDE_TEST, FrozenPresses, load_frozen_presses
from train.data.make_presses import make_presses
from train.data.presses import PressSet, one_thread
from train.data.world import World
from train.freeze import freeze
from train.learning.checkpoint import Training, fit_network, load_network
from train.learning.checkpoint import infer as infer_network
from train.physics.gripped import FRAMES, SCALE
from train.report import Report, Row
from train.surfaces.named_surfaces import SURFACES
from train.surfaces.poses import ANGLE_STEP_DEG, Split

_TIMED_RUNS: Final = 12  # of which the first third is left out
_frozen = cache(freeze)  # which takes minutes, and several experiments want the same
_QUICK_PRESSES: Final = 42


@dataclass(frozen=True)
class Method:
    """Method from windows (n, taps, 3, rows, cols) in zeroed counts to patterns, (n, H, W) in [mm]."""

    name: str
    taps: int  # of a window that the method uses
    contact_level: float  # share of a pattern's maximum from which a pixel counts as touched
    run: Callable[[NDArray[np.float32]], NDArray[np.floating]]
    cost: Row = field(default_factory=dict)  # parameters and run time, as cells of a row


@dataclass
class Workbench:
    """Folders of datasets, trained networks and shipped models, with the files `used` of them; tiny ones if `quick`."""

    data_folder: Path = Path("data")
    checkpoints: Path = Path("checkpoints")
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
            world = replace(world, count=_QUICK_PRESSES, taps=quick_taps, per_pad=_QUICK_PRESSES // 2)
        self.data_folder.mkdir(parents=True, exist_ok=True)
        return make_presses(world, self.data_folder / f"{name}.npz")

    def model(self, name: str = DEFAULT_MODEL) -> ModelSession:
        """Return a shipped model, in the session of the runtime."""
        return ModelSession(self.use(self.models / f"{name}.onnx"))

    def wide_test(self) -> FrozenPresses:
        """Return the wide frozen set."""
        wide = load_frozen_presses(self.use(WIDE_TEST))
        return wide.pick(np.arange(len(wide)) % 12 == 0) if self.quick else wide

    def fit(self, training: Training, data: PressSet, validation: FrozenSet) -> Path:
        """Return the checkpoint of a network, which is trained unless the same training on these data exists."""
        if self.quick:
            options = {"channels": 16, "blocks": 1} if training.network.startswith(("compact", "fusion")) else {}
            training = replace(training, recipe=replace(training.recipe, steps=1, batch=2), options=options)
        fit_network(training, data, validation, self.checkpoints)
        return self.use(self.checkpoints / f"{training.name}.pt")

    def network(self, training: Training, data: PressSet, validation: FrozenSet) -> Method:
        """Return a trained network; the one that it starts from must be there."""
        path = self.fit(training, data, validation)
        net, report = load_network(path)
        window = torch.zeros(1, 3 * int(net.taps), *USPA44.scan_shape[1:])
        with one_thread(), torch.inference_mode():
            cost: Row = {
                "parameters": sum(parameter.numel() for parameter in net.parameters()),
                "run time ms": median_ms(lambda: net(window)),
            }
        return Method(path.stem, net.taps, report["contact_level"], lambda given: infer_network(net, given)[0], cost)

    def frozen(
        self,
        split: Split,
        surfaces: Sequence[str] = SURFACES,
        scale: int = SCALE,
        angle_step_deg: float = ANGLE_STEP_DEG,
    ) -> FrozenSet:
        """Return a frozen set made like the bundled one, at another place, with other surfaces, scale or angle."""
        frozen = _frozen(tuple(surfaces[:2] if self.quick else surfaces), split, scale, angle_step_deg)
        return frozen.thinned(FRAMES) if self.quick else frozen  # one frame a tap


def median_ms(run: Callable[[], object]) -> float:
    """Return the median time of some runs, without the first third of them, in [ms]."""
    times_s = repeat(run, number=1, repeat=_TIMED_RUNS)
    return round(1e3 * float(np.median(times_s[_TIMED_RUNS // 3 :])), 3)


SHORT: Final = {False: "model", True: "model, all known"}  # told nothing of a sensor, or its constants and gains


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


Experiment = Callable[[Workbench, Report], None]  # measures with a workbench, and adds to a report what it says
