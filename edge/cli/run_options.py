"""Options of `edge-sr` and its small commands, and their help; made for 40 columns.

Bench and doctor have options of their own: edge.bench.options, edge.doctor.options.
"""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from edge.inference.bundled import DEFAULT_MODEL, DEMO_MODEL
from edge.perception.contact_options import DEFAULTS, RuntimeOptions
from edge.pipeline.baseline_capture import FEWEST_RECORDED
from edge.sinks.registry import check_apart, check_sink
from edge.terminal.argument_types import Parser, add_source, not_negative, port, positive, whole
from firmware_bridge.zeroing.baseline import FEWEST_SCANS

VIEW_PORT: Final = 8077

RUN_HELP: Final = """\
sources:
  slcan:/dev/ttyUSB0[@BAUD]
  slcan:serial=D30BL366[@BAUD]
  xela-server:ws://HOST[:5000]
                      vendor's server
  gs_usb[:SERIAL]     candleLight
  can:socketcan:can0  by python-can
  can:pcan:PCAN_USBBUS1, kvaser, ...
  replay:FILE[,FILE]  mcap, npz, CSV
  demo[:loop]         emulated sensor

sinks:
  status      live line (default on a
              terminal)
  jsonl:FILE  one JSON record a line
  jsonl:-     the same on stdout
  npz:FILE.npz  for replay and numpy
  mcap:FILE.mcap  for replay, Foxglove
              and ros2 bag
  shm:NAME      latest values, shared
                memory
  zenoh:KEY[?connect=tcp/HOST:7447]
  ros2:TOPIC  ROS 2 messages over DDS
--view shows it in a browser as well

While it runs, these lines on stdin:
  {"cmd": "reset"}  forget earlier taps,
                    as for a new object
  {"cmd": "zero"}   zero again; also
      "sensor": "4"  one alone,
      "force": true  even in contact
On a terminal: r resets, z zeroes, Z
does even in contact. SIGUSR1 is z.

other commands:
  edge-sr demo      no hardware; with
                    --view it goes on
  edge-sr record FILE  the same, kept
  edge-sr replay FILE  made anew
  edge-sr models    bundled models
  edge-sr baseline  zero, and keep it
  edge-sr bench     error and run time
  edge-sr devices   what is plugged in
  edge-sr doctor    what is wrong, and
                    what to do

examples:
  edge-sr --source demo
  edge-sr --sink jsonl:-
  edge-sr --source replay:f.npz \\
          --sink npz:out.npz

exit codes: 2 usage, 3 device, 4 model,
5 sink, 6 ended by force
"""

BASELINE_HELP: Final = """\
Keep the pad still and free meanwhile.

example:
  edge-sr baseline --out zero.json
  edge-sr --baseline zero.json
of a recording that begins in contact:
  edge-sr baseline --out zero.json \\
          --source replay:f.csv \\
          --skip 190 --scans 60
  edge-sr replay f.csv \\
          --baseline zero.json
"""


RECORD_HELP: Final = """\
example:
  edge-sr record press.mcap
  edge-sr replay press.mcap \\
          --model mtsr4-int8 \\
          --sink jsonl:-
"""

REPLAY_HELP: Final = """\
Every scan gets its result, as fast as
the machine goes, with the time of the
recording; begins with the baseline
that was in use at its first scan.

example:
  edge-sr replay press.mcap \\
          --model mtsr4-int8 \\
          --sink mcap:again.mcap
"""


def run_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr`."""
    parser = Parser(
        prog="edge-sr",
        usage="edge-sr [options]\n       edge-sr demo [options]\n"
        "       edge-sr record FILE [options]\n       edge-sr replay FILE [options]\n"
        "       edge-sr models\n       edge-sr baseline --out FILE\n       edge-sr bench\n"
        "       edge-sr devices\n       edge-sr doctor",
        description="Reads tactile scans and\nsuper-resolves them at sensor rate.",
        epilog=RUN_HELP,
    )
    _add_run(parser)
    return parser


def record_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr record`: a file, and the options of `edge-sr`."""
    parser = Parser(
        prog="edge-sr record",
        usage="edge-sr record FILE [options]",
        description="Runs as edge-sr does, and records\nscans, patterns and events.",
        epilog=RECORD_HELP,
    )
    parser.add_argument("file", metavar="FILE", help="new file: .npz, else .mcap")
    _add_run(parser)
    return parser


def replay_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr replay`; options of live runs alone have the values that a recording needs."""
    parser = Parser(
        prog="edge-sr replay",
        usage="edge-sr replay FILE [options]",
        description="Makes patterns of a recording anew.",
        epilog=REPLAY_HELP,
    )
    parser.add_argument("file", metavar="FILE", help=".mcap, .npz or .csv; or several, FILE,FILE, of a sensor each")
    parser.add_argument("--model", metavar="M", help=f"file, or bundled model (default {DEFAULT_MODEL})")
    zeroing = parser.add_mutually_exclusive_group()
    zeroing.add_argument("--baseline", metavar="FILE", type=Path, help="another baseline")
    zeroing.add_argument("--zero", action="store_true", help="zero from the first 100 scans that are free and still")
    parser.add_argument("--sink", metavar="S", action="append", default=[], help="where results go; may be repeated")
    parser.add_argument(
        "--paced", action="store_true", help="at the speed it was made, in time of now; --view implies it"
    )
    parser.add_argument("--sensor", metavar="FILE", type=Path, help="of edge-sr doctor, instead of what was recorded")
    parser.add_argument(
        "--rate-hz",
        metavar="R",
        type=positive,
        help="scans a second: where the file does not tell, or with --paced",
    )
    parser.add_argument("--duration-s", metavar="T", type=positive, help="stop after so much of the recording")
    _add_results(parser)
    _add_view(parser)
    parser.set_defaults(source=[], id_map=None, budget_us=None, recalibrate=False, give_up_s=None, realtime=False)
    return parser


def understood(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the options of a run, and check all that can be checked before anything is opened.

    Raises:
        UsageError: a sink does not exist or occurs twice, or thresholds are out of range.
    """
    options = parser.parse_args(arguments)
    for text in options.sink:
        check_sink(text)
    check_apart(options.sink)
    runtime_options(options)
    return options


def runtime_options(options: argparse.Namespace) -> RuntimeOptions:
    """Return the flags of the runtime, each by its own name; options without a flag keep their defaults.

    Raises:
        UsageError: thresholds or a time are out of range.
    """
    given = vars(options)
    return RuntimeOptions(**{name: given[name] for name in asdict(DEFAULTS) if name in given})


def _add_run(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--model", metavar="M", help=f"file, or bundled model (default {DEFAULT_MODEL}; for the demo {DEMO_MODEL})")
    add(
        "--budget-us",
        metavar="N",
        type=positive,
        help="run time a pattern may take: of models with no more taps than M, the best that fits",
    )
    add("--recalibrate", action="store_true", help="measure run times anew for --budget-us")
    add_source(parser)
    add("--sink", metavar="S", action="append", default=[], help="where results go; may be repeated")
    add("--duration-s", metavar="T", type=positive, help="stop after this time")
    add(
        "--give-up-s",
        metavar="T",
        type=not_negative,
        help="end when a lost source is away for so long; 0 at once (default: wait for ever)",
    )
    add("--baseline", metavar="FILE", type=Path, help="stored baseline, instead of zeroing at the start")
    _add_results(parser)
    add("--realtime", action="store_true", help="SCHED_FIFO, a processor of its own, locked memory; as permitted")
    _add_view(parser)


def _add_results(parser: argparse.ArgumentParser) -> None:
    """Add the options of making results from scans, whatever their source."""
    add = parser.add_argument
    add("--counts-per-newton", metavar="C", type=positive, help="summed z per newton; gives forces in N")
    add(
        "--contact-on-counts",
        metavar="N",
        type=positive,
        default=DEFAULTS.contact_on_counts,
        help=f"summed z that begins a tap (default {DEFAULTS.contact_on_counts:g})",
    )
    add(
        "--contact-off-counts",
        metavar="N",
        type=positive,
        default=DEFAULTS.contact_off_counts,
        help=f"summed z that ends it (default {DEFAULTS.contact_off_counts:g})",
    )
    add(
        "--idle-reset-s",
        metavar="T",
        type=positive,
        default=DEFAULTS.idle_reset_s,
        help=f"forget earlier taps after so long without contact (default {DEFAULTS.idle_reset_s:g})",
    )
    add("--every-scan", action="store_true", help="infer also where nothing has changed since the pattern before")
    add("--every-tap", action="store_true", help="use also taps that are not expected to help")
    add("--no-learn", dest="learn", action="store_false", help="do not learn the gains of the sensor from contacts")


def _add_view(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--view",
        metavar="PORT",
        nargs="?",
        type=port,
        const=VIEW_PORT,
        help=f"live page for a browser, at this port (default {VIEW_PORT}; 0: any free one)",
    )
    add("--view-host", metavar="H", help="address it listens at, instead of this machine's own alone; needs a token")
    add("--view-token", metavar="T", help="the token (default: one is made, and printed)")
    add("--view-record-dir", metavar="DIR", type=Path, help="where its button records into (default: here)")


def baseline_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr baseline`."""
    parser = Parser(
        prog="edge-sr baseline",
        description="Zeroes once and keeps the baseline.",
        epilog=BASELINE_HELP,
    )
    add_source(parser)
    parser.add_argument("--out", metavar="FILE", type=Path, required=True, help="where the baseline is kept")
    scans_help = f"scans to use (default and least {FEWEST_SCANS}; of a recording least {FEWEST_RECORDED})"
    parser.add_argument("--scans", metavar="N", type=whole(FEWEST_RECORDED), default=FEWEST_SCANS, help=scans_help)
    parser.add_argument("--skip", metavar="N", type=whole(0), default=0, help="scans to leave out first (default 0)")
    return parser


def devices_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr devices`."""
    parser = Parser(
        prog="edge-sr devices",
        description="Lists serial ports, CAN adapters and\nCAN interfaces, what to write behind\n"
        "--source, and what is in the way.",
        epilog="exit codes: 3 no adapter",
    )
    parser.add_argument("--json", action="store_true", help="for programs")
    return parser


def models_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr models`, which has no options."""
    return Parser(prog="edge-sr models", description="Lists the bundled models.")
