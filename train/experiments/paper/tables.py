"""Tables III and IV: all methods at x10 on the same targets, and the STSR at five scales, beside the paper's."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.evaluate import judge
from edge.evaluation.test_set import FrozenSet
from edge.terminal.progress_bar import tracked
from train.data.presses import PressSet
from train.experiments.paper.protocol import (
    SEED_BATCH,
    SEED_STSR_LONGER,
    at_scale,
    classical_methods,
    compact,
    mixed,
    seed_size,
    trained,
)
from train.experiments.support.workbench import Figures, Workbench, cost_cells, error_cells
from train.learning.checkpoint import infer
from train.physics.gripped import SCALE
from train.report import Report, Row, signed_interval

TABLE_3: Final[Mapping[str, tuple[float, float, float, float]]] = {
    "bilinear": (17.31, 0.5128, 18.10, 0.5663),
    "srcnn": (22.17, 0.8277, 21.10, 0.7690),
    "srgan": (22.05, 0.8241, 21.54, 0.7876),
    "stsr": (22.71, 0.8373, 22.45, 0.8170),
    "mtsr2": (24.21, 0.9066, 23.80, 0.8954),
    "mtsr3": (23.72, 0.8955, 23.73, 0.8907),
    "mtsr4": (23.91, 0.8980, 23.69, 0.8934),
    "mtsr5": (23.82, 0.8974, 24.06, 0.9068),
    "mtsr6": (24.02, 0.9016, 23.93, 0.8984),
    "mtsr7": (23.72, 0.8981, 24.04, 0.9004),
}
"""PSNR in [dB] and SSIM on the validation and the test set (Wu and Liu 2024, Table III): other data, other units."""

TABLE_4: Final = {4: (22.69, 0.8297), 6: (22.84, 0.8326), 8: (22.12, 0.8108), 10: (22.45, 0.8170), 20: (22.56, 0.8219)}
"""Scale to PSNR in [dB] and SSIM on the test set (Wu and Liu 2024, Table IV)."""

SEED_NETWORKS: Final = ("srcnn", "srgan", "stsr", "mtsr2", "mtsr3", "mtsr4", "mtsr5", "mtsr6", "mtsr7")
CLASSICAL: Final = ("bilinear", "bicubic", "linear map")
COMPACT_NETWORKS: Final = ("stsr", "mtsr2", "mtsr4", "mtsr7")
ONE_IN: Final = 8
"""Step between evaluated frames of a tap."""

Sets = Mapping[str, FrozenSet]


def run_table3(bench: Workbench, folder: Path) -> Path:
    """Train absent networks, evaluate all methods, and write table and plot."""
    data = mixed(bench)
    sets = {split: bench.frozen(split) for split in ("validation", "test")}
    evaluated = {split: frozen.thinned(ONE_IN) for split, frozen in sets.items()}
    rows, test_psnr = [], {}
    for row, figures in (*_classical(bench, data, evaluated), *_networks(bench, data, sets["validation"], evaluated)):
        rows.append(row)
        test_psnr[str(row["method"])] = figures["psnr_db"]
    report = Report("table3", folder, __file__, bench.used, quick=bench.quick)
    test = evaluated["test"]
    report.say(
        f"{len(test)} frames of {len(test.surface)} taps a set, one in {ONE_IN} evenly over each tap, the same for "
        f"every row; full scale {test.full_scale_mm} mm. PSNR with its 95 % interval by tap. Run time: one window, "
        f"torch, one thread. All are trained on the same {len(data)} sequences; training min and steps count those of "
        "the network that a row's started from. The paper's figures are of real data in other units."
    )
    epochs = ", ".join(
        f"{row['method']} {float(str(row['steps'])) * SEED_BATCH / len(data):.2f}"
        for row in rows
        if "steps" in row and not str(row["method"]).startswith("compact")
    )
    report.say(f"The networks of the paper were trained for a fixed time, here for so many epochs: {epochs}.")
    report.say(_verdicts(test_psnr, test.tap))
    report.table(rows, "Validation and test set, x10.")
    with report.figure(size=(8, 5)) as figure:
        axes = figure.subplots()
        for row in rows:
            name, time_ms = str(row["method"]), float(str(row["run time ms"]))
            axes.plot(time_ms, test_psnr[name].mean(), "s" if name.startswith("compact") else "o")
            axes.annotate(
                name, (time_ms, test_psnr[name].mean()), textcoords="offset points", xytext=(5, 3), fontsize=8
            )
        axes.set(xscale="log", xlabel="run time of a window, torch, one thread [ms]", ylabel="test PSNR [dB]")
        axes.grid(alpha=0.3)
    return report.write()


def _classical(bench: Workbench, data: PressSet, evaluated: Sets) -> Iterator[tuple[Row, Figures]]:
    for method in classical_methods(bench, data, CLASSICAL):
        patterns = {split: method.patterns(frozen.windows(1)) for split, frozen in evaluated.items()}
        yield _row(method.name, method.name, evaluated, patterns, method.contact_level, method.cost)


def _networks(
    bench: Workbench, data: PressSet, validation: FrozenSet, evaluated: Sets
) -> Iterator[tuple[Row, Figures]]:
    seed_networks = [seed_size(name) for name in (SEED_NETWORKS[1:4] if bench.quick else SEED_NETWORKS)]
    networks = [
        (training.network, training, evaluated["validation"]) for training in (*seed_networks, SEED_STSR_LONGER)
    ]
    networks += [(name, compact(name), validation) for name in COMPACT_NETWORKS]
    for network, training, calibrated_on in tracked(networks, "networks", "network"):
        net, facts = trained(bench, training, data, calibrated_on)
        name = training.name.removeprefix("seed-") if training.network == network else f"compact {network}"
        patterns = {split: infer(net, frozen.windows(net.taps))[0] for split, frozen in evaluated.items()}
        costs = cost_cells(net) | bench.training_cells(facts)
        yield _row(name.removeprefix("quick-"), network, evaluated, patterns, facts["contact_level"], costs)


def _row(
    name: str, paper: str, sets: Sets, patterns: Mapping[str, NDArray], contact_level: float, costs: Row
) -> tuple[Row, Figures]:
    figures = {split: judge(patterns[split], frozen, contact_level) for split, frozen in sets.items()}
    row: Row = {"method": name}
    for split, frozen in sets.items():
        row |= error_cells(figures[split], frozen, split)
    theirs = TABLE_3.get(paper)
    row |= {"paper's test PSNR dB": theirs and theirs[2], "paper's test SSIM": theirs and theirs[3]}
    return row | costs, figures["test"]


def _verdicts(test_psnr: Mapping[str, NDArray[np.float64]], taps: NDArray[np.integer]) -> str:
    asked = (
        ("compact stsr", "stsr"),
        ("compact mtsr4", "mtsr4"),
        ("mtsr2", "stsr longer"),
        ("compact mtsr2", "compact stsr"),
    )
    lines = []
    for better, worse in (pair for pair in asked if set(pair) <= set(test_psnr)):
        lines.append(f"- {better} over {worse} [dB]: {signed_interval(test_psnr[better] - test_psnr[worse], taps)}")
    return "On the test set, tap by tap:\n\n" + "\n".join(lines)


def run_table4(bench: Workbench, folder: Path) -> Path:
    """Train absent networks, evaluate each scale against the truth at that scale, and write table and plot."""
    rows: list[Row] = []
    means = []
    for scale, (paper_db, paper_ssim) in tracked(TABLE_4.items(), "scales", "scale"):
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
        axes.plot(list(TABLE_4), means, "o-", label="compact STSR, simulated")
        axes.plot(list(TABLE_4), [psnr for psnr, _ in TABLE_4.values()], "x--", label="paper, real data, other units")
        axes.set(xlabel="scale", ylabel="test PSNR [dB]", xticks=list(TABLE_4))
        axes.legend()
    return report.write()
