"""What `edge-sr` may be asked, and its help; wide enough for 40 columns."""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NoReturn

from edge.bundle import DEFAULT_MODEL, DEMO_MODEL
from edge.taps import IDLE_TIMEOUT_S, OFF_COUNTS, ON_COUNTS
from firmware_bridge.baseline import FEWEST_SCANS
from firmware_bridge.xela import ID_MAPS, USPA44_MAP

EXIT_USAGE: Final = 2

RUN_HELP: Final = """\
sources:
  slcan:/dev/ttyUSB0[@BAUD]
  slcan:serial=D30BL366[@BAUD]
  replay:FILE[,FILE]  CSV, or npz
  demo                emulated sensor

sinks:
  status      live line (default on a
              terminal)
  jsonl:FILE  one JSON record a line
  jsonl:-     the same on stdout
  npz:FILE.npz  for replay and numpy

While it runs, {"cmd": "reset"} on stdin
forgets earlier taps, as for a new
object.

other commands:
  edge-sr models    bundled models
  edge-sr baseline  zero, and keep it
  edge-sr bench     error and run time

examples:
  edge-sr --source demo
  edge-sr --sink jsonl:-
  edge-sr --source replay:f.npz \\
          --sink npz:out.npz

exit codes: 2 usage, 3 device, 4 model,
5 sink
"""

BASELINE_HELP: Final = """\
Keep the pad still and free meanwhile.

example:
  edge-sr baseline --out zero.json
  edge-sr --baseline zero.json
"""


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


class Parser(argparse.ArgumentParser):
    """Reports wrong usage in one line."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, **settings)

    def error(self, message: str) -> NoReturn:
        """End with the message and where there is more."""
        self.exit(EXIT_USAGE, f"edge-sr: {message} ({self.prog} --help tells more)\n")


def run_parser() -> argparse.ArgumentParser:
    """Options of `edge-sr`."""
    parser = Parser(
        prog="edge-sr",
        usage="edge-sr [options]\n       edge-sr models\n       edge-sr baseline --out FILE\n       edge-sr bench",
        description="Reads tactile scans and\nsuper-resolves them at sensor rate.",
        epilog=RUN_HELP,
    )
    add = parser.add_argument
    add("--model", metavar="M", help=f"file, or bundled model (default {DEFAULT_MODEL}; for the demo {DEMO_MODEL})")
    add(
        "--budget-us",
        metavar="N",
        type=_positive,
        help="run time a pattern may take: of models with no more taps than M, the best that fits",
    )
    add("--recalibrate", action="store_true", help="measure run times anew for --budget-us")
    _add_source(parser)
    add("--sink", metavar="S", action="append", default=[], help="where results go; may be repeated")
    add("--duration-s", metavar="T", type=_positive, help="stop after this time")
    add("--baseline", metavar="FILE", type=Path, help="stored baseline, instead of zeroing at the start")
    add("--counts-per-newton", metavar="C", type=_positive, help="summed z per newton; gives forces in N")
    add(
        "--contact-on-counts",
        metavar="N",
        type=_positive,
        default=ON_COUNTS,
        help=f"summed z that begins a tap (default {ON_COUNTS:g})",
    )
    add(
        "--contact-off-counts",
        metavar="N",
        type=_positive,
        default=OFF_COUNTS,
        help=f"summed z that ends it (default {OFF_COUNTS:g})",
    )
    add(
        "--idle-reset-s",
        metavar="T",
        type=_positive,
        default=IDLE_TIMEOUT_S,
        help=f"forget earlier taps after so long without contact (default {IDLE_TIMEOUT_S:g})",
    )
    add("--every-scan", action="store_true", help="infer also where nothing has changed since the pattern before")
    add("--every-tap", action="store_true", help="use also taps that are not expected to help")
    add("--realtime", action="store_true", help="SCHED_FIFO, a processor of its own, locked memory; as permitted")
    return parser


def baseline_parser() -> argparse.ArgumentParser:
    """Options of `edge-sr baseline`."""
    parser = Parser(
        prog="edge-sr baseline",
        description="Zeroes once and keeps the baseline.",
        epilog=BASELINE_HELP,
    )
    _add_source(parser)
    parser.add_argument("--out", metavar="FILE", type=Path, required=True, help="where the baseline is kept")
    scans_help = f"scans to use (default and least {FEWEST_SCANS})"
    parser.add_argument("--scans", metavar="N", type=_whole(FEWEST_SCANS), default=FEWEST_SCANS, help=scans_help)
    parser.add_argument("--skip", metavar="N", type=_whole(0), default=0, help="scans to leave out first (default 0)")
    return parser


def bench_parser() -> argparse.ArgumentParser:
    """Options of `edge-sr bench`."""
    parser = Parser(
        prog="edge-sr bench",
        usage="edge-sr bench [options]",
        description="Error against run time of the\nbundled models and of methods without a\nnetwork.",
        epilog=BENCH_HELP,
    )
    add = parser.add_argument
    add("--out", metavar="DIR", type=Path, help="write bench.json, .csv, .md and .png there")
    add("--rate-hz", metavar="R", type=_positive, default=100.0, help="pace (default 100)")
    add("--ticks", metavar="N", type=_whole(10), default=3000, help="paced ticks a row (default 3000)")
    add("--threads", metavar="N", type=_whole(1), nargs="+", default=[1, 2], help="threads of one run (default 1 2)")
    add("--load", action="store_true", help="each row again with the last core busy")
    add("--models", metavar="DIR", type=Path, help="your own models too")
    against_help = "ratios to the run times of any ONNX files on floats"
    add("--against", metavar="FILE", type=Path, nargs="+", default=[], help=against_help)
    add("--compare", metavar="OLD.json", type=Path, help="ratios to an earlier bench of --out")
    add("--by-surface", action="store_true", help="PSNR of each surface")
    add("--system", action="store_true", help="the whole program and nothing else: 6 minutes with 3000 ticks")
    add("--soak", metavar="MINUTES", type=_positive, help="with --system: run it for so long, does it grow or drift?")
    add("--only", metavar="NAME", nargs="+", help="these methods alone")
    return parser


def models_parser() -> argparse.ArgumentParser:
    """Options of `edge-sr models`: none."""
    return Parser(prog="edge-sr models", description="Lists the bundled models.")


def _add_source(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--source", metavar="SRC", help="where scans come from (default: looks for an adapter)")
    parser.add_argument(
        "--id-map",
        metavar="MAP",
        choices=ID_MAPS,
        default=USPA44_MAP.name,
        help=f"which CAN id is which taxel: {', '.join(ID_MAPS)}; A and B are boards before 2021 (default uSPa44)",
    )
    parser.add_argument(
        "--rate-hz",
        metavar="R",
        type=_positive,
        help="play a recording at this rate; for a device, the rate to hold it against",
    )


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return value


def _whole(least: int) -> Callable[[str], int]:
    def whole(text: str) -> int:
        if not (text.isascii() and text.isdigit()) or int(text) < least:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {least}")
        return int(text)

    return whole
