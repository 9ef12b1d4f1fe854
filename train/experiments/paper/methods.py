"""Methods that experiments compare, compact networks and classical ones, each a call from windows to patterns."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.classical_methods import CONTACT_LEVEL, fitted_methods, method_macs
from edge.evaluation.evaluate import judge
from edge.evaluation.test_set import FrozenSet
from firmware_bridge.pad_geometry import USPA44
from train.data.presses import PressSet
from train.errors import TrainError
from train.experiments.paper.trainings import compact, trained
from train.experiments.support.workbench import Figures, Workbench, cost_cells
from train.freeze import CLASSICAL_WINDOWS, SCALE, fit_classical
from train.learning.checkpoint import infer
from train.networks.blocks import PatternNet
from train.report import Row

_QUICK_WINDOWS: Final = 300
_TIMED_RUNS: Final = 30


@dataclass(frozen=True, slots=True)
class Method:
    """Method from windows to patterns.

    Attributes:
        name: as shown in tables.
        taps: taps of a window that the method uses.
        contact_level: share of a pattern's maximum from which a pixel counts as touched.
        cost: parameters, multiply-accumulates and run time, as cells of a row.
        run: windows (n, taps, 3, rows, cols) in zeroed counts to patterns (n, H, W) in [mm].
    """

    name: str
    taps: int
    contact_level: float
    cost: Row
    run: Callable[[NDArray[np.float32]], NDArray[np.floating]]

    def patterns(self, windows: NDArray[np.float32]) -> NDArray[np.floating]:
        """Return patterns (n, H, W) in [mm] of windows (n, K, 3, rows, cols); K is at least `taps`."""
        return self.run(windows[:, : self.taps])

    def figures(self, frozen: FrozenSet) -> Figures:
        """Return every metric of every frame of a frozen set."""
        return judge(self.patterns(frozen.windows(self.taps)), frozen, self.contact_level)


def compact_methods(bench: Workbench, data: PressSet, names: tuple[str, ...]) -> list[Method]:
    """Return compact networks by name (stsr, mtsr2, ...), trained on `data` where no checkpoint exists."""
    validation = bench.frozen("validation")
    methods: list[Method] = []
    for name in names:
        net, facts = trained(bench, compact(name), data, validation)
        run = partial(_infer, net)
        methods.append(Method(name, net.taps, facts["contact_level"], cost_cells(net), run))
    return methods


def classical_methods(bench: Workbench, data: PressSet, names: tuple[str, ...]) -> list[Method]:
    """Return methods of edge.evaluation.classical_methods by name, fitted on windows of `data`."""
    path = bench.data_folder / f"classical-{data.sha256()[:10]}.npz"
    if not path.exists():
        fitted = fit_classical(data, _QUICK_WINDOWS if bench.quick else CLASSICAL_WINDOWS)
        np.savez_compressed(path, allow_pickle=False, **fitted)
    by_name = fitted_methods(path, SCALE)
    with np.load(path, allow_pickle=False) as arrays:
        sizes = {"linear map": arrays["linear_map"].size}
    methods: list[Method] = []
    for name in names:
        if name not in by_name:
            raise TrainError(f"no classical method {name!r}: expected one of {', '.join(by_name)}")
        run, macs = by_name[name], method_macs(name, SCALE)
        cost: Row = {
            "parameters": sizes.get(name, 1),
            "MMAC": round(macs / 1e6, 3),
            "run time ms": _run_time_ms(run),
        }
        methods.append(Method(name, 1, CONTACT_LEVEL, cost, lambda windows, run=run: run(windows[:, 0])))
    return methods


def _infer(net: PatternNet, windows: NDArray[np.float32]) -> NDArray[np.floating]:
    return infer(net, windows)[0]


def _run_time_ms(run: Callable[[NDArray[np.floating]], NDArray[np.floating]]) -> float:
    """Return the median run time of one scan, in [ms]."""
    scan = np.zeros((1, *USPA44.scan_shape), dtype=np.float32)
    times_ms: list[float] = []
    for _ in range(_TIMED_RUNS):
        started_s = time.perf_counter()
        run(scan)
        times_ms.append(1e3 * (time.perf_counter() - started_s))
    return round(float(np.median(times_ms)), 3)
