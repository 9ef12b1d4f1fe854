"""One JSON record a line, flushed as it is written, since a robot reads it live."""

import errno
import os
import stat
import sys
import threading
from collections.abc import Mapping
from io import BufferedWriter
from pathlib import Path
from typing import Final

import orjson

from edge.errors import SinkClosedError, SinkError
from edge.perception.event import Event
from edge.perception.field import Columns
from edge.perception.result import Result
from edge.perception.result_fields import MAPS
from edge.pipeline.sink import Sink
from edge.sinks.json_record import event_record, record
from edge.sinks.pipe_capacity import has_room, widen

_OPTIONS: Final = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_APPEND_NEWLINE
_MAP_NAMES: Final = tuple(field.name for field in MAPS)
_MAPS: Final = Columns(field.in_record() for field in MAPS)
_ROOM_S: Final = 0.002
"""Between two looks whether a slow reader has made room; a pipe holds more than is made meanwhile."""


class JsonLinesSink(Sink):
    """Writes records into a file, or with "-" to stdout.

    Where a robot waits, a reader that is too slow for a pipe must hold up nothing: its records are left out, counted,
    and told in the first it takes again. Nor does anything wait for one that does not read once the run is to end.
    """

    def __init__(
        self, target: str, *, patient: bool = True, source: str | None = None, stop: threading.Event | None = None
    ) -> None:
        """Open the target; a file that exists is replaced.

        Args:
            target: path, or "-".
            patient: wait for a slow reader, rather than leave records out.
            source: kind of what is read, told with every event.
            stop: set when the run is to end, which ends all patience.

        Raises:
            SinkError: it cannot be opened.
        """
        self._target = "stdout" if target == "-" else target
        self._stop = threading.Event() if stop is None else stop
        self._patient = patient
        self._source = source
        self.unwritten = 0
        try:
            self._file = _open(target)
        except OSError as error:
            if error.errno == errno.ENXIO:
                raise SinkError(f"nobody reads {self._target}: start its reader first") from error
            raise SinkError(f"cannot write records to {self._target}: {error.strerror}") from error
        widen(self._file.fileno())
        self._may_be_full = not stat.S_ISREG(os.fstat(self._file.fileno()).st_mode)

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Write one record; of what sinks left out it tells its own reader's."""
        self._write(record_line(result, {**counters, "unwritten": self.unwritten}))

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Write a record of an event."""
        self._write(event_line(event, {**counters, "unwritten": self.unwritten}, self._source))

    def _write(self, line: bytes) -> None:
        while self._may_be_full and not has_room(self._file.fileno(), len(line)):
            if not self._patient or self._stop.wait(_ROOM_S):
                self.unwritten += 1
                return
        try:
            self._file.write(line)
            self._file.flush()
        except BrokenPipeError as error:
            raise SinkClosedError(f"the reader of {self._target} has gone") from error
        except OSError as error:
            raise SinkError(f"cannot write records to {self._target}: {error.strerror}") from error

    def close(self) -> None:
        """Close the file. Every record is on its way already; what an error kept back is lost and was told."""
        try:
            self._file.close()
        except OSError:
            # The writer tries its last record again, and fails again as it did in `write`.
            return


def record_line(result: Result, counters: Mapping[str, int]) -> bytes:
    """A result as one line of JSON, its maps last."""
    line = record(result, counters)
    line.update(zip(_MAP_NAMES, _MAPS.of(result), strict=True))
    return orjson.dumps(line, option=_OPTIONS)


def event_line(event: Event, counters: Mapping[str, int], source: str | None) -> bytes:
    """An event as one line of JSON."""
    return orjson.dumps(event_record(event, counters, source), option=orjson.OPT_APPEND_NEWLINE)


def _open(target: str) -> BufferedWriter:
    if target == "-":
        if sys.stdout is None:
            raise OSError(0, "it is closed")
        # A writer of our own: what is left in sys.stdout after an error would be tried again at exit.
        return os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    path = Path(target)
    if not path.is_fifo():
        return path.open("wb")
    descriptor = os.open(path, os.O_WRONLY | os.O_NONBLOCK)  # else it would wait for a reader, however long
    os.set_blocking(descriptor, True)
    return os.fdopen(descriptor, "wb")
