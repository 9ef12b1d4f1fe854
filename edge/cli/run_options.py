"""Options of `edge-sr` and its small commands, in groups.

Bench and doctor have options of their own: edge.bench.options, edge.doctor.options.
"""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from edge.cli.run_help import (
    BASELINE_HELP,
    CONVERT_HELP,
    DEMO_ABOUT,
    DEMO_HELP,
    MAP_HELP,
    RECORD_HELP,
    REPLAY_HELP,
    RUN_ABOUT,
    RUN_HELP,
)
from edge.errors import UsageError
from edge.inference.bundled import DEFAULT_MODEL, POSED_MODEL
from edge.perception.contact_options import DEFAULTS, RuntimeOptions
from edge.sinks.registry import check_apart, check_sink
from edge.terminal.argument_types import Parser, add_source, counts_per_newton, not_negative, port, positive, whole
from firmware_bridge.zeroing.baseline import FEWEST_SCANS

VIEW_PORT: Final = 8077
SINK_HELP: Final = "output for results, such as jsonl:-; repeat it for several; edge-sr --help lists all"

_FIELDS_HELP: Final = (
    "fields of JSON records, such as force_n,pattern, in addition to those of every record (default: all)"
)
_MODEL_HELP: Final = (
    "bundled model, of those that edge-sr models lists, or model file (default "
    f"{DEFAULT_MODEL}; where poses of the pad come, as in the demo, {POSED_MODEL})"
)


def run_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr`."""
    parser = Parser(
        prog="edge-sr",
        usage="edge-sr [options]\n       edge-sr COMMAND [options]",
        description=RUN_ABOUT,
        epilog=RUN_HELP,
    )
    _add_run(parser)
    return parser


def demo_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr demo`; options of a real sensor have their defaults."""
    parser = Parser(prog="edge-sr demo", usage="edge-sr demo [options]", description=DEMO_ABOUT, epilog=DEMO_HELP)
    add = parser.add_argument_group("sensor").add_argument
    add("--rate-hz", metavar="R", type=positive, help="scans a second (default 100)")
    _add_model(parser)
    _add_outputs(parser)
    _add_view(parser)
    _add_results(parser)
    _add_processor(parser)
    parser.set_defaults(sensor=None, id_map=None, force=False, baseline=None, poses=[], give_up_s=None)
    return parser


def record_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr record`: a file, and the options of `edge-sr`."""
    parser = Parser(
        prog="edge-sr record",
        usage="edge-sr record FILE [options]",
        description="Runs like edge-sr, and records scans, patterns and events.",
        epilog=RECORD_HELP,
    )
    parser.add_argument_group("file").add_argument("file", metavar="FILE", help="new file, .mcap")
    _add_run(parser)
    return parser


def map_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr map`: the map's size and files, and the options of `edge-sr`."""
    from edge.mapping.object_map import PX_PER_MM, SIZE_MM

    parser = Parser(
        prog="edge-sr map",
        usage="edge-sr map [options]",
        description="Runs like edge-sr, and fuses the patterns into a map of the object.",
        epilog=MAP_HELP,
    )
    add = parser.add_argument_group("map").add_argument
    add(
        "--out",
        metavar="FILE",
        type=Path,
        default=Path("map.npz"),
        help="file for the layers of the map (default map.npz)",
    )
    add("--png", metavar="FILE", type=Path, help="file for a picture of contact and height")
    add(
        "--size-mm",
        metavar="L",
        type=positive,
        default=SIZE_MM,
        help=f"length of its sides in mm (default {SIZE_MM:g})",
    )
    add(
        "--px-per-mm",
        metavar="N",
        type=positive,
        default=PX_PER_MM,
        help=f"pixels of the map per mm (default {PX_PER_MM:g})",
    )
    add(
        "--centre-mm",
        metavar=("X", "Y"),
        type=float,
        nargs=2,
        default=(0.0, 0.0),
        help="x and y of its centre in the object's plane, in mm (default 0 0)",
    )
    _add_run(parser)
    return parser


def replay_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr replay`; options of live runs alone have the values that a recording needs."""
    parser = Parser(
        prog="edge-sr replay",
        usage="edge-sr replay FILE... [options]",
        description="Computes the patterns of a recording.",
        epilog=REPLAY_HELP,
    )
    recording = parser.add_argument_group("recording")
    add = recording.add_argument
    file_help = "recording, .mcap, .npz, .csv or a rosbag2 folder; of several sensors a file each, also as FILE,FILE"
    add("file", metavar="FILE", nargs="+", help=file_help)
    zeroing = recording.add_mutually_exclusive_group()
    baseline_help = "readings of the free pad, from edge-sr baseline, instead of the recorded ones"
    zeroing.add_argument("--baseline", metavar="FILE", type=Path, help=baseline_help)
    zero_help = "take the first 100 scans during which the pad is free and still as its baseline"
    zeroing.add_argument("--zero", action="store_true", help=zero_help)
    paced_help = "play at the original speed, with current times; so does --view with a --sink"
    add("--paced", action="store_true", help=paced_help)
    sensor_help = "sensor file of edge-sr doctor, instead of the recorded order and axes"
    add("--sensor", metavar="FILE", type=Path, help=sensor_help)
    rate_help = "scans a second, if the file does not state it or with --paced"
    add("--rate-hz", metavar="R", type=positive, help=rate_help)
    add("--duration-s", metavar="T", type=positive, help="stop after T seconds of the recording")
    parser.add_argument_group("model").add_argument("--model", metavar="M", help=_MODEL_HELP)
    outputs = parser.add_argument_group("outputs").add_argument
    outputs("--sink", metavar="S", action="append", default=[], help=SINK_HELP)
    outputs("--fields", metavar="F", help=_FIELDS_HELP)
    _add_view(parser)
    _add_results(parser)
    parser.set_defaults(source=[], id_map=None, give_up_s=None, realtime=False, poses=[])
    return parser


def convert_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr convert`."""
    parser = Parser(
        prog="edge-sr convert",
        usage="edge-sr convert FILE NEW",
        description="Writes a recording in another format: that of the ending of the new name.",
        epilog=CONVERT_HELP,
    )
    add = parser.add_argument_group("recording").add_argument
    add("recording", metavar="FILE", help="recording, .mcap, .npz, .csv or a rosbag2 folder")
    add("new", metavar="NEW", help="new file, .mcap, .npz or .csv")
    add("--rate-hz", metavar="R", type=positive, help="scans a second of a .csv that does not state it")
    return parser


def understood(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the options of a run, and check all that can be checked before anything is opened.

    Raises:
        UsageError: a sink or a field does not exist, a sink occurs twice, or thresholds are out of range.
    """
    options = parser.parse_args(arguments)
    for text in options.sink:
        check_sink(text)
    check_apart(options.sink)
    if options.fields is not None:
        from edge.sinks.json_encoding import chosen_fields

        chosen_fields(options.fields)
        if not any(text.startswith("jsonl:") for text in options.sink):
            raise UsageError("--fields requires a sink of JSON records, such as --sink jsonl:-")
    for text in options.poses:
        from edge.pose_sources.open_poses import check_poses

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
    add = add_source(parser)
    add(
        "--baseline",
        metavar="FILE",
        type=Path,
        help="readings of the free pad, from edge-sr baseline (default: measure them at the start)",
    )
    add(
        "--give-up-s",
        metavar="T",
        type=not_negative,
        help="end when the source has been lost for T seconds; 0: at once (default: never)",
    )
    poses_help = (
        "positions of the pad, which a robot sends: zenoh[:KEY] or ros2:TOPIC; for one of several sensors "
        "SENSOR=P; repeat it for several"
    )
    add("--poses", metavar="P", action="append", default=[], help=poses_help)
    _add_model(parser)
    _add_outputs(parser)
    _add_view(parser)
    _add_results(parser)
    _add_processor(parser)


def _add_model(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("model").add_argument
    add("--model", metavar="M", help=_MODEL_HELP)


def _add_outputs(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("outputs").add_argument
    add("--sink", metavar="S", action="append", default=[], help=SINK_HELP)
    add("--fields", metavar="F", help=_FIELDS_HELP)
    add("--duration-s", metavar="T", type=positive, help="stop after T seconds")


def _add_results(parser: argparse.ArgumentParser) -> None:
    """Add the options of making results from scans, whatever their source."""
    contact = parser.add_argument_group(
        "contact", "A tap is one press, from touch to release. Counts are the units of raw readings."
    ).add_argument
    contact(
        "--contact-on-counts",
        metavar="N",
        type=positive,
        default=DEFAULTS.contact_on_counts,
        help="a tap begins when the z readings, summed over the pad, reach N counts; some 1150 counts are 1 N "
        f"(default {DEFAULTS.contact_on_counts:g})",
    )
    contact(
        "--contact-off-counts",
        metavar="N",
        type=positive,
        default=DEFAULTS.contact_off_counts,
        help=f"a tap ends when they fall below N (default {DEFAULTS.contact_off_counts:g})",
    )
    contact(
        "--counts-per-newton",
        metavar="C",
        type=counts_per_newton,
        help="summed z readings for one newton, which gives forces in N; edge-sr doctor --weight-g measures it",
    )
    contact(
        "--idle-reset-s",
        metavar="T",
        type=positive,
        default=DEFAULTS.idle_reset_s,
        help=f"forget earlier taps after T seconds without contact (default {DEFAULTS.idle_reset_s:g})",
    )
    contact(
        "--taps",
        metavar="K",
        type=whole(1),
        help="combine at most K taps to a pattern (default: as many as the model takes; 1 if it takes poses of the pad "
        "and there are none)",
    )
    checks = parser.add_argument_group("checks of patterns and sensor").add_argument
    learn_help = "do not learn from contacts how sensitive each taxel is"
    checks("--no-learn", dest="learn", action="store_false", help=learn_help)
    checks("--every-scan", action="store_true", help="compute a pattern even if the readings have not changed")


def _add_processor(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("processor").add_argument
    realtime_help = "run before other processes, on a processor of its own and in locked memory, as far as permitted"
    add("--realtime", action="store_true", help=realtime_help)


def _add_view(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("live page").add_argument
    add(
        "--view",
        metavar="PORT",
        nargs="?",
        type=port,
        const=VIEW_PORT,
        help=f"serve a page for a browser at this port (default {VIEW_PORT}; 0: any free one)",
    )
    add("--view-host", metavar="H", help="address of the page, for other computers (default 127.0.0.1: this one only)")
    add("--view-token", metavar="T", help="password in the page's address (default: generated and printed)")
    record_help = "folder for recordings begun on the page (default: the current one)"
    add("--view-record-dir", metavar="DIR", type=Path, help=record_help)


def baseline_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr baseline`."""
    from firmware_bridge.zeroing.free_stretch import FEWEST_RECORDED

    parser = Parser(
        prog="edge-sr baseline",
        usage="edge-sr baseline --out FILE",
        description="Measures the free pad once, and stores its readings: the baseline, which is subtracted from each "
        "scan.",
        epilog=BASELINE_HELP,
    )
    add_source(parser)
    add = parser.add_argument_group("baseline").add_argument
    add("--out", metavar="FILE", type=Path, required=True, help="file for the baseline")
    scans_help = f"scans to average (default and minimum {FEWEST_SCANS}; of a recording at least {FEWEST_RECORDED})"
    add("--scans", metavar="N", type=whole(FEWEST_RECORDED), help=scans_help)
    add("--skip", metavar="N", type=whole(0), help="scans to leave out at the start (default 0)")
    return parser


def devices_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr devices`."""
    parser = Parser(
        prog="edge-sr devices",
        description="Lists serial ports, CAN adapters and CAN interfaces, what to type after --source for each, and "
        "what prevents its use.",
        epilog="Exit code: 3 if there is no adapter.",
    )
    parser.add_argument("--json", action="store_true", help="write JSON, for programs")
    return parser


def models_parser() -> argparse.ArgumentParser:
    """Return the parser of `edge-sr models`."""
    parser = Parser(prog="edge-sr models", description="Lists the bundled models, with their error.")
    parser.add_argument("--measure", action="store_true", help="measure the run time of each here, 1.5 s a model")
    return parser
