"""Options of `edge-sr doctor`, and its help; narrow enough for 40 columns."""

import argparse
from pathlib import Path
from typing import Final

from edge.terminal.argument_types import Parser, add_source, positive

DOCTOR_HELP: Final = """\
Keep the pad free and still until you
are asked to press its corners, and to
grip something flat. Hold it in the
orientation in which patterns are to be
drawn: it defines top and left.

examples:
  edge-sr doctor
  edge-sr doctor --out sensor.toml
  edge-sr doctor --weight-g 200 \\
          --out sensor.toml
  edge-sr --sensor sensor.toml

exit codes: 0 no fault, 1 a fault,
2 usage, 3 device, 130 Ctrl-C, after
the findings so far are printed
"""

DOCTOR_DRIFT_S: Final = 60.0


def doctor_parser() -> argparse.ArgumentParser:
    """Return the parser of the options of `edge-sr doctor`."""
    parser = Parser(
        prog="edge-sr doctor",
        usage="edge-sr doctor [options]",
        description="Examines sensor and adapter, reports\n"
        "faults with their remedies, and measures\nhow the pad is mounted.",
        epilog=DOCTOR_HELP,
    )
    add = parser.add_argument
    add_source(parser)
    drift_help = f"seconds to measure the free, still pad (default {DOCTOR_DRIFT_S:g})"
    add("--drift-s", metavar="T", type=positive, default=DOCTOR_DRIFT_S, help=drift_help)
    add("--baseline", metavar="FILE", type=Path, help="stored baseline, to detect a load on the pad")
    add("--no-press", action="store_true", help="skip the presses on the corners")
    add("--no-grip", action="store_true", help="skip the grips of something flat")
    add("--weight-g", metavar="G", type=positive, help="weight to lay on the pad, to measure counts per newton")
    add(
        "--forget-gains",
        metavar="SENSOR",
        help="remove its learned gains from the file of --sensor, and end",
    )
    add("--out", metavar="FILE", type=Path, help="write the results into a sensor file")
    add("--json", action="store_true", help="write one JSON document to stdout")
    return parser
