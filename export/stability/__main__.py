"""Numerical stability, part by part: a table, plots, and exit code 1 where a row is broken.

python -m export.stability --reports reports
"""

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Final

from edge.errors import EdgeError
from edge.inference.bundled import BUNDLE_DIR, DEFAULT_MODEL, INT8_SUFFIX, bundled_models
from edge.terminal.progress_bar import tracked
from export.errors import ExportError
from export.stability import pareto
from export.stability.case import Case
from train.errors import TrainError
from train.report import Report, Row

PARTS: Final = (
    *("layer_contact", "curved_contact", "finite_elements", "magnets", "psf"),
    *("networks", "chain", "inputs", "metrics", "counts"),
)
"""Modules of this package with `cases(quick)`; each is imported when needed, since one requires an extra."""
_LEAST, _WORST = 1e-9, 1e2
"""Limits of the plot, to which values outside are moved."""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m export.stability", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"parts to check, of {', '.join(PARTS)} (all)")
    parser.add_argument("--reports", type=Path, default=Path("reports"), help="where to write (default: reports)")
    parser.add_argument("--quick", action="store_true", help="run fewer and coarser cases, as a test of the command")
    options = parser.parse_args(arguments)
    for part in options.parts:
        if part not in PARTS:
            parser.error(f"no part {part!r}, expected some of {', '.join(PARTS)}")
    try:
        broken = run(tuple(options.parts) or PARTS, options.reports, quick=options.quick)
    except (ExportError, TrainError, EdgeError, ModuleNotFoundError) as error:
        sys.exit(f"stability: {error}")
    sys.stdout.write(f"{options.reports / _name(tuple(options.parts) or PARTS, options.quick)}.md\n")
    if broken:
        names = "\n".join(f"  {case.part}: {case.case}, {case.severity}, {case.what}" for case in broken)
        sys.exit(f"stability: {len(broken)} rows are broken:\n{names}")


def run(parts: tuple[str, ...], folder: Path, quick: bool = False) -> list[Case]:
    """Write the report `stability`, and give the rows that are broken."""
    works = {part: _cases(part) for part in parts}  # what lacks is missed before anything is worked out
    sources = [__file__, *(str(Path(__file__).with_name(f"{part}.py")) for part in parts)]
    report = Report(_name(parts, quick), folder, sources, _used(), quick=quick)
    found: dict[str, list[Case]] = {}
    for part in tracked(parts, "stability", "part"):
        found[part] = list(works[part](quick))
    cases = [case for same in found.values() for case in same]
    broken = [case for case in cases if not case.holds]
    verdicts = [str(case.cells()["verdict"]) for case in cases]
    report.say(
        f"{len(cases)} rows: {verdicts.count('holds')} hold, {verdicts.count('refused')} are refused by a clear error, "
        f"{verdicts.count('limit')} state a documented limit, {len(broken)} are broken. A value that is not a number "
        "is broken, whatever its bound. Run times are of one thread."
    )
    if broken:
        report.show([{"part": case.part} | case.cells() for case in broken], "### Broken")
    report.keep([{"part": case.part} | case.cells() for case in cases])
    for same in found.values():
        report.show([case.cells() for case in same], f"### {same[0].part.capitalize()}")
    _plot_margins(report, found)
    if parts == PARTS:
        _pareto(report, folder, quick)
    report.write()
    return broken


def _used() -> list[Path]:
    """Return the bundled files that the parts look at."""
    return [*bundled_models(), BUNDLE_DIR / "frozen.npz", BUNDLE_DIR / "classical.npz"]


def _name(parts: tuple[str, ...], quick: bool) -> str:
    """Return the report's name; a partial report does not replace the whole one."""
    return "-".join(["stability", *(parts if parts != PARTS else ()), *(["quick"] if quick else [])])


def _cases(part: str) -> Callable[[bool], Iterator[Case]]:
    return import_module(f"export.stability.{part}").cases


def _plot_margins(report: Report, found: dict[str, list[Case]]) -> None:
    """Plot each row's value relative to its bound; rows that must be exact are left out."""
    shares: dict[str, list[float]] = {}
    for same in found.values():
        bounded = [(case.value, case.most) for case in same if case.value is not None and case.most]
        if bounded:
            finite = [value / most if math.isfinite(value) else _WORST for value, most in bounded]
            shares[same[0].part] = [min(max(share, _LEAST), _WORST) for share in finite]
    with report.figure(size=(9, 0.5 * len(shares) + 1.5)) as figure:
        axes = figure.subplots()
        for row, values in enumerate(shares.values()):
            axes.semilogx(values, [row] * len(values), "|", markersize=14)
        axes.axvline(1, linestyle="--", color="grey")
        axes.set(yticks=range(len(shares)), yticklabels=list(shares), xlim=(_LEAST / 2, 2 * _WORST))
        axes.set(xlabel="value over its bound; beyond 1 a row is broken")
        axes.invert_yaxis()


def _pareto(report: Report, folder: Path, quick: bool) -> None:
    report.say(
        "## Error against run time\n\n"
        "Readings are of the 18 surfaces at one pose each, pressed by .3 mm, against 200 cells over the pad's 20 mm in "
        "float64. **We ship** 42 cells of .47 mm at a tolerance of 1e-3 in float32; whole cells leave .13 mm of the "
        "pad out at each rim."
    )
    chain = pareto.simulation(quick)
    report.table(chain, "Readings.", "readings")
    _scatter(report, chain, "series", ("ms a pose", "error %"), "readings")
    report.say("Truth is of the same surfaces, against x40. **We ship** x20, averaged down.")
    maps = pareto.truth(quick)
    report.table(maps, "Truth, by the scale that it is made at.", "truth")
    elements = pareto.finite_elements(folder)
    if elements:
        report.table(elements, "Finite elements, against the finest mesh (from the report fig7).", "elements")
    nets = pareto.networks(quick)
    report.say(in_integers(nets))
    report.table(nets, "The networks, x10, back to back, on one thread.", "models")
    _scatter(report, nets, "method", ("p50 us", "PSNR dB"), "models")


def in_integers(nets: list[Row]) -> str:
    """Return what integers take and lose against float32, network by network, and which model is the default."""
    rows = {str(row["method"]): row for row in nets}
    comparisons = [
        f"{name} {float(str(rows[name + INT8_SUFFIX]['p50 us'])) / float(str(row['p50 us'])):.2f} of the time, "
        f"{float(str(rows[name + INT8_SUFFIX]['PSNR dB'])) - float(str(row['PSNR dB'])):+.2f} dB"
        for name, row in rows.items()
        if name + INT8_SUFFIX in rows
    ]
    arithmetic = rows[DEFAULT_MODEL]["arithmetic"] if DEFAULT_MODEL in rows else "arithmetic that was not measured"
    return f"In int8 against float32: {'; '.join(comparisons)}. The default is `{DEFAULT_MODEL}`, in {arithmetic}."


def _scatter(report: Report, rows: list[Row], by: str, axes_of: tuple[str, str], part: str) -> None:
    """Plot one dot a row, with a name if there is room, and a ring around shipped settings."""
    with report.figure(part, size=(8, 4.5)) as figure:
        axes = figure.subplots()
        for name in dict.fromkeys(str(row[by]) for row in rows):
            points = [[float(str(row[column])) for column in axes_of] for row in rows if row[by] == name]
            axes.semilogx(*zip(*points, strict=True), "o", label=name)
        for row in rows:
            x, y = (float(str(row[column])) for column in axes_of)
            if row.get("note") == pareto.SHIPPED:
                axes.plot(x, y, "o", markersize=14, markerfacecolor="none", markeredgecolor="black")
            if row.get("precision") == "float32" and row.get("series") != "tolerance":
                axes.annotate(str(row["setting"]), (x, y), (4, 6), textcoords="offset points", fontsize=7)
        axes.set(xlabel=axes_of[0], ylabel=axes_of[1])
        axes.legend(fontsize=7)


if __name__ == "__main__":
    main()
