"""Options of `edge-sr bench`, and its help; narrow enough for 40 columns."""

import argparse
from pathlib import Path
from typing import Final

from edge.terminal.argument_types import Parser, positive, whole

BENCH_HELP: Final = """\
Run time is taken back to back, and one
inference a tick, idle in between, as on
a robot. Half a minute a row: nothing
else should run meanwhile.

examples:
  edge-sr bench --out today
  edge-sr bench --load --only stsr mtsr4
  edge-sr bench --threads 1 \\
          --compare before/bench.json

Ctrl-C ends it with exit code 130; what
was measured is written.
"""


def bench_parser() -> argparse.ArgumentParser:
    """Return the parser of the options of `edge-sr bench`."""
    parser = Parser(
        prog="edge-sr bench",
        usage="edge-sr bench [options]",
        description="Error against run time of the\nbundled models and of methods without a\nnetwork.",
        epilog=BENCH_HELP,
    )
    add = parser.add_argument
    add("--out", metavar="DIR", type=Path, help="write bench.json, .csv, .md and .png there")
    add("--rate-hz", metavar="R", type=positive, default=100.0, help="pace (default 100)")
    add("--ticks", metavar="N", type=whole(10), default=3000, help="paced ticks a row (default 3000)")
    add("--threads", metavar="N", type=whole(1), nargs="+", default=[1, 2], help="threads of one run (default 1 2)")
    add("--load", action="store_true", help="each row again with the last core busy")
    add("--models", metavar="DIR", type=Path, help="your own models too")
    against_help = "ratios to the run times of any ONNX files on floats"
    add("--against", metavar="FILE", type=Path, nargs="+", default=[], help=against_help)
    add("--compare", metavar="OLD.json", type=Path, help="ratios to an earlier bench of --out")
    add("--by-surface", action="store_true", help="PSNR of each surface")
    add("--system", action="store_true", help="the whole program and nothing else: 6 minutes with 3000 ticks")
    add("--soak", metavar="MINUTES", type=positive, help="with --system: run it for so long, does it grow or drift?")
    add("--only", metavar="NAME", nargs="+", help="these methods alone")
    return parser
