"""`edge-sr` among all faults for minutes, evaluated against the truth of the injector.

    python tests/system/faults.py MINUTES --seed N [--out DIR]

Exit code 1 where a promise was not kept.
"""

import argparse
import math
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from fault_judge import judge
from fault_page import show, show_server
from fault_run import CALM_S, run_among_faults
from fault_server import judge_server, run_against_server

from edge.bench.errors import BenchError
from edge.bench.live_report import Page
from edge.bench.program import PROGRAM_SOURCES
from edge.bench.provenance import provenance
from edge.inference.bundled import DEFAULT_MODEL, find_model

SETTLE_S: Final = 2.0
SERVER_S: Final = 20.0
_TEXT: Final = """\
edge-sr in a process of its own reads two emulated fingers on one bus over a pseudo-terminal; between bus and terminal
sits the injector, which knows of every frame what became of it. Every reading tells its cycle, and every record is held
against what was sent. Faults come in turns, each for .2 to 1.5 s, several at once. Records go to a pipe that is read at
once, to one whose reader stops for seconds, to one whose reader leaves, to /dev/full, and to a file and an npz that may
grow to 6 MB. The wall clock of edge-sr's Python is stepped an hour on and two back."""


def schedule(seconds: float) -> str:
    """Return faults for a run of so long: calm, the mixture, then a pause and whole scans, so that accounts close."""
    end_s = seconds - SETTLE_S
    pause, rest = f"vanished=1@{end_s:.2f}+.3", f"vanished=1@{end_s + 1:.2f}+60"
    return f"mixed@{CALM_S}+{end_s - CALM_S:.2f},{pause},{rest}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; 0 when every promise was kept, 1 when not."""
    parser = argparse.ArgumentParser(prog="python tests/system/faults.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("minutes", type=float, metavar="MINUTES", help="length of the run, .25 at least")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of all chance (default 1)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write faults.md there")
    options = parser.parse_args(arguments)
    if not 0.25 <= options.minutes < math.inf:
        parser.error(f"MINUTES is {options.minutes:g}, expected .25 or more")
    page = Page(sys.stdout, sys.stderr)
    command = f"python tests/system/faults.py {options.minutes:g} --seed {options.seed}"
    models = [find_model(DEFAULT_MODEL)]
    head = provenance(command, [__file__, *PROGRAM_SOURCES], models, options.seed)
    page.say(f"# Faults\n\n{head}\n\n{_TEXT}")
    try:
        with tempfile.TemporaryDirectory() as folder:
            ran = run_among_faults(schedule(60 * options.minutes), options.seed, Path(folder))
            found = None if ran.told is None else judge(ran.seen, ran.told)
            if ran.told is None or found is None:
                raise BenchError("nothing is known of what was injected")
            kept = show(ran, found, ran.told, page.say)
            served = run_against_server(max(SERVER_S, 6 * options.minutes), options.seed, Path(folder))
            kept &= show_server(served, judge_server(served), page.say)
    except BenchError as error:
        sys.stderr.write(f"faults: {error}\n")
        return 1
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "faults.md").write_text("\n".join(page.lines) + "\n")
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
