"""`edge-sr`: taxel scans in, super-resolved patterns out."""

import contextlib
import errno
import importlib
import os
import sys
from collections.abc import Sequence
from typing import Final

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
from edge.cli.run_help import TABLE, parsed_options
from edge.cli.standard_streams import guarded_streams, open_closed_streams
from edge.terminal.argument_types import EXIT_USAGE

COMMANDS: Final = (*filter(None, TABLE),)
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


if __name__ == "__main__":
    sys.exit(main())
