"""Evaluation of the shipped model on every family of shapes on unseen pads, with baselines and the oracle.

No choice depended on these presses: networks, baselines, contact levels and the baseline that is called the best were
settled on training and validation presses, on other pads.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.evaluate import judge
from edge.inference.onnx_session import ModelSession
from edge.terminal.progress_bar import tracked
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.generation_config import SEED
from train.data.world import World
from train.experiments.support.baselines import Baseline, fit_baselines
from train.experiments.support.nominal import nominal_rows
from train.experiments.support.oracle import oracle_rows
from train.experiments.support.scores import pattern_cells
from train.experiments.support.shipped import ALL, NOTHING, SHORT, infer_presses, load_shipped
from train.experiments.support.workbench import Figures, Workbench
from train.families.catalogue import SHARES
from train.physics.simulated_sensor import MAX_INDENTATION_MM
from train.report import Report, Row, with_interval

TRAINING: Final = World(count=100_000, seed=1)
VALIDATION: Final = World(count=2520, taps=7, per_pad=10, families=dict.fromkeys(SHARES, 1.0), seed=1_000_001)
"""Settings of data/gripped.npz and data/validation.npz in the Makefile."""
_MODEL: Final = (NOTHING, ALL)


@dataclass(frozen=True, slots=True)
class Found:
    """Errors of one method on the wide test set, and its run time."""

    figures: Figures
    run_time_us: float


def run(bench: Workbench, folder: Path) -> Path:
    """Evaluate all methods, and write the report `families`."""
    wide = bench.wide_test()
    model = load_shipped(bench.models)
    bench.use(bench.models / f"{model.name}.onnx")
    validation = freeze_presses(bench.presses("validation", VALIDATION), SEED)
    baselines, chosen = fit_baselines(bench.presses("gripped", TRAINING), validation)
    best = max(baselines, key=lambda one: one.validation_db).name
    found = _evaluated(model, baselines, wide)

    report = Report("families", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"`{model.name}` of contract version {model.contract.version} (training "
        f"{model.contract.training_sha256[:12]}), through the runtime's session, one tap. Wide test set: {len(wide)} "
        f"presses of {len(np.unique(wide.presses.family))} families, as many of each, on "
        f"{len(np.unique(wide.presses.pad))} pads that nothing was trained on or chosen by, sha256 "
        f"{wide.presses.sha256()[:12]}. Full scale {MAX_INDENTATION_MM} mm; `pooled` is of the mean squared error of "
        "all frames, `own peak` against each true pattern's maximum. 95 % intervals are by pad. Known: all constants "
        "of the pad that a sensor file holds, and the taxels' gains."
    )
    report.say(
        "Baselines see the newest tap and are fitted on the training presses, as sensors of their own read them: "
        "bilinear by one gain, the linear map by ridge regression, the mean of the 1 or 8 presses of nearest readings, "
        f"and kriging through the nominal pad's linear forward operator, with {chosen}, chosen on validation. Best of "
        f"them on validation: {best}. Run time: median of a scan, one thread."
    )
    truth, pads = wide.patterns(), wide.presses.pad
    rows: list[Row] = [
        {"method": name}
        | pattern_cells(one.figures, truth, MAX_INDENTATION_MM, pads)
        | {"run time us": round(one.run_time_us)}
        for name, one in found.items()
    ]
    report.table(rows, "All families.", "methods")
    report.table(family_rows(found, best, wide), f"PSNR in dB by family; `over` is over {best}, press by press.")
    report.table(_detail_rows(found, best, wide), "The other errors by family.", "details")
    _plot(report, found, wide)
    report.table(oracle_rows(bench, model), _ORACLE, "oracle")
    report.table(nominal_rows(bench, model), _NOMINAL, "nominal")
    return report.write()


_ORACLE: Final = (
    "What is possible: presses of the paper's surfaces on pads of their own. The oracle knows surface, pad, "
    "gains, and the place to 0.5 mm and 5 degrees (standard deviations), and fits the simulator itself to the readings "
    "by Gauss-Newton; what drift, hysteresis and cross-talk do it knows as a covariance only. No method that does not "
    "know the surface can be expected to do as well."
)
_NOMINAL: Final = (
    "The nominal pad, whole taps of the paper's protocol, in one tap. `frozen.npz` does not hold its sensors' gains, "
    "so that only the pad can be made known there; where the gains are known too, the same presses were read by the "
    "same procedure with gains of 1, as known gains divide out. Glyphs and polygons are of a seed of their own, "
    "at the end of each tap; intervals are by tap."
)


def _evaluated(model: ModelSession, baselines: list[Baseline], wide: FrozenPresses) -> dict[str, Found]:
    frozen, newest = wide.as_frozen_set(), wide.windows(1)[:, 0]
    found: dict[str, Found] = {}
    for known in _MODEL:
        inferred = infer_presses(model, wide, known)
        figures = judge(inferred.patterns, frozen, model.contract.contact_level)
        found[SHORT[known]] = Found(figures, inferred.run_time_us)
    for one in tracked(baselines, "judging", "baseline"):
        found[one.name] = Found(judge(one.run(newest), frozen, one.contact_level), one.run_time_us(newest))
    return found


def family_rows(found: Mapping[str, Found], best: str, wide: FrozenPresses) -> list[Row]:
    """Return the PSNR of every method by family and in total, and the model's margin over the best baseline."""
    rows: list[Row] = []
    for family, which in _families(wide):
        psnr_db = {name: one.figures["psnr_db"][which] for name, one in found.items()}
        pads = wide.presses.pad[which]
        row: Row = {"family": family, "presses": int(which.sum())}
        for name, values in psnr_db.items():
            row[name] = with_interval(values, pads) if name in _OURS else round(float(values.mean()), 2)
        for name in _OURS:
            row[f"{name}, over"] = with_interval(psnr_db[name] - psnr_db[best], pads)
        rows.append(row)
    return rows


_OURS: Final = tuple(SHORT[known] for known in _MODEL)


def _detail_rows(found: Mapping[str, Found], best: str, wide: FrozenPresses) -> list[Row]:
    truth = wide.patterns()
    rows: list[Row] = []
    for family, which in _families(wide):
        for name in (*_OURS, best):
            figures = {metric: values[which] for metric, values in found[name].figures.items()}
            cells = pattern_cells(figures, truth[which], MAX_INDENTATION_MM, wide.presses.pad[which])
            rows.append({"family": family, "method": name} | cells)
    return rows


def _families(wide: FrozenPresses) -> list[tuple[str, NDArray[np.bool_]]]:
    """Return names in the catalogue's order with a mask of each family's presses; `all` comes last."""
    family = wide.presses.family
    some = [(name, family == name) for name in SHARES if (family == name).any()]
    return [*some, ("all", np.ones(len(wide), dtype=bool))]


def _plot(report: Report, found: Mapping[str, Found], wide: FrozenPresses) -> None:
    families = _families(wide)
    with report.figure(size=(9, 5)) as figure:
        axes = figure.subplots()
        for number, (name, one) in enumerate(found.items()):
            means = [one.figures["psnr_db"][which].mean() for _, which in families]
            axes.plot(range(len(families)), means, "o-" if name in _OURS else "x:", color=f"C{number}", label=name)
        axes.set(xticks=range(len(families)), ylabel="PSNR [dB]")
        axes.set_xticklabels([family for family, _ in families], rotation=60, ha="right")
        axes.legend(fontsize=8, ncols=2)
