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
One inference a tick, idle in between,
as on a robot. Nothing else should run
meanwhile.
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
        description="Error against run time of the\nbundled models and of methods without a\nnetwork.",
        epilog=BENCH_HELP,
    )
    parser.add_argument("--rate-hz", metavar="R", type=_positive, default=100.0, help="pace (default 100)")
    parser.add_argument("--ticks", metavar="N", type=_whole(10), default=1000, help="runs a row (default 1000)")
    parser.add_argument("--by-surface", action="store_true", help="a second table: PSNR of each surface")
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
