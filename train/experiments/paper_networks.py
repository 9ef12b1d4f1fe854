"""The paper's protocol: its data, the networks that are trained on them, and the methods that are compared."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.classical_methods import CONTACT_LEVEL, fitted_methods, method_macs
from edge.evaluation.test_set import FrozenSet, judge
from firmware_bridge.pad_geometry import USPA44
from train.data.presses import PressSet, join_presses
from train.data.world import World
from train.experiments.workbench import Figures, Method, Workbench, median_ms
from train.fit import given_taps
from train.freeze import CLASSICAL_WINDOWS, fit_classical
from train.learning.checkpoint import Training
from train.learning.training_loop import Recipe
from train.physics.gripped import FINE_SCALE, SCALE
from train.report import Row, with_interval
from train.surfaces.named_surfaces import SURFACES
from train.surfaces.poses import MAX_TAPS

HELD_OUT: Final = ("S", "hollow circle", "hollow triangle")  # surfaces that Fig. 16 leaves out of a training.
KNOWN: Final = tuple(name for name in SURFACES if name not in HELD_OUT)
_SET: Final = World(taps=MAX_TAPS, schedule="turns", spread=0.0, scale=FINE_SCALE)
SETS: Final = {
    "known": replace(_SET, families=dict.fromkeys(KNOWN, 1.0), count=7500, seed=1),
    "held-out": replace(_SET, families=dict.fromkeys(HELD_OUT, 1.0), count=1500, seed=2),
    "figures": replace(_SET, families={"glyph": 1.0, "polygon": 1.0}, count=9000, seed=3),
}
"""Presses by the nominal pad, turned from tap to tap: of the 15 other surfaces, of those three, of random figures."""

_PASS: Final = 1125
"""Steps of the paper's networks in batches of 16: one pass over the data, a quarter of an hour for the STSR."""
BASE: Final = Training("taps-stsr", "compact-stsr", Recipe(steps=16_000, bf16=True))
"""Compact STSR trained on the paper's figures and random ones, without pad constants."""


def presses(bench: Workbench, name: str) -> PressSet:
    """Return one of SETS, with the truth at x20."""
    return bench.presses(f"paper-{name}", SETS[name], MAX_TAPS)


def mixed(bench: Workbench, scale: int = SCALE) -> PressSet:
    """Return the mixed data, the 18 surfaces and as many random figures, with the truth at a scale."""
    return join_presses([presses(bench, name) for name in SETS]).at_scale(scale)


def compact(name: str) -> Training:
    """Return the training of a compact network: stsr, the base; mtsr2, ... mtsr7, trained on from it."""
    return BASE if name == "stsr" else from_base(name, int(name.removeprefix("mtsr")), 2000)


def from_base(name: str, taps: int, steps: int, scale: int = SCALE) -> Training:
    """Return the training of a compact network from the base's trunk; at another scale its output layers are new."""
    recipe = Recipe(steps=steps, learning_rate=1e-3, given=given_taps(taps))
    network, seed = ("compact-stsr", 1) if taps == 1 else (f"compact-mtsr{taps}", 1 + taps)
    return Training(f"taps-{name}", network, recipe, scale, BASE.name, seed)


def published(name: str) -> Training:
    """Return the training of a network of the paper: SRGAN on top of SRCNN, every MTSR-K on top of the STSR.

    `stsr longer` is trained on for as long as MTSR-2 from the STSR, so that the two differ by the second tap alone.
    """
    network, _, longer = name.partition(" ")
    taps = int(network.removeprefix("mtsr")) if network.startswith("mtsr") else 1
    start = "seed-srcnn" if network == "srgan" else "seed-stsr" if taps > 1 or longer else None
    given, steps = given_taps(taps), _PASS // 4 if start == "seed-stsr" else _PASS
    recipe = Recipe(steps, batch=16, learning_rate=5e-4, weight_decay=1e-2, given=given, bf16=True)
    return Training(f"seed-{name}", network, recipe, start=start)


_STARTS: Final = {start.name: start for start in (BASE, published("stsr"), published("srcnn"))}


def trained(bench: Workbench, training: Training, data: PressSet, validation: FrozenSet) -> Method:
    """Return a trained network; the network that it starts from is trained first."""
    if training.start:
        bench.fit(_STARTS[training.start], data, validation)
    return bench.network(training, data, validation)


def compact_methods(bench: Workbench, data: PressSet, names: Sequence[str]) -> list[Method]:
    """Return compact networks by name (stsr, mtsr2, ...), trained on `data` where no checkpoint exists."""
    validation = bench.frozen("validation")
    return [replace(trained(bench, compact(name), data, validation), name=name) for name in names]


def classical_methods(bench: Workbench, data: PressSet, names: Sequence[str]) -> list[Method]:
    """Return methods of edge.evaluation.classical_methods by name, fitted on windows of `data`."""
    path = bench.data_folder / f"classical-{data.sha256()[:10]}.npz"
    if not path.exists():
        fitted = fit_classical(data, 300 if bench.quick else CLASSICAL_WINDOWS)
        np.savez_compressed(path, allow_pickle=False, **fitted)
    fits, scan = fitted_methods(path, SCALE), np.zeros((1, *USPA44.scan_shape), dtype=np.float32)

    def method(name: str) -> Method:
        parameters = 3 * USPA44.taxel_count * (USPA44.taxel_count * SCALE**2) if name == "linear map" else 1
        mega_macs, run_time_ms = round(method_macs(name, SCALE) / 1e6, 3), median_ms(partial(fits[name], scan))
        cost: Row = {"parameters": parameters, "MMAC": mega_macs, "run time ms": run_time_ms}
        return Method(name, 1, CONTACT_LEVEL, lambda windows: (fits[name](windows[:, 0]), None), cost)

    return [method(name) for name in names]


def judged(
    head: Row,
    method: Method,
    sets: Mapping[str, FrozenSet],
    given: int | None = None,
    alone_db: NDArray[np.float64] | None = None,
) -> tuple[Row, NDArray[np.float64]]:
    """Return the row of a method with its errors on each set, and the PSNR in [dB] of every frame of the last, (n,).

    The method gets the newest `given` taps, or all that it uses; `alone_db` is that of the STSR, to state the gain.
    """
    row, found_db = dict(head), np.empty(0)
    for split, frozen in sets.items():
        figures = judge(method.patterns(frozen.windows(method.taps, given)), frozen, method.contact_level)
        row |= error_cells(figures, frozen, split)
        found_db = figures["psnr_db"]
        if alone_db is not None:
            row["over STSR dB"] = with_interval(found_db - alone_db, frozen.tap, sign="+")
    return row | method.cost | method.training, found_db


def error_cells(figures: Figures, frozen: FrozenSet, split: str) -> Row:
    """Return mean errors over a frozen set as cells of a row, PSNR with its interval by tap."""
    return {
        f"{split} PSNR dB": with_interval(figures["psnr_db"], frozen.tap),
        f"{split} SSIM": round(float(figures["ssim"].mean()), 4),
        f"{split} RMSE %": round(float(figures["rmse_percent"].mean()), 3),
        f"{split} IoU": round(float(figures["contact_iou"].mean()), 4),
        f"{split} boundary mm": round(float(figures["boundary_mm"].mean()), 3),
    }
