"""Run experiments: each writes a page NAME.md and its tables as CSV, some a plot.

python -m train.experiments table3 angle --reports reports
"""

import argparse
import importlib
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

from edge.errors import EdgeError
from edge.inference.bundled import BUNDLE_DIR
from edge.terminal.progress_bar import tracked
from train.errors import TrainError
from train.experiments.workbench import Workbench

EXPERIMENTS: Final = {
    "families": ("sensor.families", "the shipped model and its intervals on every family, next to baselines"),
    "pads": ("sensor.pads", "the shipped model on pads that are off the nominal one"),
    "trust-checks": ("sensor.trust_checks", "patterns not believed and taps dropped, rightly and wrongly"),
    "posed-taps": ("sensor.posed_taps", "one to seven taps from known poses, by schedule, and with wrong poses"),
    "table3": ("paper.tables:run_table3", "all methods at x10 on the same targets"),
    "table4": ("paper.tables:run_table4", "STSR at five scales"),
    "angle": ("paper.tables:run_angle", "MTSR-2 by angle between its taps"),
    "taps": ("paper.tables:run_taps", "one to seven taps"),
    "force": ("paper.force:run_force", "error by contact force"),
    "force-recovery": ("paper.force:run_recovery", "force through press, hold and release"),
    "unseen": ("paper.tables:run_unseen", "surfaces that were not trained on"),
    "real": ("sensor.real", "real grips: shape of faces, patterns against readings"),
    "fig5": ("paper.fig5", "alpha and beta against force"),
    "fig7": ("paper.fig7", "tPSF, PSF and depth against FEM"),
}
"""Module below train.experiments, its function unless that is `run`, and a line, of each experiment."""


def function_of(name: str) -> Callable[[Workbench, Path], Path]:
    """Return the function that runs an experiment."""
    module, _, function = EXPERIMENTS[name][0].partition(":")
    return getattr(importlib.import_module(f"train.experiments.{module}"), function or "run")


def main(arguments: list[str] | None = None) -> None:
    """Run the experiments named on the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m train.experiments",
        description=(__doc__ or "").splitlines()[0],
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="\n".join(f"  {name:19} {what}" for name, (_, what) in EXPERIMENTS.items()),
    )
    parser.add_argument(
        "names", nargs="+", choices=[*EXPERIMENTS, "all"], metavar="NAME", help="experiments, run in this order"
    )
    parser.add_argument("--reports", type=Path, default=Path("reports"), help="where to write (default: reports)")
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the datasets; missing ones are made")
    parser.add_argument(
        "--checkpoints", type=Path, default=Path("checkpoints"), help="folder of the networks; missing ones are trained"
    )
    parser.add_argument("--quick", action="store_true", help="use tiny settings, as a test of the command")
    parser.add_argument(
        "--models", type=Path, default=BUNDLE_DIR, help="folder of the shipped models (default: the bundled ones)"
    )
    options = parser.parse_args(arguments)
    bench = Workbench(options.data, options.checkpoints, options.quick, options.models)
    try:
        names = list(EXPERIMENTS) if "all" in options.names else options.names
        for name in tracked(names, "experiments", "page"):
            page = function_of(name)(replace(bench, used=set()), options.reports)
            sys.stdout.write(f"{page}\n")
    except (TrainError, EdgeError) as error:
        sys.exit(f"experiments: {error}")
    except KeyboardInterrupt:
        sys.exit("experiments: stopped; the same command continues")


if __name__ == "__main__":
    main()
