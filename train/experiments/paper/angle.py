"""Fig. 12: MTSR-2 by the angle between its two taps."""

from pathlib import Path
from typing import Final

import numpy as np

from edge.evaluation.evaluate import judge
from edge.terminal.progress_bar import tracked
from train.experiments.paper.trainings import at_angle, by_angle, compact, mixed, trained
from train.experiments.support.workbench import Workbench, cost_cells, error_cells
from train.learning.checkpoint import infer
from train.report import Report, Row, bootstrap_interval

ANGLES_DEG: Final = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)


def run(bench: Workbench, folder: Path) -> Path:
    """Train an MTSR-2 for each angle, evaluate it on taps turned by that angle, and write table and plot."""
    data = mixed(bench)
    validation, test = bench.frozen("validation"), bench.frozen("test")
    stsr, stsr_facts = trained(bench, compact("stsr"), data, validation)
    alone = judge(infer(stsr, test.windows(1))[0], test, stsr_facts["contact_level"])
    rows: list[Row] = [{"network": "STSR", "angle deg": None} | error_cells(alone, test, "test") | cost_cells(stsr)]
    gains = []
    for angle_deg in tracked(ANGLES_DEG, "angles", "angle"):
        sets = {split: bench.frozen(split, angle_step_deg=angle_deg) for split in ("validation", "test")}
        net, facts = bench.network(at_angle(angle_deg), by_angle(bench, angle_deg), sets["validation"])
        figures = judge(infer(net, sets["test"].windows(2))[0], sets["test"], facts["contact_level"])
        gain = figures["psnr_db"] - alone["psnr_db"]
        low, high = bootstrap_interval(gain, test.tap)
        gains.append((float(gain.mean()), low, high))
        row: Row = {"network": "MTSR-2", "angle deg": angle_deg} | error_cells(figures, sets["test"], "test")
        row |= {"over STSR dB": f"{gain.mean():+.2f} ({low:+.2f}..{high:+.2f})"}
        rows.append(row | cost_cells(net) | bench.training_cells(facts))
    report = Report("angle", folder, __file__, bench.used, quick=bench.quick)
    best = max(range(len(gains)), key=lambda i: gains[i][0])
    apart = [
        f"{angle_deg:g}" for angle_deg, (_, _, high) in zip(ANGLES_DEG, gains, strict=True) if high < gains[best][1]
    ]
    report.say(
        "Compact networks, each trained from the STSR for as many steps and evaluated with its own angle; of the gain"
        f" over the STSR a part is these steps. Highest here: {ANGLES_DEG[best]:g} degrees, significantly (no common"
        f" interval) more than at {', '.join(apart) or 'none of the others'}; in the paper 10. The newest taps differ"
        " between angles by their pose error alone."
    )
    report.table(rows, "MTSR-2 by angle between the taps, test set.")
    with report.figure() as figure:
        axes = figure.subplots()
        mean, low, high = np.array(gains).T
        axes.errorbar(ANGLES_DEG, mean, [mean - low, high - mean], fmt="o-")
        axes.axhline(0, linestyle="--", color="grey")
        axes.set(xlabel="angle between the taps [deg]", ylabel="test PSNR over STSR [dB], 95 % interval by tap")
    return report.write()
