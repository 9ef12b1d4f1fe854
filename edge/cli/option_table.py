"""Commands of `edge-sr`, and their options, a row each: what does a command, what it takes, and its help."""

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from edge.inference.bundled import DEFAULT_MODEL, POSED_MODEL
from edge.mapping.object_map import PX_PER_MM, SIZE_MM
from edge.perception.run_options import RuntimeOptions
from edge.sinks.registry import FORMS as SINKS
from edge.terminal.argument_types import not_negative, port, positive, whole
from firmware_bridge.links.registry import FORMS as SOURCES
from firmware_bridge.scans.can_id_maps import ID_MAPS, USPA44_MAP
from firmware_bridge.scans.pad_constants import PAD_RANGES

_SETTINGS: Final[dict[Any, Any]] = {bool: {"action": "store_true"}, list: {"action": "append", "default": []}}
"""Settings of argparse for an option without a value, and for one that may be repeated."""


class Option:
    """One option or argument, in the form of the help, such as "--rate-hz R"; `kind` makes its value of a text."""

    def __init__(self, form: str, kind: Callable[[str], Any], text: str, **more: Any) -> None:
        self.name, *values = form.split(" ")
        shown: dict[str, Any] = {"metavar": values[0] if len(values) == 1 else tuple(values)} if values else {}
        self.settings: dict[str, Any] = _SETTINGS.get(kind, {"type": kind}) | shown | {"help": text} | more


def _runtime(name: str, kind: Callable[[str], Any], **more: Any) -> Option:
    """Return the row of an option of the runtime."""
    field = RuntimeOptions.__dataclass_fields__[name]
    return Option(field.metadata["form"], kind, field.metadata["text"], default=field.default, **more)


class Group:
    """Options under a title of the help, or under that of --help."""

    def __init__(self, title: str | None, *options: Option, about: str | None = None) -> None:
        self.title, self.options, self.about = title, options, about
        named = (option for option in options if not option.name.startswith("-"))
        self.arguments = [argument.settings["metavar"] + "..." * ("nargs" in argument.settings) for argument in named]


# fmt: off
SENSOR: Final = (
    Option("--source SRC", list, "where scans come from (default: the adapter plugged in); for two fingers repeated, "
           "as NAME=SRC; edge-sr --help lists all"),
    Option("--sensor FILE", Path, "sensor file, which edge-sr doctor writes: how the pad is wired and mounted, and its "
           "readings when free; other options override it"),
    Option("--id-map MAP", str, "kind of pad: which CAN message is which taxel: %(choices)s; A and B are boards before "
           f"2021 (default {USPA44_MAP.name})", choices=ID_MAPS),
    Option("--rate-hz R", positive, "scans a second at which a recording is played; for a device, its expected rate"),
)
RESULTS: Final = (
    Group("model",
        Option("--model M", str, "bundled model, of those that edge-sr models lists, or model file (default "
               f"{DEFAULT_MODEL}; where poses of the pad come, as in the demo, {POSED_MODEL})"),
    ),
    Group("outputs",
        Option("--sink S", list, "output for results, such as jsonl:-; repeat it for several; edge-sr --help lists "
               "all"),
        Option("--fields F", str, "fields of JSON records, such as force_n,pattern, in addition to those of every "
               "record (default: all)"),
        Option("--duration-s T", positive, "stop after T seconds, of a recording after T of its own"),
    ),
    Group("live page",
        Option("--view PORT", port, "serve a page for a browser at this port (default %(const)s; 0: any free one)",
               nargs="?", const=8077),
        Option("--view-host H", str, "address of the page, for other computers (default 127.0.0.1: this one only)"),
        Option("--view-token T", str, "password in the page's address (default: generated and printed)"),
    ),
    Group("contact",
        _runtime("contact_on_counts", positive),
        _runtime("contact_off_counts", positive),
        Option("--counts-per-newton C", lambda text: positive(text, *PAD_RANGES["counts_per_newton"]),
               "summed z readings for one newton, which gives forces in N; edge-sr doctor measures it by a weight"),
        _runtime("idle_reset_s", positive),
        _runtime("taps", whole(1)),
        about="A tap is one press, from touch to release. Counts are the units of raw readings.",
    ),
    Group("checks of patterns and sensor",
        _runtime("learn", bool, dest="learn", action="store_false"),
        _runtime("every_scan", bool),
    ),
)
RUN: Final = (
    Group("sensor",
        *SENSOR,
        Option("--baseline FILE", Path, "readings of the free pad, from edge-sr baseline (default: measure them at the "
               "start)"),
        Option("--give-up-s T", not_negative, "end when the source has been lost for T seconds; 0: at once "
               "(default: never)"),
        Option("--poses P", list, "positions of the pad, which a robot sends: ros2:TOPIC; for one of several "
               "sensors SENSOR=P; repeat it for several"),
    ),
    *RESULTS,
)


class Subcommand(NamedTuple):
    """Command: what does it, and its help: what it does, its options, and what is below them."""

    does: str  # module and function, loaded when it is used
    about: str
    groups: tuple[Group, ...]
    more: str = ""


def _lines(forms: Mapping[str, str]) -> str:
    return "".join(f"{form}\t{meaning}\n" for form, meaning in forms.items())


COMMAND_LIST: Final = """\
commands (each has its own --help):
demo\tan emulated sensor; no hardware needed
devices\tlist what is plugged in, and what to type to read it
doctor\tfind faults of sensor and adapter, and how the pad is mounted
record FILE\trun, and record into a file
replay FILE\tcompute the patterns of a recording
convert FILE NEW\twrite a recording in another format
map\tfuse the patterns into a map of an object larger than the pad
baseline\tmeasure the free pad once, and store it
models\tlist the bundled models
bench\tmeasure error and run time on this machine
"""
EXAMPLES: Final = """\
examples:
  edge-sr devices
  edge-sr doctor --out sensor.toml
  edge-sr --sensor sensor.toml --view
  edge-sr --sink jsonl:- | your-program
"""

_AS_EDGE_SR: Final = "All other options are those of edge-sr: its --help lists sources, outputs and keys.\n"

TABLE: Final = {
    "": Subcommand(
        "edge.cli.run_command:follow",
        "Reads a tactile sensor and computes, for each scan (one reading of all taxels, the cells of the sensor), a "
        "pattern: a fine map of how deep an object presses into the pad, in mm.",
        RUN,
        f"""\
{COMMAND_LIST}
sources, SRC (found by itself if one adapter is plugged in):
{_lines(SOURCES)}
outputs, S:
{_lines({form.text: form.about for form in SINKS.values()})}
keys on a terminal:
r\tforget earlier taps, as for a new object
z\tzero again: the pad must be free; Z even in contact

lines on stdin, where it is no terminal:
{{"cmd": "reset"}}\tlike key r
{{"cmd": "zero"}}\tlike key z; "sensor": "4" for one sensor, "force": true even in contact
{{"cmd": "pose", "x_mm": 1, "y_mm": 0}}\twhere the pad is

The signal SIGUSR1 is like key z.

{EXAMPLES}
Exit codes: 2 wrong usage, 3 sensor, 4 model, 5 output, 137 ended by force.
""",
    ),
    "demo": Subcommand(
        "edge.cli.run_command:follow",
        "Shows what edge-sr does without hardware: an emulated sensor taps a figure four times, and each pattern is "
        "compared with the simulated truth. With --view on a terminal it continues until Ctrl-C.",
        (Group("sensor", Option("--rate-hz R", positive, "scans a second (default 100)")), *RESULTS),
    ),
    "record": Subcommand(
        "edge.cli.run_command:record",
        "Runs like edge-sr, and records scans, patterns and events.",
        (Group("file", Option("file FILE", str, "new file, .mcap")), *RUN),
        _AS_EDGE_SR,
    ),
    "replay": Subcommand(
        "edge.cli.run_command:replay",
        "Computes the patterns of a recording.",
        (Group("recording",
            Option("file FILE", str, "recording, .mcap, .npz or .csv; of several sensors a file each, also as "
                   "FILE,FILE", nargs="*"),
            Option("--example", bool, "play what is bundled: two emulated fingers grip a pen and a nut"),
            Option("--baseline FILE", Path, "readings of the free pad, from edge-sr baseline (default: recorded)"),
            Option("--paced", bool, "play at the original speed, with current times; so does --view with a --sink"),
            Option("--sensor FILE", Path, "sensor file of edge-sr doctor, instead of the recorded order and axes"),
            Option("--rate-hz R", positive, "scans a second, if the file does not state it or with --paced"),
        ), *RESULTS),
        """\
Computes a result for every scan, as fast as possible, with the times of the recording. It begins \
with the baseline (the readings of the free pad) that was in use at the first scan. If there is none, and the \
recording does not begin free and still, those scans are the baseline during which the pad is still and pressed least.

With --view and no --sink it is played at its own speed, from when the page is opened.
""",
    ),
    "convert": Subcommand(
        "edge.cli.convert_command:run",
        "Writes an .mcap in another format: that of the ending of the new name.",
        (Group("recording",
            Option("recording FILE", str, "recording, .mcap"),
            Option("new NEW", str, "new file, .npz or .csv"),
        ),),
        """\
Formats: .npz holds arrays for numpy, .csv counts, times and poses of one sensor (of several a file each). What the \
new file cannot hold is printed. Nothing is computed, and no file is replaced.
""",
    ),
    "map": Subcommand(
        "edge.cli.run_command:map_object",
        "Runs like edge-sr, and fuses the patterns into a map of the object.",
        (Group("map",
            Option("--out FILE", Path, "file for the map's layers (default %(default)s)", default=Path("map.npz")),
            Option("--size-mm L", positive, "length of its sides in mm (default %(default)g)", default=SIZE_MM),
            Option("--px-per-mm N", positive, "pixels of the map per mm (default %(default)g)", default=PX_PER_MM),
            Option("--centre-mm X Y", float, "x and y of its centre in the object's plane, in mm (default 0 0)",
                   nargs=2, default=(0.0, 0.0)),
        ), *RUN),
        f"""\
Needs poses of the pad (where it is, and how it is turned) in the object's plane: lines on stdin, or those of a \
recording. x points right and y down, as in a pattern. A line of poses:
  {{"cmd": "pose", "x_mm": 1.5,
   "y_mm": -20, "turn_deg": 5}}

{_AS_EDGE_SR}""",
    ),
    "models": Subcommand(
        "edge.cli.listings:show_models",
        "Lists the bundled models, with their error.",
        (Group(None, Option("--measure", bool, "measure the run time of each here, 1.5 s a model")),),
    ),
    "baseline": Subcommand(
        "edge.cli.run_command:baseline",
        "Measures the free pad once, and stores its readings: the baseline, which is subtracted from each scan.",
        (Group("sensor", *SENSOR),
         Group("baseline", Option("--out FILE", Path, "file for the baseline", required=True))),
        "Keep the pad still, with nothing touching it. Of a recording it takes the scans in which the pad is still and "
        "pressed least.",
    ),
    "devices": Subcommand(
        "edge.cli.listings:show_devices",
        "Lists serial ports, CAN adapters and CAN interfaces, what to type after --source for each, and what prevents "
        "its use.",
        (),
        "Exit code: 3 if there is no adapter.",
    ),
    "doctor": Subcommand(
        "edge.doctor.command:run",
        "Examines sensor and adapter, reports faults with their remedies, and measures how the pad is mounted.",
        (Group("sensor", *SENSOR,
            Option("--baseline FILE", Path, "earlier readings of the free pad, to detect a load on it"),
        ), Group("what is measured",
            Option("--drift-s T", positive, "seconds to measure the free pad (default %(default)g)", default=60),
            Option("--no-press", bool, "skip the presses on the corners"),
            Option("--rehearse", bool, "on an emulated pad that does what is asked: no sensor is needed"),
        ), Group("results",
            Option("--out FILE", Path, "write the results into a sensor file"),
            Option("--json", bool, "write one JSON document to stdout"),
            Option("--forget-gains SENSOR", str, "remove its learned gains from the file of --sensor, and end"),
        )),
        """\
Keep the pad still, with nothing touching it, until you are asked to press its corners. Hold it in the \
orientation in which patterns are to be drawn: it defines top and left.

examples:
  edge-sr doctor --rehearse
  edge-sr doctor
  edge-sr doctor --out sensor.toml
  edge-sr --sensor sensor.toml

Enter skips a request. Ctrl-C ends the doctor: what is measured until then is printed, and written with --out once the \
free pad is measured.

Exit codes: 0 no fault, 1 a fault, or a request that was not fulfilled, 2 wrong usage, 3 sensor, 130 Ctrl-C.
""",
    ),
    "bench": Subcommand(
        "edge.bench.command:run",
        "Measures error against run time of the bundled models and of methods without a network.",
        (Group(None,
            Option("--out DIR", Path, "folder for bench.csv and bench.md"),
            Option("--ticks N", whole(10), "paced ticks a row (default 3000)", default=3000),
            Option("--models DIR", Path, "folder of your own models, measured as well"),
            Option("--only NAME", str, "measure only these methods", nargs="+"),
        ),),
        """\
Run time is measured back to back, and paced: one inference a tick, at 100 Hz, as on a robot. A row takes half a \
minute. No other program should run meanwhile.

Ctrl-C ends it with exit code 130, after the rows measured so far are written.
""",
    ),
}
# fmt: on
COMMANDS: Final = (*filter(None, TABLE),)


def runtime_options(options: argparse.Namespace) -> RuntimeOptions:
    """Return the flags of the runtime, each by its own name; options without a flag keep their defaults."""
    given = vars(options)
    return RuntimeOptions(**{name: given[name] for name in RuntimeOptions.__dataclass_fields__ if name in given})
