"""Options of `edge-sr bench`, its help, and its errors."""

import argparse
from pathlib import Path
from typing import Final

from edge.errors import EdgeError
from edge.terminal.argument_types import Parser, positive, whole


class BenchError(EdgeError, RuntimeError):
    """Error of a measurement that could not be made, or of an earlier bench that cannot be used."""


BENCH_HELP: Final = """\
Run time is measured back to back, and paced: one inference a tick, as on a robot. A row takes half a minute. No other \
program should run meanwhile.

examples:
  edge-sr bench --out today
  edge-sr bench --threads 1 \\
          --only stsr mtsr

Ctrl-C ends it with exit code 130, after the rows measured so far are written.
"""


def bench_parser() -> argparse.ArgumentParser:
    """Return the parser of the options of `edge-sr bench`."""
    parser = Parser(
        prog="edge-sr bench",
        usage="edge-sr bench [options]",
        description="Measures error against run time of the bundled models and of methods without a network.",
        epilog=BENCH_HELP,
    )
    add = parser.add_argument
    add("--out", metavar="DIR", type=Path, help="folder for bench.csv and bench.md")
    add("--rate-hz", metavar="R", type=positive, default=100.0, help="paced ticks a second (default 100)")
    add("--ticks", metavar="N", type=whole(10), default=3000, help="paced ticks a row (default 3000)")
    add("--threads", metavar="N", type=whole(1), nargs="+", default=[1, 2], help="numbers of threads (default 1 2)")
    add("--models", metavar="DIR", type=Path, help="folder of your own models, measured as well")
    add("--only", metavar="NAME", nargs="+", help="measure only these methods")
    add("--system", action="store_true", help="measure the whole program only: 2 minutes with 3000 ticks")
    add("--sensors", metavar="N", type=whole(1), help="measure the whole program with so many sensors (default 1)")
    add("--against", metavar="COMMIT", help="measure the whole program in turn with that of another commit")
    return parser
