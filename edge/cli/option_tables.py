"""Options of `edge-sr` and its commands, one row each."""

import argparse
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from edge.inference.bundled import DEFAULT_MODEL, POSED_MODEL
from edge.perception.contact_options import DEFAULTS, RuntimeOptions
from edge.terminal.argument_types import not_negative, port, positive, whole
from firmware_bridge.scans.can_id_maps import ID_MAPS, USPA44_MAP
from firmware_bridge.scans.pad_constants import PAD_RANGES

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
SENSOR: Final = (
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
    *SENSOR,
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
RUN: Final = (_READ, *RESULTS)
# fmt: on


def runtime_options(options: argparse.Namespace) -> RuntimeOptions:
    """Return the flags of the runtime, each by its own name; options without a flag keep their defaults."""
    given = vars(options)
    return RuntimeOptions(**{name: given[name] for name in asdict(DEFAULTS) if name in given})
