"""Help of `edge-sr` and its commands, their parsers, and the options of a run as they were typed."""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Final, NamedTuple

from edge.cli import option_tables as of
from edge.cli.option_tables import Group
from edge.errors import UsageError
from edge.perception.contact_options import DEFAULTS, RuntimeOptions
from edge.sinks.registry import FORMS, check_apart, check_sink
from edge.terminal.argument_types import Parser


class Help(NamedTuple):
    """Help of a command: what follows its name, what it does, its options, and what stands below them."""

    usage: str
    about: str
    groups: tuple[Group, ...]
    more: str


_RUN: Final = """\
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

sources, SRC (found by itself if one adapter is plugged in):
slcan:/dev/ttyUSB0[@BAUD]\tserial CAN adapter, such as VScom or CANable
slcan:serial=D30BL366[@BAUD]\tthe same, by its serial number
gs_usb[:SERIAL]\tUSB CAN adapter with candleLight firmware
gs_usb:BUS-PORT\tthe one at this bus and socket, such as gs_usb:1-2.3
can:socketcan:can0\tadapter that python-can knows
xela-server:ws://HOST[:5000]\tthe vendor's server
replay:FILE[,FILE]\trecording: .mcap, .npz or .csv
demo[:loop]\temulated sensor

outputs, S:
OUTPUTS
keys on a terminal:
r\tforget earlier taps, as for a new object
z\tzero again: the pad must be free; Z even in contact

lines on stdin, where it is no terminal:
{"cmd": "reset"}\tlike key r
{"cmd": "zero"}\tlike key z; "sensor": "4" for one sensor, "force": true even in contact
{"cmd": "pose", "x_mm": 1, "y_mm": 0}\twhere the pad is

The signal SIGUSR1 is like key z.

examples:
  edge-sr devices
  edge-sr doctor --out sensor.toml
  edge-sr --sensor sensor.toml --view
  edge-sr --sink jsonl:- | your-program

Exit codes: 2 wrong usage, 3 sensor, 4 model, 5 output, 6 ended by force.
""".replace("OUTPUTS", "".join(f"{form.text}\t{form.about}\n" for form in FORMS.values()))

_BASELINE: Final = """\
Keep the pad still, with nothing touching it.

examples:
  edge-sr baseline --out zero.json
  edge-sr --baseline zero.json

Of a recording it takes the scans during which the pad is still and pressed least, or those that you name:
  edge-sr baseline --out zero.json \\
          --source replay:f.csv \\
          --skip 190 --scans 60
"""

_RECORD: Final = """\
examples:
  edge-sr record press.mcap
  edge-sr replay press.mcap --view

All other options are those of edge-sr: its --help lists sources, outputs and keys.
"""

_REPLAY: Final = """\
Computes a result for every scan, as fast as possible, with the times of the recording. It begins \
with the baseline (the readings of the free pad) that was in use at the first scan. If there is none, and the \
recording does not begin free and still, those scans are the baseline during which the pad is still and pressed least.

With --view and no --sink it is played at its own speed, from when the page is opened.

examples:
  edge-sr replay --example --view
  edge-sr replay left.csv right.csv \\
          --view
  edge-sr replay press.mcap \\
          --model mtsr4-int8 \\
          --sink mcap:again.mcap
"""

_CONVERT: Final = """\
Formats: .mcap holds all that was recorded, .npz arrays for numpy, .csv counts, times and poses of one sensor (of \
several a file each). What the new file cannot hold is printed. Nothing is computed, and no file is replaced.

examples:
  edge-sr convert press.mcap press.npz
  edge-sr convert press.mcap press.csv
  edge-sr convert old.npz old.mcap
"""

_MAP: Final = """\
Needs poses of the pad (where it is, and how it is turned) in the object's plane: lines on stdin, or those of a \
recording. x points right and y down, as in a pattern.

example:
  my_robot_poses | edge-sr map \\
          --out part.npz --png part.png

A line of poses:
  {"cmd": "pose", "x_mm": 1.5,
   "y_mm": -20, "turn_deg": 5}

All other options are those of edge-sr: its --help lists sources, outputs and keys.
"""

_DOCTOR: Final = """\
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

_BENCH: Final = """\
Run time is measured back to back, and paced: one inference a tick, as on a robot. A row takes half a minute. No other \
program should run meanwhile.

examples:
  edge-sr bench --out today
  edge-sr bench --threads 1 \\
          --only stsr mtsr

Ctrl-C ends it with exit code 130, after the rows measured so far are written.
"""

HELP: Final = {
    "": Help(
        "[options]\n       edge-sr COMMAND [options]",
        "Reads a tactile sensor and computes, for each scan (one reading of all taxels, the cells of the sensor), a "
        "pattern: a fine map of how deep an object presses into the pad, in mm.",
        of.RUN,
        _RUN,
    ),
    "demo": Help(
        "[options]",
        "Shows what edge-sr does without hardware: an emulated sensor taps a figure four times, and each pattern is "
        "compared with the simulated truth. With --view on a terminal it continues until Ctrl-C.",
        (of.DEMO, *of.RESULTS, of.PROCESSOR),
        "examples:\n  edge-sr demo\n  edge-sr demo --view\n",
    ),
    "record": Help(
        "FILE [options]",
        "Runs like edge-sr, and records scans, patterns and events.",
        (of.RECORD, *of.RUN),
        _RECORD,
    ),
    "replay": Help("FILE... [options]", "Computes the patterns of a recording.", (of.REPLAY, *of.RESULTS), _REPLAY),
    "convert": Help(
        "FILE NEW",
        "Writes a recording in another format: that of the ending of the new name.",
        (of.CONVERT,),
        _CONVERT,
    ),
    "map": Help(
        "[options]",
        "Runs like edge-sr, and fuses the patterns into a map of the object.",
        (of.MAP, *of.RUN),
        _MAP,
    ),
    "models": Help("[--measure]", "Lists the bundled models, with their error.", (of.MODELS,), ""),
    "baseline": Help(
        "--out FILE",
        "Measures the free pad once, and stores its readings: the baseline, which is subtracted from each scan.",
        of.BASELINE,
        _BASELINE,
    ),
    "devices": Help(
        "[--json]",
        "Lists serial ports, CAN adapters and CAN interfaces, what to type after --source for each, and what prevents "
        "its use.",
        (of.DEVICES,),
        "Exit code: 3 if there is no adapter.",
    ),
    "doctor": Help(
        "[options]",
        "Examines sensor and adapter, reports faults with their remedies, and measures how the pad is mounted.",
        of.DOCTOR,
        _DOCTOR,
    ),
    "bench": Help(
        "[options]",
        "Measures error against run time of the bundled models and of methods without a network.",
        (of.BENCH,),
        _BENCH,
    ),
}


_FIXED: Final[dict[str, dict[str, Any]]] = {
    "demo": {"sensor": None, "id_map": None, "force": False, "baseline": None, "poses": [], "give_up_s": None},
    "replay": {"source": [], "id_map": None, "give_up_s": None, "realtime": False, "poses": []},
}
"""Options of a run that a command of its kind does not have, with the values that they have there."""


def parser(command: str = "") -> argparse.ArgumentParser:
    """Return the parser of a command, or of `edge-sr` without one."""
    name, help_ = f"edge-sr {command}".rstrip(), HELP[command]
    made = Parser(prog=name, usage=f"{name} {help_.usage}", description=help_.about, epilog=help_.more)
    for listed in help_.groups:
        group = made if listed.title is None else made.add_argument_group(listed.title, listed.about)
        for one in listed.options:
            to = group.add_mutually_exclusive_group() if isinstance(one, tuple) else group
            for option in one if isinstance(one, tuple) else (one,):
                to.add_argument(option.name, **option.settings)
    made.set_defaults(**_FIXED.get(command, {}))
    return made


def parsed_options(command: str, arguments: Sequence[str]) -> argparse.Namespace:
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
        from edge.pose_sources import check_poses

        check_poses(text)
    runtime_options(options)
    return options


def runtime_options(options: argparse.Namespace) -> RuntimeOptions:
    """Return the flags of the runtime, each by its own name; options without a flag keep their defaults."""
    given = vars(options)
    return RuntimeOptions(**{name: given[name] for name in asdict(DEFAULTS) if name in given})
