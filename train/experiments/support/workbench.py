"""Workbench of the experiments: datasets and networks made once and kept, and errors and cost of methods."""

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from edge.evaluation.evaluate import judge
from edge.evaluation.test_set import FrozenSet
from edge.inference.bundled import BUNDLE_DIR, DEFAULT_MODEL
from edge.inference.onnx_session import ModelSession
from firmware_bridge.pad_geometry import USPA44
from train.data.frozen_presses import WIDE_TEST, FrozenPresses, load_frozen_presses
from train.data.make_presses import make_presses
from train.data.paper_taps import PaperTaps, paper_taps
from train.data.presses import SEED, PressSet, one_thread
from train.data.world import World
from train.freeze import freeze
from train.learning.checkpoint import Training, fit_network, infer, load_network
from train.networks.blocks import PatternNet
from train.networks.symmetric import SymmetricConv2d
from train.physics.gripped import FRAMES
from train.physics.sensor_noise import Nuisances
from train.report import Row, with_interval
from train.surfaces.named_surfaces import SURFACES
from train.surfaces.poses import ANGLE_STEP_DEG, Split

_TIMED_RUNS: Final = 30
_TIMED_MS: Final = 2000.0
_QUICK_SURFACES: Final = 2
_QUICK_PRESSES: Final = 42
_QUICK_ONE_IN: Final = 12
_QUICK_OPTIONS: Final = {"channels": 16, "blocks": 1}

Figures = dict[str, NDArray[np.float64]]
"""Every metric of every frame, (n,) each, as returned by edge.evaluation.evaluate."""


@dataclass(frozen=True)
class Method:
    """Method from windows to patterns.

    Attributes:
        name: as shown in tables.
        taps: taps of a window that the method uses.
        contact_level: share of a pattern's maximum from which a pixel counts as touched.
        run: windows (n, taps, 3, rows, cols) in zeroed counts to patterns and deviations, (n, H, W) in [mm], or None.
        measure: gives parameters, multiply-accumulates and run time, as cells of a row.
        training: steps and time, as cells of a row.
    """

    name: str
    taps: int
    contact_level: float
    run: Callable[[NDArray[np.float32]], tuple[NDArray[np.floating], NDArray[np.float32] | None]]
    measure: Callable[[], Row] = dict
    training: Row = field(default_factory=dict)

    @cached_property
    def cost(self) -> Row:
        """Parameters, multiply-accumulates and run time, as cells of a row; measured once, as it takes two seconds."""
        return self.measure()

    def patterns(self, windows: NDArray[np.float32]) -> NDArray[np.floating]:
        """Return patterns (n, H, W) in [mm] of windows (n, K, 3, rows, cols); K is at least `taps`."""
        return self.run(windows[:, : self.taps])[0]

    def judged(self, frozen: FrozenSet, given: int | None = None) -> Figures:
        """Return every metric of every frame, with the newest `given` taps or all that the method uses."""
        return judge(self.patterns(frozen.windows(self.taps, given)), frozen, self.contact_level)


@dataclass
class Workbench:
    """Folders of datasets, trained networks and shipped models, with the files `used` of them; tiny ones if `quick`."""

    data_folder: Path = Path("data")
    checkpoints: Path = Path("checkpoints")
    quick: bool = False
    models: Path = BUNDLE_DIR
    used: set[Path] = field(default_factory=set)
    _tapped: dict[tuple[Split, tuple[str, ...], float], PaperTaps] = field(default_factory=dict)

    def use(self, path: Path) -> Path:
        """Return the path, which the head of the report is to name with its hash."""
        self.used.add(path)
        return path

    def presses(self, name: str, world: World, quick_taps: int = 1) -> PressSet:
        """Return the presses of that world, read if they exist, else made; in a quick run a few of `quick_taps`."""
        if self.quick:
            name, world = (
                f"quick-{name}",
                replace(world, count=_QUICK_PRESSES, taps=quick_taps, per_pad=_QUICK_PRESSES // 2),
            )
        self.data_folder.mkdir(parents=True, exist_ok=True)
        return make_presses(world, self.data_folder / f"{name}.npz")

    def model(self, name: str = DEFAULT_MODEL) -> ModelSession:
        """Return a shipped model, in the session of the runtime."""
        return ModelSession(self.use(self.models / f"{name}.onnx"))

    def wide_test(self) -> FrozenPresses:
        """The wide frozen set."""
        wide = load_frozen_presses(self.use(WIDE_TEST))
        return wide.pick(np.arange(len(wide)) % _QUICK_ONE_IN == 0) if self.quick else wide

    def network(self, training: Training, data: PressSet, validation: FrozenSet) -> Method:
        """Return a trained network, read if the same training on these data exists, else trained."""
        if self.quick:
            training = _quick(training)
        path = self.checkpoints / f"{training.name}.pt"
        before = path.stat().st_mtime_ns if path.exists() else None
        fit_network(training, data, validation, self.checkpoints)
        net, report = load_network(self.use(path))
        if path.stat().st_mtime_ns != before:
            sys.stdout.write(f"{training.name}: {report['steps']} steps in {report['elapsed_s']:.0f} s\n")
        steps, elapsed_s, level = report["steps"], report["elapsed_s"], report["contact_level"]
        while (start := report["config"]["start"]) is not None:  # its training counts as well
            _, report = load_network(self.checkpoints / f"{start}.pt")
            steps, elapsed_s = steps + report["steps"], elapsed_s + report["elapsed_s"]
        cells: Row = {"steps": steps, "training min": round(elapsed_s / 60, 1)}
        return Method(training.name, net.taps, level, partial(infer, net), partial(_cost_of_network, net), cells)

    def held_out(
        self, split: Split, surfaces: Sequence[str] = SURFACES, angle_step_deg: float = ANGLE_STEP_DEG
    ) -> PaperTaps:
        """Return clean sequences of the paper's protocol at a held-out position."""
        names = tuple(surfaces[:_QUICK_SURFACES] if self.quick else surfaces)
        if (split, names, angle_step_deg) not in self._tapped:
            self._tapped[split, names, angle_step_deg] = paper_taps(split, names, angle_step_deg=angle_step_deg)
        return self._tapped[split, names, angle_step_deg]

    def frozen(
        self,
        split: Split,
        surfaces: Sequence[str] = SURFACES,
        scale: int = 10,
        angle_step_deg: float = ANGLE_STEP_DEG,
    ) -> FrozenSet:
        """Return a frozen set made like the bundled one, with other surfaces, scale or angle."""
        frozen = freeze(self.held_out(split, surfaces, angle_step_deg), Nuisances(), SEED, scale=scale)
        return frozen.thinned(FRAMES) if self.quick else frozen  # one frame a tap


def error_cells(figures: Figures, frozen: FrozenSet, split: str) -> Row:
    """Return mean errors over a frozen set as cells of a row, PSNR with its interval by tap."""
    return {
        f"{split} PSNR dB": with_interval(figures["psnr_db"], frozen.tap),
        f"{split} SSIM": round(float(figures["ssim"].mean()), 4),
        f"{split} SSIM global": round(float(figures["ssim_global"].mean()), 4),
        f"{split} RMSE %": round(float(figures["rmse_percent"].mean()), 3),
        f"{split} IoU": round(float(figures["contact_iou"].mean()), 4),
        f"{split} boundary mm": round(float(figures["boundary_mm"].mean()), 3),
    }


def _cost_of_network(net: PatternNet) -> Row:
    """Return parameters, multiply-accumulates, and run time of one window in torch on one thread, as cells of a row."""
    window = torch.zeros(1, 3 * int(net.taps), *USPA44.scan_shape[1:])
    with one_thread(), torch.inference_mode():
        run_time_ms = median_ms(lambda: net(window))
    return {"parameters": parameters_count(net), "MMAC": round(macs(net) / 1e6, 1), "run time ms": run_time_ms}


def median_ms(run: Callable[[], object]) -> float:
    """Return the median time of some runs, without the first third of them, in [ms]."""
    times_ms: list[float] = []
    while len(times_ms) < _TIMED_RUNS and sum(times_ms) < _TIMED_MS:
        started_s = time.perf_counter()
        run()
        times_ms.append(1e3 * (time.perf_counter() - started_s))
    return round(float(np.median(times_ms[len(times_ms) // 3 :])), 3)


def _quick(training: Training) -> Training:
    """Return the training in miniature, under its own name."""
    recipe = replace(training.recipe, steps=1, batch=2, minutes=None)
    options = _QUICK_OPTIONS if training.network.startswith("compact") else {}
    start = training.start and f"quick-{training.start}"
    return replace(training, name=f"quick-{training.name}", recipe=recipe, options=options, start=start)


def parameters_count(net: nn.Module) -> int:
    """Return the number of trainable parameters."""
    return sum(parameter.numel() for parameter in net.parameters())


def macs(net: PatternNet) -> int:
    """Count multiply-accumulates of one window in convolutions and linear layers, without norms and interpolation."""
    counted: list[int] = []

    def count(layer: nn.Conv2d | nn.Linear | SymmetricConv2d, _: object, output: torch.Tensor) -> None:
        # Every output value is the sum of as many products as one row of the weights has entries.
        counted.append(output[0].numel() * layer.weight[0].numel())

    summing = [layer for layer in net.modules() if isinstance(layer, (nn.Conv2d, nn.Linear, SymmetricConv2d))]
    hooks = [layer.register_forward_hook(count) for layer in summing]
    like, training = next(net.parameters()), net.training
    try:
        with torch.inference_mode():
            net.eval()(torch.zeros(1, 3 * net.taps, USPA44.rows, USPA44.cols, device=like.device, dtype=like.dtype))
    finally:
        for hook in hooks:
            hook.remove()
        net.train(training)
    return sum(counted)
