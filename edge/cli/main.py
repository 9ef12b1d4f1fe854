"""`edge-sr`: taxel scans in, super-resolved patterns out."""

import argparse
import contextlib
import errno
import importlib
import os
import shlex
import sys
from collections.abc import Sequence
from typing import Any, Final

from edge.api import (
    BaselineRefusedError,
    BridgeError,
    DeviceError,
    EdgeError,
    ModelError,
    SinkError,
    UsageError,
    unfinished_load,
)
from edge.cli.command_table import COMMANDS, TABLE
from edge.cli.option_tables import runtime_options
from edge.cli.standard_streams import guarded_streams, open_closed_streams
from edge.sinks.registry import check_apart, check_sink
from edge.terminal.argument_types import EXIT_USAGE, Parser

_FIXED: Final[dict[str, dict[str, Any]]] = {
    "demo": {"sensor": None, "id_map": None, "force": False, "baseline": None, "poses": [], "give_up_s": None},
    "replay": {"source": [], "id_map": None, "give_up_s": None, "poses": []},
}
"""Options of a run that a command of its kind does not have, with the values that they have there."""
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
    except (BridgeError, EdgeError, OSError) as error:
        lacking = error.__cause__ if isinstance(error, (BridgeError, EdgeError)) else error
        if isinstance(lacking, OSError) and lacking.errno in (errno.EMFILE, errno.ENFILE):
            # Anything may meet it: a thread, a link, a port that is opened, or Python as it loads a module.
            print(f"edge-sr: {os.strerror(lacking.errno)}: allow more of them, ulimit -n 256", file=sys.stderr)
            return _EXIT_CODES[SinkError]
        if not isinstance(error, (BridgeError, EdgeError)):
            raise
        with contextlib.suppress(OSError):  # the terminal may have gone
            print(f"edge-sr: {' '.join(str(error).split())}", file=sys.stderr)
        return next((code for kind, code in _EXIT_CODES.items() if isinstance(error, kind)), EXIT_USAGE)


def _command(arguments: Sequence[str]) -> int | None:
    """Do a command, or run without one; return its exit code, or None for 0."""
    named = bool(arguments) and not arguments[0].startswith("-")
    name, rest = (arguments[0], arguments[1:]) if named else ("", arguments)
    if name not in TABLE:
        from difflib import get_close_matches

        near = get_close_matches(name, COMMANDS, n=1)
        all_ = f"commands are {', '.join(COMMANDS)}; to run, give options alone"
        raise UsageError(f"no command {name!r}: {f'did you mean {near[0]}?' if near else all_}")
    options = parsed_options(name, rest)
    module, _, function = TABLE[name].does.partition(":")
    try:
        does = getattr(importlib.import_module(module), function)
    except ModuleNotFoundError as error:
        if name != "bench":
            raise
        raise UsageError(
            "edge-sr bench is in another wheel, which is not installed: install tactile-edge-sr-train as well"
        ) from error
    return does(options, sys.stdout, sys.stderr)


def parser(command: str = "") -> argparse.ArgumentParser:
    """Return the parser of a command, or of `edge-sr` without one."""
    name, help_ = f"edge-sr {command}".rstrip(), TABLE[command]
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
    options.typed = shlex.join([*f"edge-sr {command}".split(), *arguments])
    if "sink" not in options:
        return options
    for text in options.sink:
        check_sink(text)
    check_apart(options.sink)
    if options.fields is not None:
        from edge.sinks.json_records import chosen_fields

        chosen_fields(options.fields)
        if not any(text.startswith("jsonl:") for text in options.sink):
            raise UsageError("--fields requires a sink of JSON records, such as --sink jsonl:-")
    for text in options.poses:
        from edge.pose_sources import check_poses

        check_poses(text)
    runtime_options(options)
    return options


if __name__ == "__main__":
    sys.exit(main())
