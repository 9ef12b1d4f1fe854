"""Options of `edge-sr` and its commands, one row each."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from edge.inference.bundled import DEFAULT_MODEL, POSED_MODEL
from edge.mapping.object_map import PX_PER_MM, SIZE_MM
from edge.perception.contact_options import RuntimeOptions
from edge.terminal.argument_types import not_negative, port, positive, whole
from firmware_bridge.scans.can_id_maps import ID_MAPS, USPA44_MAP
from firmware_bridge.scans.pad_constants import PAD_RANGES
from firmware_bridge.zeroing.baseline import FEWEST_SCANS
from firmware_bridge.zeroing.free_stretch import FEWEST_RECORDED

_SETTINGS: Final[dict[Any, dict[str, Any]]] = {
    bool: {"action": "store_true"},
    list: {"action": "append", "default": []},
}
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
    """Options under a title of the help, or under that of --help; of those in a tuple only one may be given."""

    def __init__(self, title: str | None, *options: Option | tuple[Option, ...], about: str | None = None) -> None:
        self.title, self.options, self.about = title, options, about


# fmt: off
_SENSOR: Final = (
    Option("--source SRC", list, "where scans come from (default: the adapter plugged in); for two fingers repeated, "
           "as NAME=SRC; edge-sr --help lists all"),
    Option("--sensor FILE", Path, "sensor file, which edge-sr doctor writes: how the pad is wired and mounted, and its "
           "readings when free; other options override it"),
    Option("--id-map MAP", str, "kind of pad: which CAN message is which taxel: %(choices)s; A and B are boards before "
           f"2021 (default {USPA44_MAP.name})", choices=ID_MAPS),
    Option("--rate-hz R", positive, "scans a second at which a recording is played; for a device, its expected rate"),
    Option("--force", bool, "use a sensor file of an emulated sensor on a real one all the same"),
)
_READ: Final = Group("sensor",
    *_SENSOR,
    Option("--baseline FILE", Path, "readings of the free pad, from edge-sr baseline (default: measure them at the "
           "start)"),
    Option("--give-up-s T", not_negative, "end when the source has been lost for T seconds; 0: at once "
           "(default: never)"),
    Option("--poses P", list, "positions of the pad, which a robot sends: zenoh[:KEY] or ros2:TOPIC; for one of "
           "several sensors SENSOR=P; repeat it for several"),
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
               "summed z readings for one newton, which gives forces in N; edge-sr doctor --weight-g measures it"),
        _runtime("idle_reset_s", positive),
        _runtime("taps", whole(1)),
        about="A tap is one press, from touch to release. Counts are the units of raw readings.",
    ),
    Group("checks of patterns and sensor",
        _runtime("learn", bool, dest="learn", action="store_false"),
        _runtime("every_scan", bool),
    ),
)
PROCESSOR: Final = Group("processor",
    Option("--realtime", bool, "run before other processes, on a processor of its own and in locked memory, as far as "
           "permitted"),
)
RUN: Final = (_READ, *RESULTS, PROCESSOR)
DEMO: Final = Group("sensor", Option("--rate-hz R", positive, "scans a second (default 100)"))
RECORD: Final = Group("file", Option("file FILE", str, "new file, .mcap"))
REPLAY: Final = Group("recording",
    Option("file FILE", str, "recording, .mcap, .npz, .csv or a rosbag2 folder; of several sensors a file each, also "
           "as FILE,FILE", nargs="*"),
    Option("--example", bool, "play what is bundled: two emulated fingers grip a pen and a nut"),
    (Option("--baseline FILE", Path, "readings of the free pad, from edge-sr baseline, instead of the recorded ones"),
     Option("--zero", bool, "take the first 100 scans during which the pad is free and still as its baseline")),
    Option("--paced", bool, "play at the original speed, with current times; so does --view with a --sink"),
    Option("--sensor FILE", Path, "sensor file of edge-sr doctor, instead of the recorded order and axes"),
    Option("--rate-hz R", positive, "scans a second, if the file does not state it or with --paced"),
)
CONVERT: Final = Group("recording",
    Option("recording FILE", str, "recording, .mcap, .npz, .csv or a rosbag2 folder"),
    Option("new NEW", str, "new file, .mcap, .npz or .csv"),
    Option("--rate-hz R", positive, "scans a second of a .csv that does not state it"),
)
MAP: Final = Group("map",
    Option("--out FILE", Path, "file for the layers of the map (default %(default)s)", default=Path("map.npz")),
    Option("--png FILE", Path, "file for a picture of contact and height"),
    Option("--size-mm L", positive, "length of its sides in mm (default %(default)g)", default=SIZE_MM),
    Option("--px-per-mm N", positive, "pixels of the map per mm (default %(default)g)", default=PX_PER_MM),
    Option("--centre-mm X Y", float, "x and y of its centre in the object's plane, in mm (default 0 0)",
           nargs=2, default=(0.0, 0.0)),
)
MODELS: Final = Group(None, Option("--measure", bool, "measure the run time of each here, 1.5 s a model"))
BASELINE: Final = (
    Group("sensor", *_SENSOR),
    Group("baseline",
        Option("--out FILE", Path, "file for the baseline", required=True),
        Option("--scans N", whole(FEWEST_RECORDED), f"scans to average (default and minimum {FEWEST_SCANS}; of a "
               f"recording at least {FEWEST_RECORDED})"),
        Option("--skip N", whole(0), "scans to leave out at the start (default 0)"),
    ),
)
DEVICES: Final = Group(None, Option("--json", bool, "write JSON, for programs"))
DOCTOR: Final = (
    Group("sensor",
        *_SENSOR,
        Option("--baseline FILE", Path, "earlier readings of the free pad, to detect a load on it"),
    ),
    Group("what is measured",
        Option("--drift-s T", positive, "seconds to measure the free, still pad (default %(default)g)", default=60.0),
        Option("--no-press", bool, "skip the presses on the corners"),
        Option("--weight-g G", positive, "weight in grams to lay on the pad, which gives forces in newtons"),
    ),
    Group("results",
        Option("--out FILE", Path, "write the results into a sensor file"),
        Option("--json", bool, "write one JSON document to stdout"),
        Option("--forget-gains SENSOR", str, "remove what the sensor of this name learned from contacts from the file "
               "of --sensor, and end"),
    ),
)
BENCH: Final = Group(None,
    Option("--out DIR", Path, "folder for bench.csv and bench.md"),
    Option("--rate-hz R", positive, "paced ticks a second (default 100)", default=100.0),
    Option("--ticks N", whole(10), "paced ticks a row (default 3000)", default=3000),
    Option("--threads N", whole(1), "numbers of threads (default 1 2)", nargs="+", default=[1, 2]),
    Option("--models DIR", Path, "folder of your own models, measured as well"),
    Option("--only NAME", str, "measure only these methods", nargs="+"),
    Option("--system", bool, "measure the whole program only: 2 minutes with 3000 ticks"),
    Option("--sensors N", whole(1), "measure the whole program with so many sensors (default 1)"),
    Option("--against COMMIT", str, "measure the whole program in turn with that of another commit"),
)
