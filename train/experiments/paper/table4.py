"""Table IV: the STSR at five scales."""

from pathlib import Path
from typing import Final

from edge.evaluation.evaluate import judge
from edge.terminal.progress_bar import tracked
from train.experiments.paper.trainings import at_scale, mixed, trained
from train.experiments.support.workbench import Workbench, cost_cells, error_cells
from train.learning.checkpoint import infer
from train.physics.gripped import SCALE
from train.report import Report, Row

PAPER: Final = {4: (22.69, 0.8297), 6: (22.84, 0.8326), 8: (22.12, 0.8108), 10: (22.45, 0.8170), 20: (22.56, 0.8219)}
"""Scale to PSNR in [dB] and SSIM on the test set (Wu and Liu 2024, Table IV)."""


def run(bench: Workbench, folder: Path) -> Path:
    """Train absent networks, evaluate each scale against the truth at that scale, and write table and plot."""
    rows: list[Row] = []
    means = []
    for scale, (paper_db, paper_ssim) in tracked(PAPER.items(), "scales", "scale"):
        validation, test = (bench.frozen(split, scale=scale) for split in ("validation", "test"))
        if scale != SCALE:  # the base is evaluated at its own scale
            trained(bench, at_scale(SCALE), mixed(bench), bench.frozen("validation"))
        net, facts = bench.network(at_scale(scale), mixed(bench, scale), validation)
        row: Row = {"scale": f"x{scale}", "pattern": "{} x {}".format(*test.unit_patterns.shape[1:])}
        for split, frozen in (("validation", validation), ("test", test)):
            figures = judge(infer(net, frozen.windows(1))[0], frozen, facts["contact_level"])
            row |= error_cells(figures, frozen, split)
        means.append(float(figures["psnr_db"].mean()))
        row |= {"paper's test PSNR dB": paper_db, "paper's test SSIM": paper_ssim}
        rows.append(row | cost_cells(net) | bench.training_cells(facts))
    report = Report("table4", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        "The compact STSR. Truth is made at x20 and brought to each scale with anti-aliasing. At x10 the layers that"
        " make pixels are as old as the base network, at the other scales they are trained from nothing for the last"
        " steps alone: compare those with each other."
    )
    report.table(rows, "STSR by scale.")
    with report.figure() as figure:
        axes = figure.subplots()
        axes.plot(list(PAPER), means, "o-", label="compact STSR, simulated")
        axes.plot(list(PAPER), [psnr for psnr, _ in PAPER.values()], "x--", label="paper, real data, other units")
        axes.set(xlabel="scale", ylabel="test PSNR [dB]", xticks=list(PAPER))
        axes.legend()
    return report.write()
