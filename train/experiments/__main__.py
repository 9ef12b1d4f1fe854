"""Run experiments: each writes a page NAME.md with its tables.

python -m train.experiments table3 angle --reports reports
"""

import argparse
import importlib
import inspect
import sys
from pathlib import Path
from typing import Final

from edge.errors import EdgeError
from edge.inference.bundled import BUNDLE_DIR
from edge.terminal.progress_bar import tracked
from train.errors import TrainError
from train.experiments.workbench import Experiment, Workbench
from train.report import Report

EXPERIMENTS: Final = {
    "families": (
        "families:families",
        "the shipped model and its intervals on every family, next to baselines",
    ),
    "pads": ("families:pads", "the shipped model on pads that are off the nominal one"),
    "trust-checks": ("trust_checks:trust_checks", "patterns not believed and taps dropped, rightly and wrongly"),
    "posed-taps": ("posed_taps:posed_taps", "one to seven taps from known poses, by schedule, and with wrong poses"),
    "table3": ("paper_tables:methods", "all methods at x10 on the same targets"),
    "table4": ("paper_tables:scales", "STSR at five scales"),
    "angle": ("paper_tables:angles", "MTSR-2 by angle between its taps"),
    "taps": ("paper_tables:taps", "one to seven taps"),
    "force": ("force:small_forces", "error by contact force"),
    "force-recovery": ("force:recovery", "force through press, hold and release"),
    "unseen": ("paper_tables:unseen", "surfaces that were not trained on"),
    "real": ("real:real", "real grips: shape of faces, patterns against readings"),
    "fig5": ("fig5:fig5", "alpha and beta against force"),
    "fig7": ("fig7:fig7", "tPSF, PSF and depth against FEM"),
}
"""Module below train.experiments with its function, and a line, of each experiment."""


def experiment(name: str) -> Experiment:
    """Return the function of an experiment: it measures with a workbench, and adds its tables to a report."""
    module, function = EXPERIMENTS[name][0].split(":")
    return getattr(importlib.import_module(f"train.experiments.{module}"), function)


def run(name: str, bench: Workbench, folder: Path) -> Path:
    """Run an experiment, and return its page."""
    work = experiment(name)
    bench.used.clear()
    report = Report(name, folder, inspect.getfile(work), bench.used, quick=bench.quick)
    work(bench, report)
    return report.write()


def main(arguments: list[str] | None = None) -> None:
    """Run the experiments named on the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m train.experiments",
        description=(__doc__ or "").splitlines()[0],
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="\n".join(f"  {name:19} {line}" for name, (_, line) in EXPERIMENTS.items()),
    )
    parser.add_argument(
        "names", nargs="+", choices=[*EXPERIMENTS, "all"], metavar="NAME", help="experiments, run in this order"
    )
    parser.add_argument("--reports", type=Path, default=Path("reports"), help="where to write (default: reports)")
    parser.add_argument(
        "--models", type=Path, default=BUNDLE_DIR, help="folder of the shipped models (default: the bundled ones)"
    )
    options = parser.parse_args(arguments)
    bench = Workbench(models=options.models)
    try:
        names = list(EXPERIMENTS) if "all" in options.names else options.names
        for name in tracked(names, "experiments", "page"):
            sys.stdout.write(f"{run(name, bench, options.reports)}\n")
    except (TrainError, EdgeError) as error:
        sys.exit(f"experiments: {error}")
    except KeyboardInterrupt:
        sys.exit("experiments: stopped; the same command continues")


if __name__ == "__main__":
    main()
