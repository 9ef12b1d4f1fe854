"""Comparison of the paper's networks with compact ones after equal training by epochs."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.evaluate import judge
from edge.terminal.progress_bar import tracked
from train.experiments.support.trainings import OUT, OUT_EPOCHS, OUT_EPOCHS_MORE, SEQUENCES, epochs, mixed, trained
from train.experiments.support.workbench import Workbench, cost_cells, error_cells
from train.learning.checkpoint import Training, infer
from train.networks.blocks import PatternNet
from train.report import Report, Row, bootstrap_interval, with_interval

Psnr = dict[str, NDArray[np.float64]]
"""PSNR of every frame of the test set, (n,) in [dB], by network."""

_SHORT: Final = f"{OUT_EPOCHS // 4}"
_WHOLE: Final = f"{OUT_EPOCHS}"
_LONGER: Final = f"{OUT_EPOCHS}+{OUT_EPOCHS_MORE}"
_ONE_TAP: Final = ", one tap given"


def run(bench: Workbench, folder: Path) -> Path:
    """Train absent networks, or load those that exist; evaluate them, and write table and plot."""
    sets = {split: bench.frozen(split) for split in ("validation", "test")}
    test = sets["test"]
    rows: list[Row] = []
    course: list[Row] = []
    psnr: Psnr = {}
    for training, net, facts in _networks(bench):
        name = _name(training)
        patterns = {split: infer(net, frozen.windows(net.taps))[0] for split, frozen in sets.items()}
        figures = {split: judge(patterns[split], frozen, facts["contact_level"]) for split, frozen in sets.items()}
        row: Row = {"network": name, "epochs": round(epochs(training), 1)}
        for split, frozen in sets.items():
            row |= error_cells(figures[split], frozen, split)
        psnr[name] = figures["test"]["psnr_db"]
        if net.taps > 1:
            alone = judge(infer(net, test.windows(net.taps, given=1))[0], test, facts["contact_level"])
            psnr[name + _ONE_TAP] = alone["psnr_db"]
        one_tap = psnr.get(name + _ONE_TAP)
        row |= {f"test PSNR dB{_ONE_TAP}": None if one_tap is None else with_interval(one_tap, test.tap)}
        row |= cost_cells(net)
        rows.append(row | {"its own min": round(facts["elapsed_s"] / 60, 1), "trained on": facts["device"]})
        course.append(_course(name, facts))
    report = Report("trained_out", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"{len(test)} frames of {len(test.surface)} taps a set; full scale {test.full_scale_mm} mm. PSNR with its 95 % "
        f"interval by tap. A name's numbers are passes over the same {SEQUENCES} sequences, from nothing and, after a "
        "+, on from the STSR of that kind; every part is one cycle of the learning rate, batches of 64, in bfloat16. "
        "Minutes are those of a network's own part, with up to four others at once on the device. Run time: one "
        "window, torch, one thread, on the machine that evaluated it."
    )
    if absent := [_name(training) for training in OUT if _name(training) not in psnr]:
        report.say(f"Missing, so not evaluated: {', '.join(absent)}.")
    report.say(_verdicts(psnr, test.tap))
    report.table(rows, "Validation and test set, x10.")
    report.table(
        course,
        "Validation PSNR in dB at shares of a network's own part. The learning rate is high until near the end of "
        "each, so only ends can be compared with each other.",
        part="course",
    )
    _plot(report, rows)
    return report.write()


def _plot(report: Report, rows: Sequence[Row]) -> None:
    """Plot error against run time, and against passes."""
    with report.figure(size=(11, 5)) as figure:
        costs, passes = figure.subplots(1, 2, sharey=True)
        for row in rows:
            name, psnr_db = str(row["network"]), float(str(row["test PSNR dB"]).split()[0])
            marker = "s" if name.startswith("compact") else "o"
            for axes, column in ((costs, "run time ms"), (passes, "epochs")):
                axes.plot(float(str(row[column])), psnr_db, marker, alpha=0.8, label=name)
        costs.set(xscale="log", xlabel="run time of a window, torch, one thread [ms]", ylabel="test PSNR [dB]")
        passes.set(xscale="log", xlabel="passes over the data")
        for axes in (costs, passes):
            axes.grid(alpha=0.3)
            axes.margins(x=0.25)
        passes.legend(fontsize=8, loc="lower right")


def _networks(bench: Workbench) -> Iterator[tuple[Training, PatternNet, dict[str, Any]]]:
    listed = OUT[:: 2 if bench.found else 4] if bench.quick else OUT
    if bench.found:
        there = [(training, bench.brought(training)) for training in listed]
        for training, brought in tracked([pair for pair in there if pair[1]], "networks", "network"):
            if brought:
                yield training, *brought
        return
    data, validation = mixed(bench), bench.frozen("validation")
    for training in tracked(listed, "networks", "network"):
        yield training, *trained(bench, training, data, validation)


def _name(training: Training) -> str:
    return training.name.removeprefix("out-").replace("-", " ")


def _course(name: str, facts: Mapping[str, Any]) -> Row:
    steps = facts["steps"]
    return {"network": name} | {
        f"{point['step'] / steps:.0%}": round(point["validation PSNR dB"], 2) for point in facts["course"]
    }


def _verdicts(psnr: Psnr, taps: NDArray[np.integer]) -> str:
    """State the differences between the networks that exist, tap by tap."""
    asked = [(f"compact {name}", name) for name in psnr if not name.startswith("compact")]
    for kind in ("", "compact "):
        asked += [
            (f"{kind}mtsr2 {_LONGER}", f"{kind}stsr {_LONGER}"),
            (f"{kind}mtsr4 {_LONGER}", f"{kind}stsr {_LONGER}"),
            (f"{kind}mtsr2 {_LONGER}", f"{kind}mtsr2 {_LONGER}{_ONE_TAP}"),
            (f"{kind}mtsr4 {_LONGER}", f"{kind}mtsr4 {_LONGER}{_ONE_TAP}"),
            (f"{kind}stsr {_WHOLE}", f"{kind}stsr {_SHORT}"),
            (f"{kind}stsr {_LONGER}", f"{kind}stsr {_WHOLE}"),
            (f"{kind}stsr {4 * OUT_EPOCHS}", f"{kind}stsr {_LONGER}"),
        ]
    lines = []
    for better, worse in (pair for pair in asked if set(pair) <= set(psnr)):
        gain = psnr[better] - psnr[worse]
        low, high = bootstrap_interval(gain, taps)
        lines.append(f"- {better} over {worse}: {gain.mean():+.2f} dB ({low:+.2f}..{high:+.2f})")
    return "On the test set, tap by tap:\n\n" + "\n".join(lines)
