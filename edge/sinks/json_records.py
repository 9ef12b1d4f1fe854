"""Record of a result, or of an event, for every sink that writes them: as a line of JSON, and as a binary message.

A line is flushed as it is written, since a robot reads it live. docs/middleware.md has the layout of a message, as the
live page and zenoh carry it.
"""

import errno
import fcntl
import os
import select
import stat
import struct
import sys
import termios
import threading
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import asdict
from io import FileIO
from pathlib import Path
from typing import Any, Final

import numpy as np
import orjson
from numpy.typing import NDArray

from edge.errors import SinkClosedError, SinkError, UsageError
from edge.inference.contract import Contract
from edge.perception.event import Event
from edge.perception.record_fields import FIELDS, MAPS, Columns, Out
from edge.perception.result import Result
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink

ALWAYS: Final = ("time_ns", "sensor", "scan", "source", "state", "trusted", "note", "pattern_unit")
"""Fields of every record: which scan it is of, and whether a robot may act on it; `note` names old readings."""
PROGRESS: Final = frozenset(
    ("received_bytes", "transfers", "frames", "readings", "messages", "scans", "replies", "status_answers", "poses")
)
"""Counters that grow while all is well; every other one counts something that was lost, odd, or refused."""
COUNTED_NS: Final = 1_000_000_000  # time from which on a sensor's record has the counters again, in [ns]
_HEADS: Final = tuple(field for field in FIELDS if Out.RECORD in field.out)
_ALL: Final = tuple(field.name for field in (*_HEADS, *MAPS))
CONTACTS: Final = "contacts"  # separate contacts, which take as long as the pattern: in a record only if it is named
CHOICES: Final = (*_ALL, "counters", CONTACTS)
"""Names that --fields takes; counters come on their turn in every record, named or not."""


class RecordForm:
    """Choice of the fields of a record; what is not chosen is not made."""

    def __init__(self, names: Collection[str] | None = None, *, maps: bool = False) -> None:
        """Choose fields: those of `chosen_fields` beside those of ALWAYS, or all; `maps` appends maps as well."""
        wanted = _ALL if names is None else {*ALWAYS, *names}
        heads = [field for field in _HEADS if field.name in wanted]
        appended = [field for field in MAPS if maps and field.name in wanted]
        self._names = tuple(field.name for field in heads)
        self._maps = tuple(field.name for field in appended)
        self._left_out = tuple(field.name for field in heads if field.left_out)
        self._columns = Columns(field.in_record() for field in (*heads, *appended))

    def of(self, result: Result, counters: Mapping[str, int] | None = None) -> dict[str, Any]:
        """Return a result; absent is None. Counts and maps may be arrays; without counters there is no such key."""
        values = self._columns.of(result)
        fields: dict[str, Any] = dict(zip(self._names, values, strict=False))
        for name in self._left_out:
            if fields[name] is None:
                del fields[name]
        if counters is not None:
            fields["counters"] = dict(counters)
        fields.update(zip(self._maps, values[len(self._names) :], strict=True))
        return fields


class CountersInTurn:
    """Turns of a sensor's records to have the counters: one a second, and each in which one but PROGRESS changes."""

    def __init__(self) -> None:
        self._shown: dict[str, tuple[int, Mapping[str, int], int]] = {}  # when, the newest counters, and left out

    def of(self, result: Result, counters: Mapping[str, int], unwritten: int = 0) -> Mapping[str, int] | None:
        """Return the counters where it is this record's turn to have them, else None.

        `unwritten` are the records that were left out for this sink's reader alone.
        """
        scan = result.scan
        shown_ns, shown, left_out = self._shown.get(scan.sensor, (-COUNTED_NS, counters, 0))
        turn = not 0 <= scan.time_ns - shown_ns < COUNTED_NS or unwritten != left_out
        if not turn and counters is shown:
            return None
        turn = turn or _losses(counters) != _losses(shown)
        self._shown[scan.sensor] = scan.time_ns if turn else shown_ns, counters, unwritten
        return counters if turn else None


def _losses(counters: Mapping[str, int]) -> dict[str, int]:
    return {name: count for name, count in counters.items() if name not in PROGRESS}


def chosen_fields(text: str) -> frozenset[str]:
    """Return the names in `text`, separated by commas, or raise a UsageError with the nearest field, or all of them."""
    from difflib import get_close_matches

    names = frozenset(name.strip() for name in text.split(","))
    for name in sorted(names.difference(CHOICES)):
        near = get_close_matches(name, CHOICES, n=1)
        meant = f"did you mean {near[0]}?" if near else f"expected {', '.join(CHOICES)}"
        raise UsageError(f"no field {name!r}: {meant}")
    return names


record: Final = RecordForm().of  # function from a result and counters to a record without maps


def event_record(event: Event, counters: Mapping[str, int], source: str | None) -> dict[str, Any]:
    """Return an event, marked by its state "event"; `source` is the kind of the source."""
    return {
        "time_ns": event.time_ns,
        "sensor": event.sensor,
        "source": source,
        "state": "event",
        "event": event.kind,
        "note": event.text,
        "counters": dict(counters),
    }


_LENGTH: Final = struct.Struct("<I")
_FLOAT32: Final = np.dtype("<f4")


def pack(header: Mapping[str, Any], maps: Mapping[str, NDArray[np.floating]]) -> bytes:
    """Return one message of a header, of what JSON can hold and arrays, and of maps of any shape by name."""
    listed = [[name, values.shape] for name, values in maps.items()]
    text = orjson.dumps({**header, "maps": listed}, option=orjson.OPT_SERIALIZE_NUMPY)
    text += b" " * (-(_LENGTH.size + len(text)) % _FLOAT32.itemsize)
    arrays = (np.ascontiguousarray(values, dtype=_FLOAT32).tobytes() for values in maps.values())
    return b"".join((_LENGTH.pack(len(text)), text, *arrays))


PIPE_BYTES: Final = 1 << 20  # most that Linux gives to any user
_BEGINNING: Final = b'{"time_ns":'  # of every record: a recording, or a sensor file, must not become one by a slip


class JsonLinesSink(Sink):
    """Writer of records into a file, or with "-" to stdout.

    In a robot's run a slow reader must delay nothing: records that do not fit into its pipe are left out and counted,
    and its next record carries the count, as of any other counter that changes. A run that ends waits for no reader.
    """

    def __init__(
        self,
        target: str,
        contract: Contract,
        source: Source,
        *,
        stop: threading.Event | None = None,
        fields: str | None = None,
    ) -> None:
        """Open the target; the first record replaces an older file of them. A recording waits for its readers."""
        self._target = "stdout" if target == "-" else target
        self._source, self._stop, self._waits = source.kind, stop or threading.Event(), source.kind == "replay"
        names = None if fields is None else chosen_fields(fields)
        self._form = RecordForm(names, maps=True)
        self._contract = contract if CONTACTS in (names or ()) else None
        self.unwritten = 0
        self._turns = CountersInTurn()
        try:
            self._file = _open(target)
        except OSError as error:
            if error.errno == errno.ENXIO:
                raise SinkError(f"nobody reads {self._target}: start its reader first") from error
            raise SinkError(f"cannot write records to {self._target}: {error.strerror}") from error
        if _is_pipe(self._file.fileno()):
            with suppress(OSError):  # other pipes have taken the pages that a user may have
                fcntl.fcntl(self._file.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._may_be_full = not stat.S_ISREG(os.fstat(self._file.fileno()).st_mode)
        self._replaces = target != "-" and not self._may_be_full

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Write one record; its counter `unwritten` counts what was left out for this reader only."""
        counted = self._turns.of(result, counters, self.unwritten)
        fields = self._form.of(result, None if counted is None else {**counted, "unwritten": self.unwritten})
        if self._contract is not None:
            fields[CONTACTS] = _contacts(result, self._contract)
        self._write(fields)

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Write a record of an event."""
        self._write(event_record(event, {**counters, "unwritten": self.unwritten}, self._source))

    def _write(self, fields: Mapping[str, Any]) -> None:
        line = orjson.dumps(fields, option=orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_APPEND_NEWLINE)
        while self._may_be_full and not has_room(self._file.fileno(), len(line)):
            # In the pause less comes in than a pipe holds.
            if not self._waits or self._stop.wait(0.002):
                self.unwritten += 1
                return
        written = 0
        try:
            if self._replaces:  # not before: a run that does not begin must not cost the records of the one before
                self._file.truncate(0)
                self._replaces = False
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


def _contacts(result: Result, contract: Contract) -> list[dict[str, Any]]:
    """Return the separate contacts of a result, as `edge.api.patches` describes them."""
    from edge.perception.patches import patches

    return [
        {
            name: value if value is None or isinstance(value, bool) else np.round(value, 4).tolist()
            for name, value in asdict(patch).items()
        }
        for patch in patches(result, contract)
    ]


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
        file = FileIO(path, "ab+")
        if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            file.seek(0)
            if file.read(len(_BEGINNING)) not in (b"", _BEGINNING):
                raise OSError(errno.EEXIST, "it holds something else: give another name, or delete it first")
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:  # its records would go, and those of both be mixed
                raise OSError(error.errno, "another run writes to it: end that, or give another name") from error
            except OSError:  # a file system without locks
                pass
        return file
    descriptor = os.open(path, os.O_WRONLY | os.O_NONBLOCK)  # a blocking open would wait for a reader
    os.set_blocking(descriptor, True)
    return FileIO(descriptor, "wb")
