"""Record of a result, or of an event, for every sink that writes them, and binary messages of a record and its maps.

A message, as the live page and zenoh carry it, whose header's "maps" lists them: [[name, [size, ...]], ...].

    4 bytes     n, length of the header, little-endian
    n bytes     header, JSON in UTF-8, padded with spaces until 4 + n is a multiple of 4
    the rest    maps, float32 little-endian in C order, one after the other
"""

import math
import struct
from collections.abc import Collection, Mapping
from typing import Any, Final

import numpy as np
import orjson
from numpy.typing import NDArray

from edge.errors import MessageError, UsageError
from edge.perception.event import Event
from edge.perception.result import Result
from edge.perception.result_fields import FIELDS, MAPS, Columns, Out

ALWAYS: Final = ("time_ns", "sensor", "scan", "source", "state", "trusted", "note", "pattern_unit")
"""Fields of every record: which scan it is of, and whether a robot may act on it; `note` names old readings."""
PROGRESS: Final = frozenset(
    ("received_bytes", "transfers", "frames", "readings", "messages", "scans", "replies", "status_answers", "poses")
)
"""Counters that grow while all is well; every other one counts something that was lost, odd, or refused."""
COUNTED_NS: Final = 1_000_000_000  # time from which on a sensor's record has the counters again, in [ns]
_HEADS: Final = tuple(field for field in FIELDS if Out.RECORD in field.out)
_ALL: Final = tuple(field.name for field in (*_HEADS, *MAPS))


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
        self._shown: dict[str, tuple[int, dict[str, int]]] = {}

    def of(self, result: Result, counters: Mapping[str, int]) -> Mapping[str, int] | None:
        """Return the counters where it is this record's turn to have them, else None."""
        scan = result.scan
        troubles = {name: count for name, count in counters.items() if name not in PROGRESS}
        before_ns, before = self._shown.get(scan.sensor, (None, None))
        if before_ns is not None and 0 <= scan.time_ns - before_ns < COUNTED_NS and before == troubles:
            return None
        self._shown[scan.sensor] = scan.time_ns, troubles
        return counters


def chosen_fields(text: str) -> frozenset[str]:
    """Return the names in `text`, separated by commas, or raise a UsageError with the nearest field, or all of them."""
    from difflib import get_close_matches

    names = frozenset(name.strip() for name in text.split(","))
    for name in sorted(names.difference(_ALL)):
        near = get_close_matches(name, _ALL, n=1)
        meant = f"did you mean {near[0]}?" if near else f"expected {', '.join(_ALL)}"
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


def unpack(message: bytes) -> tuple[dict[str, Any], dict[str, NDArray[np.float32]]]:
    """Return header and maps, read-only views, of a message; a MessageError where the bytes are none."""
    try:
        (length,) = _LENGTH.unpack_from(message)
        header = orjson.loads(message[_LENGTH.size : _LENGTH.size + length])
        listed = [(str(name), tuple(map(int, shape))) for name, shape in header["maps"]]
    except (struct.error, ValueError, TypeError, KeyError, OverflowError) as error:
        raise MessageError(f"{len(message)} bytes are not a packed message: expected a header with its maps") from error
    position, maps = _LENGTH.size + length, {}
    for name, shape in listed:
        count = math.prod(shape)
        end = position + count * _FLOAT32.itemsize
        if min(shape, default=1) < 0 or end > len(message):
            raise MessageError(f"map {name!r} is {shape}, which is not what {len(message)} bytes hold")
        maps[name] = np.frombuffer(message, _FLOAT32, count, position).reshape(shape)
        position = end
    if position != len(message):
        raise MessageError(f"{len(message) - position} bytes after the last map, expected none")
    return header, maps
