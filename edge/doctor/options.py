"""Options of `edge-sr doctor`, and its help; narrow enough for 40 columns."""

import argparse
from pathlib import Path
from typing import Final

from edge.terminal.argument_types import Parser, add_source, positive

DOCTOR_HELP: Final = """\
Keep the pad free and still until you
are asked to press its corners, and to
grip something flat. Hold the pad as
patterns are to be drawn; that is what
top and left mean.

examples:
  edge-sr doctor
  edge-sr doctor --out sensor.toml
  edge-sr doctor --weight-g 200 \\
          --out sensor.toml
  edge-sr --sensor sensor.toml

exit codes: 0 nothing wrong, 1 something
is, 2 usage, 3 device, 130 Ctrl-C;
what was found until then is told.
"""

DOCTOR_DRIFT_S: Final = 60.0


def doctor_parser() -> argparse.ArgumentParser:
    """Return the parser of the options of `edge-sr doctor`."""
    parser = Parser(
        prog="edge-sr doctor",
        usage="edge-sr doctor [options]",
        description="Examines sensor and adapter, says what\nis wrong and what to do, and finds out\nhow the pad sits.",
        epilog=DOCTOR_HELP,
    )
    add = parser.add_argument
    add_source(parser)
    drift_help = f"watch for so long, the pad free and still (default {DOCTOR_DRIFT_S:g})"
    add("--drift-s", metavar="T", type=positive, default=DOCTOR_DRIFT_S, help=drift_help)
    add("--baseline", metavar="FILE", type=Path, help="stored baseline, to see whether something lies on the pad")
    add("--no-press", action="store_true", help="do not ask for presses on the corners")
    add("--no-grip", action="store_true", help="do not ask for grips of something flat")
    add("--weight-g", metavar="G", type=positive, help="ask for a weight on the pad; gives counts per newton")
    add(
        "--forget-gains",
        metavar="SENSOR",
        help="remove what was learned of its gains from the file of --sensor, and end",
    )
    add("--out", metavar="FILE", type=Path, help="write what was found into a sensor file")
    add("--json", action="store_true", help="one JSON document on stdout")
    return parser
