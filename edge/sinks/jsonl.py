"""One JSON record a line, flushed as it is written, since a robot reads it live."""

import errno
import fcntl
import os
import select
import stat
import struct
import sys
import termios
from collections.abc import Mapping
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import Final

import orjson

from edge.errors import SinkClosedError, SinkError
from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink, SinkOptions
from edge.sinks.json_encoding import CountersInTurn, RecordForm, chosen_fields, event_record

PIPE_BYTES: Final = 1 << 20  # most that Linux gives to any user
_ALL: Final = RecordForm(maps=True)


class JsonLinesSink(Sink):
    """Writer of records into a file, or with "-" to stdout.

    In a robot's run a slow reader must delay nothing: records that do not fit into its pipe are left out and counted,
    and its next record carries the count, as of any other counter that changes. A run that ends waits for no reader.
    """

    def __init__(self, target: str, source: Source, options: SinkOptions) -> None:
        """Open the target; a file that exists is replaced. Readers of a recording's records are waited for."""
        self._target = "stdout" if target == "-" else target
        self._source, self._stop, self._waits = source.kind, options.stop, source.kind == "replay"
        fields = options.fields
        self._form = _ALL if fields is None else RecordForm(chosen_fields(fields), maps=True)
        self.unwritten = 0
        self._turns = CountersInTurn()
        try:
            self._file = _open(target)
        except OSError as error:
            if error.errno == errno.ENXIO:
                raise SinkError(f"nobody reads {self._target}: start its reader first") from error
            raise SinkError(f"cannot write records to {self._target}: {error.strerror}") from error
        _widen(self._file.fileno())
        self._may_be_full = not stat.S_ISREG(os.fstat(self._file.fileno()).st_mode)

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Write one record; its counter `unwritten` counts what was left out for this reader only."""
        counters = {**counters, "unwritten": self.unwritten}
        self._write(record_line(result, self._turns.of(result, counters), self._form))

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Write a record of an event."""
        fields = event_record(event, {**counters, "unwritten": self.unwritten}, self._source)
        self._write(orjson.dumps(fields, option=orjson.OPT_APPEND_NEWLINE))

    def _write(self, line: bytes) -> None:
        while self._may_be_full and not has_room(self._file.fileno(), len(line)):
            # In the pause less comes in than a pipe holds.
            if not self._waits or self._stop.wait(0.002):
                self.unwritten += 1
                return
        written = 0
        try:
            while written < len(line):  # a disk that fills takes a part of it, and refuses the rest
                written += self._file.write(line[written:])
        except BrokenPipeError as error:
            raise SinkClosedError(f"the reader of {self._target} has gone") from error
        except OSError as error:
            if not self._may_be_full:
                whole_bytes = os.lseek(self._file.fileno(), -written, os.SEEK_CUR)
                os.ftruncate(self._file.fileno(), whole_bytes)
            raise SinkError(f"cannot write records to {self._target}: {error.strerror}") from error

    def close(self) -> None:
        """Close the file. Every record is on its way already."""
        with suppress(OSError):
            self._file.close()


def record_line(result: Result, counters: Mapping[str, int] | None, form: RecordForm = _ALL) -> bytes:
    """Return a result as one line of JSON, its maps last."""
    return orjson.dumps(form.of(result, counters), option=orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_APPEND_NEWLINE)


def has_room(descriptor: int, wanted_bytes: int) -> bool:
    """Return True if so many bytes can be written without waiting. A pipe whose reader has gone has room."""
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    events = poll.poll(0)
    if not events or events[0][1] & (select.POLLERR | select.POLLNVAL) or not _is_pipe(descriptor):
        return bool(events)
    waiting_bytes = struct.unpack("i", fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4)))[0]
    if waiting_bytes == 0:
        return True  # the pipe may be too small for a record, and a reader that has taken everything is not slow
    # A pipe holds pages of 4 KiB, and a record may begin a new page, so up to half of their room stays empty.
    return 2 * waiting_bytes + wanted_bytes + 8192 <= fcntl.fcntl(descriptor, fcntl.F_GETPIPE_SZ)


def _widen(descriptor: int) -> None:
    """Enlarge a pipe to PIPE_BYTES if that is allowed; anything else stays as it is."""
    if _is_pipe(descriptor):
        with suppress(OSError):  # other pipes have taken the pages that a user may have
            fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, PIPE_BYTES)


def _is_pipe(descriptor: int) -> bool:
    return stat.S_ISFIFO(os.fstat(descriptor).st_mode)


def _open(target: str) -> FileIO:
    if target == "-":
        if sys.stdout is None:
            raise OSError(0, "it is closed")
        # A writer of our own: Python would try again at exit to write what an error leaves in sys.stdout.
        return FileIO(os.dup(sys.stdout.fileno()), "wb")
    path = Path(target)
    if not path.is_fifo():
        return FileIO(path, "wb")
    descriptor = os.open(path, os.O_WRONLY | os.O_NONBLOCK)  # a blocking open would wait for a reader
    os.set_blocking(descriptor, True)
    return FileIO(descriptor, "wb")
