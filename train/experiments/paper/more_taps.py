"""Fig. 12 and 13: what more taps gain over the STSR, MTSR-2 by the angle between its taps, and one to seven taps."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.evaluate import judge
from edge.evaluation.test_set import FrozenSet
from edge.terminal.progress_bar import tracked
from train.experiments.paper.protocol import alike, at_angle, by_angle, compact, mixed, trained
from train.experiments.support.workbench import Figures, Workbench, cost_cells, error_cells
from train.learning.checkpoint import infer
from train.networks.blocks import PatternNet
from train.report import Report, Row, bootstrap_interval, signed_interval
from train.surfaces.poses import MAX_TAPS

ANGLES_DEG: Final = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)


def run_angle(bench: Workbench, folder: Path) -> Path:
    """Train an MTSR-2 for each angle, evaluate it on taps turned by that angle, and write table and plot."""
    test = bench.frozen("test")
    stsr, facts = trained(bench, compact("stsr"), mixed(bench), bench.frozen("validation"))
    alone = _judged(stsr, test, facts["contact_level"])
    rows: list[Row] = [{"network": "STSR", "angle deg": None} | error_cells(alone, test, "test") | cost_cells(stsr)]
    gains = []
    for angle_deg in tracked(ANGLES_DEG, "angles", "angle"):
        turned = {split: bench.frozen(split, angle_step_deg=angle_deg) for split in ("validation", "test")}
        net, facts = bench.network(at_angle(angle_deg), by_angle(bench, angle_deg), turned["validation"])
        found = _judged(net, turned["test"], facts["contact_level"])
        gains.append(found["psnr_db"] - alone["psnr_db"])
        row: Row = {"network": "MTSR-2", "angle deg": angle_deg} | error_cells(found, turned["test"], "test")
        row |= {"over STSR dB": signed_interval(gains[-1], test.tap)}
        rows.append(row | cost_cells(net) | bench.training_cells(facts))
    report = Report("angle", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        "Compact networks, each trained from the STSR for as many steps and evaluated with its own angle; of the gain"
        " over the STSR a part is these steps. In the paper 10 degrees are best. The newest taps differ between angles"
        " by their pose error alone."
    )
    report.table(rows, "MTSR-2 by angle between the taps, test set.")
    _plot(report, {"MTSR-2": gains}, test.tap, ANGLES_DEG, "angle between the taps [deg]")
    return report.write()


def run_taps(bench: Workbench, folder: Path) -> Path:
    """Train absent networks, evaluate all on the same targets, and write table and plot."""
    data, test = mixed(bench), bench.frozen("test")
    names = ["stsr", *(f"mtsr{taps}" for taps in range(2, MAX_TAPS + 1))]
    networks = [trained(bench, alike(name), data, bench.frozen("validation")) for name in names]
    ways = [(name, net, facts, net.taps) for name, (net, facts) in zip(names, networks, strict=True)]
    ways += [(names[-1], *networks[-1], given) for given in range(1, MAX_TAPS + 1)]
    rows: list[Row] = []
    found = [_judged(net, test, facts["contact_level"], given) for _, net, facts, given in tracked(ways, "taps", "run")]
    gains = [one["psnr_db"] - found[0]["psnr_db"] for one in found]
    for (name, net, facts, given), figures, gain in zip(ways, found, gains, strict=True):
        row: Row = {"network": name, "taps given": given} | error_cells(figures, test, "test")
        row |= {"over STSR dB": signed_interval(gain, test.tap)}
        rows.append(row | cost_cells(net) | bench.training_cells(facts))
    report = Report("taps", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        "Compact networks on the same targets, all trained on from one of a single tap for as long: one for each number"
        " of taps, then the one of seven taps with fewer as input."
    )
    report.table(rows, "By number of taps, test set.")
    curves = {"a network for each": gains[:MAX_TAPS], "MTSR-7 given fewer": gains[MAX_TAPS:]}
    _plot(report, curves, test.tap, range(1, MAX_TAPS + 1), "taps")
    return report.write()


def _judged(net: PatternNet, test: FrozenSet, contact_level: float, given: int | None = None) -> Figures:
    return judge(infer(net, test.windows(net.taps, given))[0], test, contact_level)


def _plot(
    report: Report,
    curves: Mapping[str, Sequence[NDArray[np.floating]]],
    tap: NDArray[np.integer],
    at: Sequence[float],
    label: str,
) -> None:
    with report.figure() as figure:
        axes = figure.subplots()
        for name, gains in curves.items():
            low, high = np.transpose([bootstrap_interval(gain, tap) for gain in gains])
            mean = np.array([gain.mean() for gain in gains])
            axes.errorbar(at, mean, [mean - low, high - mean], fmt="o-", label=name)
        axes.axhline(0, linestyle="--", color="grey")
        axes.set(xlabel=label, ylabel="test PSNR over STSR [dB], 95 % interval by tap")
        axes.legend()
