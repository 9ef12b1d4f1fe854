"""Run experiments: each writes a page NAME.md with its tables.

python -m train.experiments families fig7 --reports reports
"""

import argparse
import inspect
import sys
from pathlib import Path
from typing import Final

from edge.inference.bundled import BUNDLE_DIR
from edge.terminal.progress_bar import tracked
from train.errors import ended_by_errors
from train.experiments.blind_sensors import blind_sensors
from train.experiments.families import families, pads
from train.experiments.fig7 import fig7
from train.experiments.nonnegative import nonnegative
from train.experiments.paper_tables import angle, table3, table4, taps, unseen
from train.experiments.posed_taps import posed_taps
from train.experiments.real import real
from train.experiments.second_world import second_world
from train.experiments.trust_checks import trust_checks
from train.experiments.workbench import Experiment, Workbench
from train.report import Report

EXPERIMENTS: Final[dict[str, Experiment]] = {
    work.__name__.replace("_", "-"): work
    for work in (
        *(families, pads, trust_checks, posed_taps, nonnegative, real, second_world, blind_sensors),
        *(table3, table4, angle, taps, unseen, fig7),
    )
}  # functions by name; the first line of each one's docstring is its help


def run(name: str, bench: Workbench, folder: Path) -> Path:
    """Run an experiment, and return its page."""
    work = EXPERIMENTS[name]
    bench.used.clear()
    report = Report(name, folder, inspect.getfile(work), bench.used)
    work(bench, report)
    return report.write()


def main(arguments: list[str] | None = None) -> None:
    """Run the experiments named on the command line."""
    lines = {name: (inspect.getdoc(work) or "").splitlines()[0] for name, work in EXPERIMENTS.items()}
    parser = argparse.ArgumentParser(
        prog="python -m train.experiments",
        description=(__doc__ or "").splitlines()[0],
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="\n".join(f"  {name:13} {line}" for name, line in lines.items()),
    )
    add = parser.add_argument
    add("names", nargs="+", choices=[*EXPERIMENTS, "all"], metavar="NAME", help="experiments, run in this order")
    add("--reports", type=Path, default=Path("reports"), help="where to write (default: reports)")
    add("--models", type=Path, default=BUNDLE_DIR, help="folder of the models (default: the bundled ones)")
    options = parser.parse_args(arguments)
    bench = Workbench(models=options.models)
    with ended_by_errors("experiments"):
        names = list(EXPERIMENTS) if "all" in options.names else options.names
        for name in tracked(names, "experiments", "page"):
            sys.stdout.write(f"{run(name, bench, options.reports)}\n")


if __name__ == "__main__":
    main()
