"""Options of `edge-sr` and its small commands, and their help; made for 40 columns.

Bench and doctor have options of their own: edge.bench.options, edge.doctor.options.
"""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from edge.inference.bundled import DEFAULT_MODEL, DEMO_MODEL
from edge.mapping.object_map import PX_PER_MM, SIZE_MM
from edge.perception.contact_options import DEFAULTS, RuntimeOptions
from edge.pipeline.baseline_capture import FEWEST_RECORDED
from edge.pose_sources.open_poses import check_poses
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
--view adds a live page for a browser

Lines on stdin during a run:
  {"cmd": "reset"}  forget earlier taps,
                    as for a new object
  {"cmd": "zero"}   zero again; also
      "sensor": "4"  only this sensor
      "force": true  even in contact
  {"cmd": "pose", "x_mm": 1, "y_mm": 0}
                    where the pad is
Keys on a terminal: r reset, z zero,
Z zero even in contact. SIGUSR1: z.

other commands:
  edge-sr demo      no hardware; with
                    --view endless
  edge-sr record FILE  run and record
  edge-sr replay FILE  compute again
  edge-sr map       a map of an object
                    larger than the pad
  edge-sr models    bundled models
  edge-sr baseline  zero into a file
  edge-sr bench     error and run time
  edge-sr devices   what is plugged in
  edge-sr doctor    faults, and their
                    remedies

examples:
  edge-sr --source demo
  edge-sr --sink jsonl:-
  edge-sr --source replay:f.npz \\
          --sink npz:out.npz

exit codes: 2 usage, 3 device, 4 model,
5 sink, 6 ended by force
"""

BASELINE_HELP: Final = """\
Keep the pad still and free.

example:
  edge-sr baseline --out zero.json
  edge-sr --baseline zero.json
For a recording that begins in contact:
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
Computes a result for every scan, as
fast as possible, with the times of the
recording, and begins with the baseline
that was in use at its first scan.

example:
  edge-sr replay press.mcap \\
          --model mtsr4-int8 \\
          --sink mcap:again.mcap
"""


MAP_HELP: Final = """\
Needs poses of the pad in the object's
plane: lines on stdin, or those of a
recording. x to the right and y down,
as in a pattern.

example:
  my_robot_poses | edge-sr map \\
          --out part.npz --png part.png
A line of poses:
  {"cmd": "pose", "x_mm": 1.5,
   "y_mm": -20, "turn_deg": 5}
"""


def run_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr`."""
    parser = Parser(
        prog="edge-sr",
        usage="edge-sr [options]\n       edge-sr demo [options]\n"
        "       edge-sr record FILE [options]\n       edge-sr replay FILE [options]\n"
        "       edge-sr map [options]\n"
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
        description="Runs like edge-sr, and records\nscans, patterns and events.",
        epilog=RECORD_HELP,
    )
    parser.add_argument("file", metavar="FILE", help="new file, .npz or .mcap")
    _add_run(parser)
    return parser


def map_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr map`: the map's size and files, and the options of `edge-sr`."""
    parser = Parser(
        prog="edge-sr map",
        usage="edge-sr map [options]",
        description="Runs like edge-sr, and fuses the\npatterns into a map of the object.",
        epilog=MAP_HELP,
    )
    add = parser.add_argument
    add("--out", metavar="FILE", type=Path, default=Path("map.npz"), help="layers of the map (default map.npz)")
    add("--png", metavar="FILE", type=Path, help="picture of contact and height")
    add("--size-mm", metavar="L", type=positive, default=SIZE_MM, help=f"side of the map (default {SIZE_MM:g})")
    add(
        "--px-per-mm",
        metavar="N",
        type=positive,
        default=PX_PER_MM,
        help=f"pixels of the map per mm (default {PX_PER_MM:g})",
    )
    add(
        "--centre-mm",
        metavar="C",
        type=float,
        nargs=2,
        default=(0.0, 0.0),
        help="x and y of its centre in the object's plane (default 0 0)",
    )
    _add_run(parser)
    return parser


def replay_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr replay`; options of live runs alone have the values that a recording needs."""
    parser = Parser(
        prog="edge-sr replay",
        usage="edge-sr replay FILE [options]",
        description="Computes the patterns of a recording\nagain.",
        epilog=REPLAY_HELP,
    )
    parser.add_argument("file", metavar="FILE", help=".mcap, .npz or .csv; or one file for each sensor, FILE,FILE")
    parser.add_argument("--model", metavar="M", help=f"model file, or bundled model (default {DEFAULT_MODEL})")
    zeroing = parser.add_mutually_exclusive_group()
    zeroing.add_argument("--baseline", metavar="FILE", type=Path, help="stored baseline, instead of the recorded one")
    zeroing.add_argument("--zero", action="store_true", help="zero from the first 100 scans that are free and still")
    parser.add_argument("--sink", metavar="S", action="append", default=[], help="output for results; may be repeated")
    parser.add_argument(
        "--paced", action="store_true", help="play at the original speed, with current times; --view implies it"
    )
    parser.add_argument("--sensor", metavar="FILE", type=Path, help="sensor file, instead of the recorded mounting")
    parser.add_argument(
        "--rate-hz",
        metavar="R",
        type=positive,
        help="scans a second, if the file does not state it or with --paced",
    )
    parser.add_argument("--duration-s", metavar="T", type=positive, help="stop after T seconds of the recording")
    _add_results(parser)
    _add_view(parser)
    parser.set_defaults(
        source=[], id_map=None, budget_us=None, recalibrate=False, give_up_s=None, realtime=False, poses=[]
    )
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
    for text in options.poses:
        check_poses(text)
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
    add(
        "--model",
        metavar="M",
        help=f"model file, or bundled model (default {DEFAULT_MODEL}; for the demo {DEMO_MODEL})",
    )
    add(
        "--budget-us",
        metavar="N",
        type=positive,
        help="choose the most accurate model, with no more taps than M, that is faster than N us",
    )
    add("--recalibrate", action="store_true", help="with --budget-us: measure run times again")
    add_source(parser)
    add("--sink", metavar="S", action="append", default=[], help="output for results; may be repeated")
    add(
        "--poses",
        metavar="P",
        action="append",
        default=[],
        help="source of the poses of the pad: zenoh[:KEY], ros2:TOPIC or tf:PARENT:CHILD; for one sensor SENSOR=P; "
        "may be repeated",
    )
    add("--duration-s", metavar="T", type=positive, help="stop after T seconds")
    add(
        "--give-up-s",
        metavar="T",
        type=not_negative,
        help="end when a source has been lost for T s; 0: at once (default: never)",
    )
    add("--baseline", metavar="FILE", type=Path, help="stored baseline, instead of zeroing at the start")
    _add_results(parser)
    add(
        "--realtime", action="store_true", help="use SCHED_FIFO, a processor of its own and locked memory, as permitted"
    )
    _add_view(parser)


def _add_results(parser: argparse.ArgumentParser) -> None:
    """Add the options of making results from scans, whatever their source."""
    add = parser.add_argument
    add("--counts-per-newton", metavar="C", type=positive, help="summed z per newton, for forces in N")
    add(
        "--contact-on-counts",
        metavar="N",
        type=positive,
        default=DEFAULTS.contact_on_counts,
        help=f"summed z at which a tap begins (default {DEFAULTS.contact_on_counts:g})",
    )
    add(
        "--contact-off-counts",
        metavar="N",
        type=positive,
        default=DEFAULTS.contact_off_counts,
        help=f"summed z at which a tap ends (default {DEFAULTS.contact_off_counts:g})",
    )
    add(
        "--idle-reset-s",
        metavar="T",
        type=positive,
        default=DEFAULTS.idle_reset_s,
        help=f"forget earlier taps after T s without contact (default {DEFAULTS.idle_reset_s:g})",
    )
    add("--every-scan", action="store_true", help="run the inference even if nothing has changed")
    add("--every-tap", action="store_true", help="use all taps, even those not expected to help")
    add(
        "--taps",
        metavar="K",
        type=whole(1),
        help="most taps of a pattern (default: all that the model takes; 1 if it takes poses and there are none)",
    )
    add(
        "--no-fallback",
        dest="fallback",
        action="store_false",
        help="keep an untrusted pattern, instead of the smooth one",
    )
    add("--no-learn", dest="learn", action="store_false", help="do not learn the gains of the sensor from contacts")


def _add_view(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--view",
        metavar="PORT",
        nargs="?",
        type=port,
        const=VIEW_PORT,
        help=f"serve a live page at this port (default {VIEW_PORT}; 0: any free one)",
    )
    add("--view-host", metavar="H", help="address of the page, instead of 127.0.0.1; requires a token")
    add("--view-token", metavar="T", help="token of the page (default: generated and printed)")
    add(
        "--view-record-dir", metavar="DIR", type=Path, help="folder of the page's recordings (default: the current one)"
    )


def baseline_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr baseline`."""
    parser = Parser(
        prog="edge-sr baseline",
        description="Zeroes once and stores the baseline.",
        epilog=BASELINE_HELP,
    )
    add_source(parser)
    parser.add_argument("--out", metavar="FILE", type=Path, required=True, help="file for the baseline")
    scans_help = f"scans to use (default and minimum {FEWEST_SCANS}; for a recording {FEWEST_RECORDED})"
    parser.add_argument("--scans", metavar="N", type=whole(FEWEST_RECORDED), default=FEWEST_SCANS, help=scans_help)
    parser.add_argument("--skip", metavar="N", type=whole(0), default=0, help="scans to skip at the start (default 0)")
    return parser


def devices_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr devices`."""
    parser = Parser(
        prog="edge-sr devices",
        description="Lists serial ports, CAN adapters and\nCAN interfaces, their text for --source,\n"
        "and what prevents their use.",
        epilog="exit codes: 3 no adapter",
    )
    parser.add_argument("--json", action="store_true", help="write JSON, for programs")
    return parser


def models_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr models`, which has no options."""
    return Parser(prog="edge-sr models", description="Lists the bundled models.")
