"""Options of `edge-sr doctor`, and its help."""

import argparse
from pathlib import Path
from typing import Final

from edge.terminal.argument_types import Parser, add_source, positive

DOCTOR_HELP: Final = """\
Keep the pad still, with nothing touching it, until you are asked to press its corners. Hold it in the \
orientation in which patterns are to be drawn: it defines top and left.

examples:
  edge-sr doctor
  edge-sr doctor --out sensor.toml
  edge-sr doctor --weight-g 200 \\
          --out sensor.toml
  edge-sr --sensor sensor.toml

Enter skips a request. Ctrl-C ends the doctor: what is measured until then is printed, and written with --out once the \
free pad is measured.

Exit codes: 0 no fault, 1 a fault, or a request that was not fulfilled, 2 wrong usage, 3 sensor, 130 Ctrl-C.
"""

DOCTOR_DRIFT_S: Final = 60.0


def doctor_parser() -> argparse.ArgumentParser:
    """Return the parser of the options of `edge-sr doctor`."""
    parser = Parser(
        prog="edge-sr doctor",
        usage="edge-sr doctor [options]",
        description="Examines sensor and adapter, reports faults with their remedies, and measures how the pad is "
        "mounted.",
        epilog=DOCTOR_HELP,
    )
    add = add_source(parser)
    add("--baseline", metavar="FILE", type=Path, help="earlier readings of the free pad, to detect a load on it")
    measure = parser.add_argument_group("what is measured").add_argument
    drift_help = f"seconds to measure the free, still pad (default {DOCTOR_DRIFT_S:g})"
    measure("--drift-s", metavar="T", type=positive, default=DOCTOR_DRIFT_S, help=drift_help)
    measure("--no-press", action="store_true", help="skip the presses on the corners")
    weight_help = "weight in grams to lay on the pad, which gives forces in newtons"
    measure("--weight-g", metavar="G", type=positive, help=weight_help)
    results = parser.add_argument_group("results").add_argument
    results("--out", metavar="FILE", type=Path, help="write the results into a sensor file")
    results("--json", action="store_true", help="write one JSON document to stdout")
    forget_help = "remove what the sensor of this name learned from contacts from the file of --sensor, and end"
    results("--forget-gains", metavar="SENSOR", help=forget_help)
    return parser
