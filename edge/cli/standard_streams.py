"""Standard streams as a program may get them: closed, full, or with a reader that has gone."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any, TextIO, cast

from edge.errors import SinkError
from firmware_bridge.errors import harmless

STDIN, STDOUT, STDERR = 0, 1, 2


def open_closed_streams() -> None:
    """Open placeholders for closed standard streams, or the next file would take their number: a port, or the records.

    Python's messages for a closed stderr would else go to stdout, between records.
    """
    # Writing to stdout still fails, so that results are not lost without a message; stderr discards its text.
    for number, mode in ((STDIN, os.O_RDONLY), (STDOUT, os.O_RDONLY), (STDERR, os.O_WRONLY)):
        with contextlib.suppress(OSError):
            os.fstat(number)
            continue
        os.open(os.devnull, mode)  # the lowest free number, and those below are taken
    sys.stdout = os.fdopen(STDOUT, "w", closefd=False) if sys.stdout is None else sys.stdout
    sys.stderr = os.fdopen(STDERR, "w", closefd=False) if sys.stderr is None else sys.stderr


@contextlib.contextmanager
def guarded_streams() -> Iterator[None]:
    """Replace stdout by one whose faults are those of a sink, and stderr by one without, in a with statement.

    Text that nobody can read ends no run. A reader of stdout that has had enough ends the block, without a message; a
    stdout that cannot be written raises SinkError.
    """
    streams = sys.stdout, sys.stderr
    sys.stdout = cast("TextIO", _Guarded(streams[0], _refuse_stdout))
    sys.stderr = cast("TextIO", _Guarded(streams[1], lambda error: _stand_in(streams[1], STDERR)))
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        _stand_in(sys.stdout, STDOUT)
    except SinkError:
        _stand_in(sys.stdout, STDOUT)
        raise
    finally:
        sys.stdout, sys.stderr = streams


def _stand_in(stream: TextIO, number: int) -> None:
    """Point a stream elsewhere, or Python tries to write the rest of it again at exit, and complains."""
    with contextlib.suppress(OSError, ValueError):  # a stand-in of a test has no number
        if stream.fileno() == number:
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)


class _Guarded:
    """Stream that escapes control characters, and whose faults are handled; but for a reader that has gone, of stdout.

    All printed text passes here, and much of it holds names and texts of files, devices and models.

    Attributes:
        drawn: the same stream for text with control characters of our own.
    """

    def __init__(self, stream: TextIO, refuse: Callable[[OSError], None], *, escapes: bool = True) -> None:
        self._stream, self._refuse, self._escapes = stream, refuse, escapes
        self.drawn = type(self)(stream, refuse, escapes=False) if escapes else self

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


def _refuse_stdout(error: OSError) -> None:
    if isinstance(error, BrokenPipeError):
        raise error
    raise SinkError(f"cannot write to stdout: {error.strerror}") from error
