"""Several taps over one in the paper's own comparison: its figures, its pad, turned by 5 degrees from tap to tap.

The frozen set has 72 sequences, whose intervals are as wide as the gain. A second set of ten times as many, at poses of
their own, was drawn once for this comparison; nothing is trained on it, set by it or chosen by it.

Source: Wu and Liu 2024, Fig. 13.
"""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.evaluation.test_set import FrozenSet
from edge.inference.bundled import DEFAULT_MODEL, POSED_MODEL
from edge.inference.onnx_session import ModelSession
from edge.terminal.progress_bar import tracked
from train.data.generation_config import SEED, Generation
from train.experiments.support.shipped import infer
from train.experiments.support.workbench import Workbench
from train.freeze import freeze
from train.physics.sensor_noise import Nuisances
from train.report import Report, Row, with_interval
from train.surfaces.named_surfaces import SURFACES
from train.surfaces.poses import MAX_TAPS

_MORE: Final = Generation(surfaces=SURFACES, count=720, taps=MAX_TAPS, seed=2_000_029)
"""Ten times the frozen set's sequences."""
_EVERY: Final = 4
"""One frame in so many of a press is evaluated."""
_WAYS: Final = (("mtsr4-int8", 4), (POSED_MODEL, 4), (POSED_MODEL, MAX_TAPS))
_MEAN: Final = "mean of both"
"""Mean of the patterns of one tap and of several, which is not shipped: it takes the run time of both models."""


def run(bench: Workbench, folder: Path) -> Path:
    """Evaluate the shipped models of several taps next to that of one, and write the report `paper-schedule`."""
    more = freeze(bench.data("paper-schedule", _MORE), Nuisances(), SEED)
    sets = {"frozen set": bench.frozen("test"), "more sequences": more}
    names = dict.fromkeys([DEFAULT_MODEL, *(name for name, _ in _WAYS)])
    models = {name: ModelSession(bench.use(bench.models / f"{name}.onnx")) for name in names}
    report = Report("paper-schedule", folder, __file__, bench.used, quick=bench.quick)
    rows = [row for name, one in tracked(sets.items(), "taps", "set") for row in _rows(models, name, one)]
    report.say(
        "Shipped models through the runtime's session, the paper's 18 figures on the nominal pad, no poses stated: the "
        "paper's schedule is assumed. All nuisances, gains N(1, .075). PSNR in dB over presses of 30 to 100 % of their "
        f"force; gains are over `{DEFAULT_MODEL}` with the newest tap of the same sequences, paired; 95 % intervals by "
        "sequence, and by figure as if other figures could have been drawn. Run time: median of a scan, one thread. "
        f"Rows '{_MEAN}' average a pattern with that of the newest tap alone: not shipped, for their run time. "
        f"sha256 of the frozen set: {sets['frozen set'].sha256()[:12]}; with more sequences: {more.sha256()[:12]}."
    )
    report.table(rows, "By model and number of taps.")
    return report.write()


def _rows(models: dict[str, ModelSession], name: str, frozen: FrozenSet) -> list[Row]:
    """Return a row for each model and number of taps."""
    frozen = frozen.thinned(_EVERY)
    one, one_us = _infer(models[DEFAULT_MODEL], frozen, 1)
    found = {(DEFAULT_MODEL, 1): (one, one_us)}
    for model, taps in _WAYS:
        several, run_time_us = found[model, taps] = _infer(models[model], frozen, taps)
        if model == POSED_MODEL:
            found[_MEAN, taps] = (one + several) / np.float32(2), one_us + run_time_us
    alone = psnr_db(one, frozen.patterns(), frozen.full_scale_mm)
    figure = np.unique(frozen.surface, return_inverse=True)[1][frozen.tap]
    rows: list[Row] = []
    for (model, taps), (patterns, run_time_us) in found.items():
        error = psnr_db(patterns, frozen.patterns(), frozen.full_scale_mm)
        row: Row = {"set": name, "sequences": len(frozen.surface), "model": model, "taps": taps}
        row["PSNR dB"] = with_interval(error, frozen.tap)
        row["over one tap"] = None if taps == 1 else with_interval(error - alone, frozen.tap)
        row["over one tap, by figure"] = None if taps == 1 else with_interval(error - alone, figure)
        rows.append(row | {"run time us": round(run_time_us)})
    return rows


def _infer(model: ModelSession, frozen: FrozenSet, taps: int) -> tuple[NDArray[np.float32], float]:
    """Return the patterns (n, H, W) in [mm] of the frames with so many taps, and the run time of one in [us]."""
    windows = frozen.windows(taps)
    done = infer(model, windows, [None] * len(windows))
    return done.patterns, done.run_time_us
