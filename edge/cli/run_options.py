"""Options of `edge-sr` and its commands, in groups; those of the bench, which is in another wheel, are with it."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from edge.cli.run_help import HELP
from edge.errors import UsageError
from edge.inference.bundled import DEFAULT_MODEL, POSED_MODEL
from edge.perception.contact_options import DEFAULTS, RuntimeOptions
from edge.sinks.registry import check_apart, check_sink
from edge.terminal.argument_types import Parser, counts_per_newton, not_negative, port, positive, whole
from firmware_bridge.scans.can_id_maps import ID_MAPS, USPA44_MAP
from firmware_bridge.zeroing.baseline import FEWEST_SCANS

_VIEW_PORT: Final = 8077
_DRIFT_S: Final = 60.0
_Adder = Callable[..., argparse.Action]


def parser(command: str = "") -> argparse.ArgumentParser:
    """Return the parser of a command, or of `edge-sr` without one."""
    name, texts = f"edge-sr {command}".rstrip(), HELP[command]
    made = Parser(prog=name, usage=f"{name} {texts.usage}", description=texts.about, epilog=texts.more)
    _OPTIONS[command](made)
    return made


def understood(command: str, arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the options of a command, and check of a run all that can be checked before anything is opened."""
    options = parser(command).parse_args(arguments)
    if "sink" not in options:
        return options
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
    """Return the flags of the runtime, each by its own name; options without a flag keep their defaults."""
    given = vars(options)
    return RuntimeOptions(**{name: given[name] for name in asdict(DEFAULTS) if name in given})


def _run(parser: Parser) -> None:
    add = _sensor(parser)
    baseline_help = "readings of the free pad, from edge-sr baseline (default: measure them at the start)"
    add("--baseline", metavar="FILE", type=Path, help=baseline_help)
    give_up_help = "end when the source has been lost for T seconds; 0: at once (default: never)"
    add("--give-up-s", metavar="T", type=not_negative, help=give_up_help)
    poses_help = (
        "positions of the pad, which a robot sends: zenoh[:KEY] or ros2:TOPIC; for one of several sensors "
        "SENSOR=P; repeat it for several"
    )
    add("--poses", metavar="P", action="append", default=[], help=poses_help)
    _results(parser)
    _processor(parser)


def _demo(parser: Parser) -> None:
    add = parser.add_argument_group("sensor").add_argument
    add("--rate-hz", metavar="R", type=positive, help="scans a second (default 100)")
    _results(parser)
    _processor(parser)
    parser.set_defaults(sensor=None, id_map=None, force=False, baseline=None, poses=[], give_up_s=None)


def _record(parser: Parser) -> None:
    parser.add_argument_group("file").add_argument("file", metavar="FILE", help="new file, .mcap")
    _run(parser)


def _map(parser: Parser) -> None:
    from edge.mapping.object_map import PX_PER_MM, SIZE_MM

    add = parser.add_argument_group("map").add_argument
    out_help = "file for the layers of the map (default map.npz)"
    add("--out", metavar="FILE", type=Path, default=Path("map.npz"), help=out_help)
    add("--png", metavar="FILE", type=Path, help="file for a picture of contact and height")
    size_help = f"length of its sides in mm (default {SIZE_MM:g})"
    add("--size-mm", metavar="L", type=positive, default=SIZE_MM, help=size_help)
    pixels_help = f"pixels of the map per mm (default {PX_PER_MM:g})"
    add("--px-per-mm", metavar="N", type=positive, default=PX_PER_MM, help=pixels_help)
    centre_help = "x and y of its centre in the object's plane, in mm (default 0 0)"
    add("--centre-mm", metavar=("X", "Y"), type=float, nargs=2, default=(0.0, 0.0), help=centre_help)
    _run(parser)


def _replay(parser: Parser) -> None:
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
    _results(parser)
    parser.set_defaults(source=[], id_map=None, give_up_s=None, realtime=False, poses=[])


def _convert(parser: Parser) -> None:
    add = parser.add_argument_group("recording").add_argument
    add("recording", metavar="FILE", help="recording, .mcap, .npz, .csv or a rosbag2 folder")
    add("new", metavar="NEW", help="new file, .mcap, .npz or .csv")
    add("--rate-hz", metavar="R", type=positive, help="scans a second of a .csv that does not state it")


def _models(parser: Parser) -> None:
    parser.add_argument("--measure", action="store_true", help="measure the run time of each here, 1.5 s a model")


def _baseline(parser: Parser) -> None:
    from firmware_bridge.zeroing.free_stretch import FEWEST_RECORDED

    _sensor(parser)
    add = parser.add_argument_group("baseline").add_argument
    add("--out", metavar="FILE", type=Path, required=True, help="file for the baseline")
    scans_help = f"scans to average (default and minimum {FEWEST_SCANS}; of a recording at least {FEWEST_RECORDED})"
    add("--scans", metavar="N", type=whole(FEWEST_RECORDED), help=scans_help)
    add("--skip", metavar="N", type=whole(0), help="scans to leave out at the start (default 0)")


def _devices(parser: Parser) -> None:
    parser.add_argument("--json", action="store_true", help="write JSON, for programs")


def _doctor(parser: Parser) -> None:
    add = _sensor(parser)
    add("--baseline", metavar="FILE", type=Path, help="earlier readings of the free pad, to detect a load on it")
    add = parser.add_argument_group("what is measured").add_argument
    drift_help = f"seconds to measure the free, still pad (default {_DRIFT_S:g})"
    add("--drift-s", metavar="T", type=positive, default=_DRIFT_S, help=drift_help)
    add("--no-press", action="store_true", help="skip the presses on the corners")
    weight_help = "weight in grams to lay on the pad, which gives forces in newtons"
    add("--weight-g", metavar="G", type=positive, help=weight_help)
    add = parser.add_argument_group("results").add_argument
    add("--out", metavar="FILE", type=Path, help="write the results into a sensor file")
    add("--json", action="store_true", help="write one JSON document to stdout")
    forget_help = "remove what the sensor of this name learned from contacts from the file of --sensor, and end"
    add("--forget-gains", metavar="SENSOR", help=forget_help)


_OPTIONS: Final[dict[str, Callable[[Parser], None]]] = {
    "": _run,
    "demo": _demo,
    "record": _record,
    "replay": _replay,
    "convert": _convert,
    "map": _map,
    "models": _models,
    "baseline": _baseline,
    "devices": _devices,
    "doctor": _doctor,
}


def _sensor(parser: Parser) -> _Adder:
    """Add the options of every command that reads a sensor; returns the function that adds more to their group."""
    add = parser.add_argument_group("sensor").add_argument
    source_help = (
        "where scans come from (default: the adapter plugged in); for two fingers repeated, as NAME=SRC; "
        "edge-sr --help lists all"
    )
    add("--source", metavar="SRC", action="append", default=[], help=source_help)
    sensor_help = (
        "sensor file, which edge-sr doctor writes: how the pad is wired and mounted, and its readings when free; other "
        "options override it"
    )
    add("--sensor", metavar="FILE", type=Path, help=sensor_help)
    map_help = (
        f"kind of pad: which CAN message is which taxel: {', '.join(ID_MAPS)}; A and B are boards before 2021 "
        f"(default {USPA44_MAP.name})"
    )
    add("--id-map", metavar="MAP", choices=ID_MAPS, help=map_help)
    rate_help = "scans a second at which a recording is played; for a device, its expected rate"
    add("--rate-hz", metavar="R", type=positive, help=rate_help)
    force_help = "use a sensor file of an emulated sensor on a real one all the same"
    add("--force", action="store_true", help=force_help)
    return add


def _results(parser: Parser) -> None:
    """Add the options of making results from scans, whatever their source, and of where they go."""
    add = parser.add_argument_group("model").add_argument
    model_help = (
        "bundled model, of those that edge-sr models lists, or model file (default "
        f"{DEFAULT_MODEL}; where poses of the pad come, as in the demo, {POSED_MODEL})"
    )
    add("--model", metavar="M", help=model_help)
    add = parser.add_argument_group("outputs").add_argument
    sink_help = "output for results, such as jsonl:-; repeat it for several; edge-sr --help lists all"
    add("--sink", metavar="S", action="append", default=[], help=sink_help)
    fields_help = "fields of JSON records, such as force_n,pattern, in addition to those of every record (default: all)"
    add("--fields", metavar="F", help=fields_help)
    add("--duration-s", metavar="T", type=positive, help="stop after T seconds, of a recording after T of its own")
    add = parser.add_argument_group("live page").add_argument
    view_help = f"serve a page for a browser at this port (default {_VIEW_PORT}; 0: any free one)"
    add("--view", metavar="PORT", nargs="?", type=port, const=_VIEW_PORT, help=view_help)
    add("--view-host", metavar="H", help="address of the page, for other computers (default 127.0.0.1: this one only)")
    add("--view-token", metavar="T", help="password in the page's address (default: generated and printed)")
    record_help = "folder for recordings begun on the page (default: the current one)"
    add("--view-record-dir", metavar="DIR", type=Path, help=record_help)
    add = parser.add_argument_group(
        "contact", "A tap is one press, from touch to release. Counts are the units of raw readings."
    ).add_argument
    on, off, idle_s = DEFAULTS.contact_on_counts, DEFAULTS.contact_off_counts, DEFAULTS.idle_reset_s
    on_help = (
        "a tap begins when the z readings, summed over the pad, reach N counts; some 1150 counts are 1 N "
        f"(default {on:g})"
    )
    add("--contact-on-counts", metavar="N", type=positive, default=on, help=on_help)
    off_help = f"a tap ends when they fall below N (default {off:g})"
    add("--contact-off-counts", metavar="N", type=positive, default=off, help=off_help)
    newton_help = "summed z readings for one newton, which gives forces in N; edge-sr doctor --weight-g measures it"
    add("--counts-per-newton", metavar="C", type=counts_per_newton, help=newton_help)
    idle_help = f"forget earlier taps after T seconds without contact (default {idle_s:g})"
    add("--idle-reset-s", metavar="T", type=positive, default=idle_s, help=idle_help)
    taps_help = (
        "combine at most K taps to a pattern (default: as many as the model takes; 1 if it takes poses of the pad and "
        "there are none)"
    )
    add("--taps", metavar="K", type=whole(1), help=taps_help)
    add = parser.add_argument_group("checks of patterns and sensor").add_argument
    learn_help = "do not learn from contacts how sensitive each taxel is"
    add("--no-learn", dest="learn", action="store_false", help=learn_help)
    add("--every-scan", action="store_true", help="compute a pattern even if the readings have not changed")


def _processor(parser: Parser) -> None:
    add = parser.add_argument_group("processor").add_argument
    realtime_help = "run before other processes, on a processor of its own and in locked memory, as far as permitted"
    add("--realtime", action="store_true", help=realtime_help)
