"""Record of a result, or of an event: one dictionary for every sink that writes them."""

from collections.abc import Mapping
from typing import Any, Final

from edge.perception.event import Event
from edge.perception.field import Columns, Out
from edge.perception.result import Result
from edge.perception.result_fields import FIELDS

_FIELDS: Final = tuple(field for field in FIELDS if Out.RECORD in field.out)
_NAMES: Final = tuple(field.name for field in _FIELDS)
_COLUMNS: Final = Columns(field.in_record() for field in _FIELDS)
_LEFT_OUT: Final = tuple(field.name for field in _FIELDS if field.left_out)


def record(result: Result, counters: Mapping[str, int]) -> dict[str, Any]:
    """Return a result without its maps; absent is None, masks have bit i for taxel i. Counts may be an array."""
    fields: dict[str, Any] = dict(zip(_NAMES, _COLUMNS.of(result), strict=True))
    for name in _LEFT_OUT:
        if fields[name] is None:
            del fields[name]
    fields["counters"] = dict(counters)
    return fields


def event_record(event: Event, counters: Mapping[str, int], source: str | None) -> dict[str, Any]:
    """Return an event, marked by its state "event"; `source` is the kind of the source."""
    return {
        "time_ns": event.time_ns,
        "sensor": event.sensor,
        "source": source,
        "state": "event",
        "event": event.kind,
        "note": encodable(event.text),
        "counters": dict(counters),
    }


def encodable(text: str) -> str:
    """Replace characters that UTF-8 cannot hold: the name of a file may be any bytes, and JSON is UTF-8."""
    return text.encode(errors="replace").decode()
