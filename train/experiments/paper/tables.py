"""Tables III and IV, Fig. 12 and 13: errors by method, by scale, by angle between two taps, and by number of taps."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.test_set import FrozenSet
from edge.terminal.progress_bar import tracked
from train.data.presses import PressSet
from train.experiments.paper.protocol import (
    SEED_BATCH,
    SEED_STSR_LONGER,
    alike,
    at_angle,
    at_scale,
    by_angle,
    classical_methods,
    compact,
    judged,
    mixed,
    seed_size,
    trained,
)
from train.experiments.support.workbench import Method, Workbench
from train.physics.gripped import SCALE
from train.report import Report, Row, band, signed_interval
from train.surfaces.poses import MAX_TAPS

TABLE_3: Final[Mapping[str, tuple[float, float]]] = {
    "bilinear": (18.10, 0.5663),
    "srcnn": (21.10, 0.7690),
    "srgan": (21.54, 0.7876),
    "stsr": (22.45, 0.8170),
    "mtsr2": (23.80, 0.8954),
    "mtsr3": (23.73, 0.8907),
    "mtsr4": (23.69, 0.8934),
    "mtsr5": (24.06, 0.9068),
    "mtsr6": (23.93, 0.8984),
    "mtsr7": (24.04, 0.9004),
}
"""PSNR in [dB] and SSIM on the test set (Wu and Liu 2024, Table III): other data, other units."""

TABLE_4: Final = {4: (22.69, 0.8297), 6: (22.84, 0.8326), 8: (22.12, 0.8108), 10: (22.45, 0.8170), 20: (22.56, 0.8219)}
"""Scale to PSNR in [dB] and SSIM on the test set (Wu and Liu 2024, Table IV)."""

SEED_NETWORKS: Final = ("srcnn", "srgan", "stsr", "mtsr2", "mtsr3", "mtsr4", "mtsr5", "mtsr6", "mtsr7")
CLASSICAL: Final = ("bilinear", "bicubic", "linear map")
COMPACT_NETWORKS: Final = ("stsr", "mtsr2", "mtsr4", "mtsr7")
COMPARED: Final = (
    *(("compact stsr", "stsr"), ("compact mtsr4", "mtsr4")),
    *(("mtsr2", "stsr longer"), ("compact mtsr2", "compact stsr")),
)
ONE_IN: Final = 8
"""Step between evaluated frames of a tap."""
ANGLES_DEG: Final = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)


def run_table3(bench: Workbench, folder: Path) -> Path:
    """Train absent networks, evaluate all methods, and write table and plot."""
    data = mixed(bench)
    sets = {split: bench.frozen(split) for split in ("validation", "test")}
    evaluated = {split: frozen.thinned(ONE_IN) for split, frozen in sets.items()}
    test, rows = evaluated["test"], list[Row]()
    test_db: dict[str, NDArray[np.float64]] = {}
    epochs: list[str] = []
    for name, paper, method in _methods(bench, data, sets["validation"], evaluated["validation"]):
        errors, figures = judged(method, evaluated)
        theirs_db, theirs_ssim = TABLE_3.get(paper, (None, None))
        theirs: Row = {"paper's test PSNR dB": theirs_db, "paper's test SSIM": theirs_ssim}
        rows.append({"method": name} | errors | theirs | method.cost | method.training)
        test_db[name] = figures["psnr_db"]
        if method.training and not name.startswith("compact"):
            epochs.append(f"{name} {float(str(method.training['steps'])) * SEED_BATCH / len(data):.2f}")
    report = Report("table3", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"{len(test)} frames of {len(test.surface)} taps a set, one in {ONE_IN} evenly over each tap, the same for "
        f"every row; full scale {test.full_scale_mm} mm. PSNR with its 95 % interval by tap. Run time: one window, "
        f"torch, one thread. All are trained on the same {len(data)} sequences; training min and steps count those of "
        "the network that a row's started from. The paper's figures are of real data in other units."
    )
    report.say(
        f"The networks of the paper were trained for a fixed time, here for so many epochs: {', '.join(epochs)}."
    )
    verdicts = [
        f"- {better} over {worse} [dB]: {signed_interval(test_db[better] - test_db[worse], test.tap)}"
        for better, worse in COMPARED
        if {better, worse} <= set(test_db)
    ]
    report.say("On the test set, tap by tap:\n\n" + "\n".join(verdicts))
    report.table(rows, "Validation and test set, x10.")
    with report.figure(size=(8, 5)) as figure:
        axes = figure.subplots()
        for row in rows:
            name, time_ms = str(row["method"]), float(str(row["run time ms"]))
            place = time_ms, float(test_db[name].mean())
            axes.plot(*place, "s" if name.startswith("compact") else "o")
            axes.annotate(name, place, textcoords="offset points", xytext=(5, 3), fontsize=8)
        axes.set(xscale="log", xlabel="run time of a window, torch, one thread [ms]", ylabel="test PSNR [dB]")
        axes.grid(alpha=0.3)
    return report.write()


def _methods(
    bench: Workbench, data: PressSet, validation: FrozenSet, thinned: FrozenSet
) -> Iterator[tuple[str, str, Method]]:
    """Yield each method with its name in the table and in the paper's; large networks are calibrated on few frames."""
    for method in classical_methods(bench, data, CLASSICAL):
        yield method.name, method.name, method
    names = SEED_NETWORKS[1:4] if bench.quick else SEED_NETWORKS
    networks = [(name, seed_size(name), thinned) for name in names]
    networks.append((SEED_STSR_LONGER.name.removeprefix("seed-"), SEED_STSR_LONGER, thinned))
    networks += [(f"compact {name}", compact(name), validation) for name in COMPACT_NETWORKS]
    for name, training, calibrated_on in tracked(networks, "networks", "network"):
        yield name, training.network.removeprefix("compact-"), trained(bench, training, data, calibrated_on)


def run_table4(bench: Workbench, folder: Path) -> Path:
    """Train absent networks, evaluate each scale against the truth at that scale, and write table and plot."""
    rows: list[Row] = []
    means = []
    trained(bench, at_scale(SCALE), mixed(bench), bench.frozen("validation"))  # at its own scale
    for scale, (paper_db, paper_ssim) in tracked(TABLE_4.items(), "scales", "scale"):
        sets = {split: bench.frozen(split, scale=scale) for split in ("validation", "test")}
        method = bench.network(at_scale(scale), mixed(bench, scale), sets["validation"])
        errors, figures = judged(method, sets)
        means.append(float(figures["psnr_db"].mean()))
        pattern = "{} x {}".format(*sets["test"].unit_patterns.shape[1:])
        theirs: Row = {"paper's test PSNR dB": paper_db, "paper's test SSIM": paper_ssim}
        rows.append({"scale": f"x{scale}", "pattern": pattern} | errors | theirs | method.cost | method.training)
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


def run_angle(bench: Workbench, folder: Path) -> Path:
    """Train an MTSR-2 for each angle, evaluate it on taps turned by that angle, and write table and plot."""
    test = bench.frozen("test")
    stsr = trained(bench, compact("stsr"), mixed(bench), bench.frozen("validation"))
    errors, alone = judged(stsr, {"test": test})
    rows: list[Row] = [{"network": "STSR", "angle deg": None} | errors | stsr.cost]
    gains = []
    for angle_deg in tracked(ANGLES_DEG, "angles", "angle"):
        validation, turned = (bench.frozen(split, angle_step_deg=angle_deg) for split in ("validation", "test"))
        method = bench.network(at_angle(angle_deg), by_angle(bench, angle_deg), validation)
        errors, figures = judged(method, {"test": turned})
        gains.append(figures["psnr_db"] - alone["psnr_db"])
        over: Row = {"over STSR dB": signed_interval(gains[-1], test.tap)}
        rows.append({"network": "MTSR-2", "angle deg": angle_deg} | errors | over | method.cost | method.training)
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
    data, test, validation = mixed(bench), bench.frozen("test"), bench.frozen("validation")
    names = ["stsr", *(f"mtsr{taps}" for taps in range(2, MAX_TAPS + 1))]
    methods = [trained(bench, alike(name), data, validation) for name in names]
    ways = [(name, method, method.taps) for name, method in zip(names, methods, strict=True)]
    ways += [(names[-1], methods[-1], given) for given in range(1, MAX_TAPS + 1)]
    rows: list[Row] = []
    found = []
    for name, method, given in tracked(ways, "taps", "run"):
        errors, figures = judged(method, {"test": test}, given)
        found.append(figures["psnr_db"])
        over: Row = {"over STSR dB": signed_interval(found[-1] - found[0], test.tap)}
        rows.append({"network": name, "taps given": given} | errors | over | method.cost | method.training)
    report = Report("taps", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        "Compact networks on the same targets, all trained on from one of a single tap for as long: one for each number"
        " of taps, then the one of seven taps with fewer as input."
    )
    report.table(rows, "By number of taps, test set.")
    gains = [psnr_db - found[0] for psnr_db in found]
    curves = {"a network for each": gains[:MAX_TAPS], "MTSR-7 given fewer": gains[MAX_TAPS:]}
    _plot(report, curves, test.tap, range(1, MAX_TAPS + 1), "taps")
    return report.write()


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
            mean, around = band((gain, tap) for gain in gains)
            axes.errorbar(at, mean, around, fmt="o-", label=name)
        axes.axhline(0, linestyle="--", color="grey")
        axes.set(xlabel=label, ylabel="test PSNR over STSR [dB], 95 % interval by tap")
        axes.legend()
