"""Fig. 13: one to seven taps, by a network for each number, and by one network of seven taps with fewer as input."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.evaluate import judge
from edge.terminal.progress_bar import tracked
from train.experiments.paper.trainings import alike, mixed, trained
from train.experiments.support.workbench import Workbench, cost_cells, error_cells
from train.learning.checkpoint import infer
from train.report import Report, Row, bootstrap_interval
from train.surfaces.poses import MAX_TAPS


def run(bench: Workbench, folder: Path) -> Path:
    """Train absent networks, evaluate all on the same targets, and write table and plot."""
    data = mixed(bench)
    validation, test = bench.frozen("validation"), bench.frozen("test")
    names = ["stsr", *(f"mtsr{taps}" for taps in range(2, MAX_TAPS + 1))]
    rows: list[Row] = []
    gains: dict[str, list[tuple[float, float, float]]] = {"a network for each": [], "MTSR-7 given fewer": []}
    networks = [trained(bench, alike(name), data, validation) for name in names]
    figures = [judge(infer(net, test.windows(net.taps))[0], test, facts["contact_level"]) for net, facts in networks]
    for name, (net, facts), found in zip(names, networks, figures, strict=True):
        row: Row = {"network": name, "taps given": net.taps} | error_cells(found, test, "test")
        gain = _gain(found, figures[0], test.tap)
        gains["a network for each"].append(gain)
        rows.append(row | _cell(gain) | cost_cells(net) | bench.training_cells(facts))
    net, facts = networks[-1]
    for given in tracked(range(1, MAX_TAPS + 1), "taps", "run"):
        found = judge(infer(net, test.windows(MAX_TAPS, given))[0], test, facts["contact_level"])
        row = {"network": names[-1], "taps given": given} | error_cells(found, test, "test")
        gain = _gain(found, figures[0], test.tap)
        gains["MTSR-7 given fewer"].append(gain)
        rows.append(row | _cell(gain) | cost_cells(net))
    distinct = sum(low > 0 or high < 0 for curve in gains.values() for _, low, high in curve)
    report = Report("taps", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        "Compact networks on the same targets, all trained on from one of a single tap for as long. "
        f"Of {2 * MAX_TAPS - 1} ways with other taps or another network, {distinct} differ significantly from STSR "
        "(95 % interval of the difference, by tap)."
    )
    report.table(rows, "By number of taps, test set.")
    with report.figure() as figure:
        axes = figure.subplots()
        for shift, (label, curve) in zip((-0.05, 0.05), gains.items(), strict=True):
            mean, low, high = np.array(curve).T
            axes.errorbar(np.arange(len(mean)) + 1 + shift, mean, [mean - low, high - mean], fmt="o-", label=label)
        axes.axhline(0, linestyle="--", color="grey")
        axes.set(xlabel="taps", ylabel="test PSNR over STSR [dB], 95 % interval by tap")
        axes.legend()
    return report.write()


def _gain(
    found: dict[str, NDArray[np.float64]], stsr: dict[str, NDArray[np.float64]], tap: NDArray[np.integer]
) -> tuple[float, float, float]:
    """Return the PSNR over STSR's and its interval, in [dB]."""
    gain_db = found["psnr_db"] - stsr["psnr_db"]
    return (float(gain_db.mean()), *bootstrap_interval(gain_db, tap))


def _cell(gain: tuple[float, float, float]) -> Row:
    return {"over STSR dB": "{:+.2f} ({:+.2f}..{:+.2f})".format(*gain)}
