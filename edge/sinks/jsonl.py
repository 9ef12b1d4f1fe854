"""One JSON record a line, flushed as it is written, since a robot reads it live."""

import errno
import os
import stat
import sys
import threading
from collections.abc import Collection, Mapping
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import Final

import orjson

from edge.errors import SinkClosedError, SinkError
from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.sink import Sink
from edge.sinks.json_encoding import CountersInTurn, RecordForm, event_record
from edge.sinks.pipe_capacity import has_room, widen

_OPTIONS: Final = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_APPEND_NEWLINE
_ALL: Final = RecordForm(maps=True)
_ROOM_S: Final = 0.002
"""Pause between two checks for room in a slow reader's pipe, in [s]; a pipe holds more than comes in meanwhile."""


class JsonLinesSink(Sink):
    """Writer of records into a file, or with "-" to stdout.

    In a robot's run a slow reader must delay nothing: records that do not fit into its pipe are left out and counted,
    and its next record carries the count, as of any other counter that changes. A run that ends waits for no reader.
    """

    def __init__(
        self,
        target: str,
        *,
        lossless: bool = True,
        source: str | None = None,
        stop: threading.Event | None = None,
        fields: Collection[str] | None = None,
    ) -> None:
        """Open the target; a file that exists is replaced.

        Args:
            target: path, or "-".
            lossless: wait for a slow reader, rather than leave records out.
            source: kind of the source, written with every event.
            stop: set when the run is to end, which ends all patience.
            fields: those of the records, as `chosen_fields` returns them; None for all.

        Raises:
            SinkError: the target cannot be opened.
        """
        self._target = "stdout" if target == "-" else target
        self._stop = threading.Event() if stop is None else stop
        self._lossless = lossless
        self._form = _ALL if fields is None else RecordForm(fields, maps=True)
        self._source = source
        self.unwritten = 0
        self._turns = CountersInTurn()
        try:
            self._file = _open(target)
        except OSError as error:
            if error.errno == errno.ENXIO:
                raise SinkError(f"nobody reads {self._target}: start its reader first") from error
            raise SinkError(f"cannot write records to {self._target}: {error.strerror}") from error
        widen(self._file.fileno())
        self._may_be_full = not stat.S_ISREG(os.fstat(self._file.fileno()).st_mode)

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Write one record; its counter `unwritten` counts what was left out for this reader only."""
        counters = {**counters, "unwritten": self.unwritten}
        self._write(record_line(result, self._turns.of(result, counters), self._form))

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Write a record of an event."""
        self._write(event_line(event, {**counters, "unwritten": self.unwritten}, self._source))

    def _write(self, line: bytes) -> None:
        while self._may_be_full and not has_room(self._file.fileno(), len(line)):
            if not self._lossless or self._stop.wait(_ROOM_S):
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
    return orjson.dumps(form.of(result, counters), option=_OPTIONS)


def event_line(event: Event, counters: Mapping[str, int], source: str | None) -> bytes:
    """Return an event as one line of JSON."""
    return orjson.dumps(event_record(event, counters, source), option=orjson.OPT_APPEND_NEWLINE)


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
