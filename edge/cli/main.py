"""`edge-sr`: taxel scans in, super-resolved patterns out."""

import argparse
import contextlib
import errno
import importlib
import math
import os
import shlex
import signal
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final

from edge.api import (
    DEMO_LOOP,
    BaselineRefusedError,
    BridgeError,
    DeviceError,
    EdgeError,
    ModelError,
    SinkError,
    Source,
    Statistics,
    UsageError,
    open_source,
    save_baselines,
    unfinished_load,
)
from edge.cli.run_help import parsed_options
from edge.cli.standard_streams import guarded_streams, open_closed_streams
from edge.terminal.argument_types import EXIT_USAGE
from firmware_bridge.in_place import BACKUP_SUFFIX

if TYPE_CHECKING:
    from edge.api import MapSink

_EXIT_CODES: Final = {DeviceError: 3, BaselineRefusedError: 3, ModelError: 4, SinkError: 5}
"""Exit codes of errors; of all others it is that of wrong usage."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    code = _main(sys.argv[1:] if arguments is None else arguments)
    if unfinished_load():
        sys.stderr.flush()
        os._exit(code)
    return code


def _main(arguments: Sequence[str]) -> int:
    open_closed_streams()
    try:
        with guarded_streams():
            return _command(arguments) or 0
        return 0
    except KeyboardInterrupt:
        return 130  # as a shell's, until a run has begun that ends well
    except (BridgeError, EdgeError) as error:
        with contextlib.suppress(OSError):  # the terminal may have gone
            print(f"edge-sr: {' '.join(str(error).split())}", file=sys.stderr)
        return next((code for kind, code in _EXIT_CODES.items() if isinstance(error, kind)), EXIT_USAGE)
    except OSError as error:
        if error.errno not in (errno.EMFILE, errno.ENFILE):
            raise
        # Anything may meet it: a thread, a link, or Python as it loads a module.
        print(f"edge-sr: {error.strerror}: allow more of them, ulimit -n 256", file=sys.stderr)
        return _EXIT_CODES[SinkError]


def _command(arguments: Sequence[str]) -> int | None:
    """Do a command, or run without one; return its exit code, or None for 0."""
    named = bool(arguments) and not arguments[0].startswith("-")
    name, rest = (arguments[0], arguments[1:]) if named else ("", arguments)
    if name == "bench":
        return _bench(rest)
    if named and name not in COMMANDS:
        from difflib import get_close_matches

        near = get_close_matches(name, COMMANDS, n=1)
        meant = (
            f"did you mean {near[0]}?" if near else f"commands are {', '.join(COMMANDS)}; to run, give options alone"
        )
        raise UsageError(f"no command {name!r}: {meant}")
    return _ACTIONS[name](parsed_options(name, rest))


def _follow(
    options: argparse.Namespace, statistics: Statistics | None = None, mapping: "MapSink | None" = None
) -> None:
    if options.source == ["demo"] and options.view is not None and not set(options.sink) - {"status"}:
        options.source = [DEMO_LOOP]  # a person may look at a page for long; a sink gets one round
    source = _open_source(options, math.inf if options.give_up_s is None else options.give_up_s)
    from edge.cli.run_command import run

    run(options, source, statistics, mapping)


def _demo(options: argparse.Namespace) -> None:
    options.source = ["demo"]
    _follow(options)


def _map(options: argparse.Namespace) -> None:
    from edge.cli.run_command import new_map

    with new_map(options) as mapping:
        _follow(options, mapping=mapping)


def _record(options: argparse.Namespace) -> None:
    from edge.cli.run_command import new_recording

    with new_recording(options) as statistics:
        _follow(options, statistics)


def _replay(options: argparse.Namespace) -> None:
    from edge.cli.run_command import run
    from edge.pipeline.replay_setup import Player, open_recording

    # A person looks for as long as he likes; a sink gets each result once.
    player = Player() if options.view is not None and not set(options.sink) - {"status"} else None
    paced = options.paced or options.view is not None
    source = open_recording(
        *options.file,
        sensor=options.sensor,
        zero=options.zero or options.baseline is not None,
        paced=paced,
        rate_hz=options.rate_hz,
        bar=not paced and "status" not in options.sink,
        player=player,
    )
    run(options, source, player=player)


def _baseline(options: argparse.Namespace) -> None:
    from edge.api import take_baselines
    from edge.terminal.stop_signals import stop_on_signals

    replaced = options.out.exists()
    if len(options.source) == 1 and options.source[0].startswith("replay:") and options.skip is options.scans is None:
        from edge.pipeline.replay_setup import recorded_baselines, sensor_settings

        kind, known = "replay", sensor_settings(options.sensor, options.id_map)
        baselines, notes = recorded_baselines(options.source[0].removeprefix("replay:"), known, options.rate_hz)
        print("\n".join(notes), file=sys.stderr)
    else:
        with stop_on_signals() as stop, _open_source(options, give_up_s=0) as source:
            kind, known = source.kind, source.sensor_file
            asked = {name: value for name in ("scans", "skip") if (value := getattr(options, name)) is not None}
            baselines = take_baselines(source, **asked, stop=stop)
    save_baselines(options.out, baselines.values(), known.orders)
    for name, baseline in sorted(baselines.items()):
        emulated = "" if kind == "device" else f" ({kind.upper()})"
        print(f"sensor {name}: baseline {baseline.id} of {baseline.scans} scans{emulated} -> {options.out}")
    if replaced:
        print(f"the former file is now {options.out}{BACKUP_SUFFIX}")


def _bench(arguments: Sequence[str]) -> int:
    try:
        import edge.bench  # noqa: F401
    except ModuleNotFoundError as error:
        raise UsageError(
            "edge-sr bench is in another wheel, which is not installed: install tactile-edge-sr-train as well"
        ) from error

    options = parsed_options("bench", arguments)
    from edge.bench.command import run

    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # Ctrl-C ends its child processes with it
    return run(options, shlex.join(["edge-sr", "bench", *arguments]), sys.stdout, sys.stderr)


def _apart(module: str, function: str = "run") -> Callable[[argparse.Namespace], int | None]:
    """Return the command that a module of its own runs, which is loaded when it is used."""
    return lambda options: getattr(importlib.import_module(module), function)(options, sys.stdout, sys.stderr)


_ACTIONS: Final[dict[str, Callable[[argparse.Namespace], int | None]]] = {
    "": _follow,
    "demo": _demo,
    "record": _record,
    "replay": _replay,
    "convert": _apart("edge.cli.convert_command"),
    "map": _map,
    "models": _apart("edge.cli.listings", "show_models"),
    "baseline": _baseline,
    "devices": _apart("edge.cli.listings", "show_devices"),
    "doctor": _apart("edge.doctor.command"),
}
COMMANDS: Final = (*filter(None, _ACTIONS), "bench")


def _open_source(options: argparse.Namespace, give_up_s: float) -> Source:
    return open_source(
        *options.source,
        sensor=options.sensor,
        id_map=options.id_map,
        rate_hz=options.rate_hz,
        give_up_s=give_up_s,
        force=options.force,
    )


if __name__ == "__main__":
    sys.exit(main())
