"""`edge-sr`: taxel scans in, super-resolved patterns out; on standard streams that may be closed, or full."""

import argparse
import contextlib
import errno
import importlib
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, TextIO, cast

from edge.api import (
    BaselineRefusedError,
    BridgeError,
    DeviceError,
    EdgeError,
    ModelError,
    SinkError,
    UsageError,
)
from edge.cli.option_table import COMMAND_LIST, COMMANDS, EXAMPLES, TABLE, runtime_options
from edge.sinks.registry import check_apart, check_sink
from edge.terminal.argument_types import EXIT_USAGE, Parser
from edge.terminal.stop_signals import STDERR, STDIN, STDOUT
from firmware_bridge.errors import harmless

_FIXED: Final[dict[str, dict[str, Any]]] = {
    "demo": {"source": ["demo"], "sensor": None, "id_map": None, "baseline": None, "poses": [], "give_up_s": None},
    "replay": {"source": [], "id_map": None, "give_up_s": None, "poses": []},
}
"""Options of a run that a command of its kind does not have, with the values that they have there."""
_USUAL: Final = ("--source", "--sensor", "--model", "--sink", "--view", "--duration-s")
"""Options of the short help, `edge-sr -h`."""
_EXIT_CODES: Final = {DeviceError: 3, BaselineRefusedError: 3, ModelError: 4, SinkError: 5}
"""Exit codes of errors; of all others it is that of wrong usage."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    _open_closed_streams()
    try:
        with _guarded_streams():
            return _command(sys.argv[1:] if arguments is None else arguments) or 0
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
            line = re.sub(r"\s*[\n\t]\s*", " ", str(error)).strip()  # other spaces may be of a name
            print(f"edge-sr: {line}", file=sys.stderr)
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
    if [*arguments] == ["-h"]:
        print(parser(usual=True).format_help(), end="")
        return None
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


def parser(command: str = "", *, usual: bool = False) -> argparse.ArgumentParser:
    """Return the parser of a command, or of `edge-sr` without one, with its `usual` options or all."""
    name, help_ = f"edge-sr {command}".rstrip(), TABLE[command]
    given = [word for group in help_.groups for word in group.arguments]
    usage = " ".join((name, *(given or ["[options]"]))) + ("" if command else f"\n       {name} COMMAND [options]")
    all_ = "edge-sr --help lists all options, sources, outputs and keys."
    more = "\n".join((COMMAND_LIST, EXAMPLES, all_)) if usual else help_.more
    made = Parser(prog=name, usage=usage, description=help_.about, epilog=more, add_help=bool(command))
    if not command:
        made.add_argument("-h", "--help", action="help", help="show all options; -h shows the usual ones")
    for listed in help_.groups:
        shown = [option for option in listed.options if not usual or option.name in _USUAL]
        if not shown:
            continue
        group = made if listed.title is None else made.add_argument_group(listed.title, listed.about)
        for option in shown:
            group.add_argument(option.name, **option.settings)
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


def _open_closed_streams() -> None:
    """Open placeholders for closed standard streams, or the next file, such as a port, would take their number."""
    # Writing to stdout still fails, so that results are not lost without a message; stderr discards its text.
    for number, mode in ((STDIN, os.O_RDONLY), (STDOUT, os.O_RDONLY), (STDERR, os.O_WRONLY)):
        with contextlib.suppress(OSError):
            os.fstat(number)
            continue
        os.open(os.devnull, mode)  # the lowest free number, and those below are taken
    sys.stdout = os.fdopen(STDOUT, "w", closefd=False) if sys.stdout is None else sys.stdout
    sys.stderr = os.fdopen(STDERR, "w", closefd=False) if sys.stderr is None else sys.stderr


@contextlib.contextmanager
def _guarded_streams() -> Iterator[None]:
    """Let faults of stdout raise a SinkError, unless its reader has had enough, and those of stderr end nothing."""
    streams = sys.stdout, sys.stderr
    sys.stdout = cast("TextIO", _Guarded(streams[0], _refuse_stdout))
    sys.stderr = cast("TextIO", _Guarded(streams[1], lambda error: _stand_in(streams[1], STDERR)))
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except (BrokenPipeError, SinkError) as error:
        _stand_in(sys.stdout, STDOUT)
        if isinstance(error, SinkError):
            raise
    finally:
        sys.stdout, sys.stderr = streams


def _stand_in(stream: TextIO, number: int) -> None:
    """Point a stream elsewhere, or Python tries to write the rest of it again at exit, and complains."""
    with contextlib.suppress(OSError, ValueError):  # a stand-in of a test has no number
        if stream.fileno() == number:
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)


def _refuse_stdout(error: OSError) -> None:
    if isinstance(error, BrokenPipeError):
        raise error
    raise SinkError(f"cannot write to stdout: {error.strerror}") from error


class _Guarded:
    """Stream that escapes control characters, as may be in names of files, devices and models, and handles faults."""

    def __init__(self, stream: TextIO, refuse: Callable[[OSError], None], *, escapes: bool = True) -> None:
        self._stream, self._refuse, self._escapes = stream, refuse, escapes
        self.drawn = type(self)(stream, refuse, escapes=False) if escapes else self  # for control characters of ours

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        try:
            encoding = getattr(self._stream, "encoding", None) or "utf-8"
            shown = harmless(text) if self._escapes else text
            self._stream.write(shown.encode(encoding, "backslashreplace").decode(encoding))
        except OSError as error:
            self._refuse(error)
        return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError as error:
            self._refuse(error)


if __name__ == "__main__":
    sys.exit(main())
