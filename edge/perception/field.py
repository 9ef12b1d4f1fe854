"""Description of one field of a result: its kind, and how each output writes it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Flag, auto
from functools import partial
from itertools import repeat
from operator import attrgetter, methodcaller
from typing import Any, Final, NamedTuple

from edge.perception.result import Result

Function = Callable[[Any], Any]
PLACE_IN_HEADER: Final = -1
"""Mark of a map in shared memory: its byte follows from the map's size, so the header states it."""


class Out(Flag):
    """Outputs that hold a field, in addition to shared memory, where a field has a byte.

    Attributes:
        RECORD: the JSON record, and with it zenoh, MCAP and the live page.
        NPZ: arrays that `edge-sr convert` makes of a recording.
        ROS: members of tactile_edge_sr/msg/Result.
        MAP: maps next to the record: in lines of JSON, in packed messages and as images of MCAP.
        ALL: all but maps.
    """

    RECORD = auto()
    NPZ = auto()
    ROS = auto()
    MAP = auto()
    ALL = RECORD | NPZ | ROS


@dataclass(frozen=True, slots=True)
class Kind:
    """Type of a value in each output.

    Attributes:
        label: name of the type in JSON.
        array: numpy's type, in npz.
        packed: struct's character, in shared memory.
        message: ROS's type.
        unknown: value for "unknown" in outputs without null; None where the value is always available.
        words: the values of a choice. In shared memory they are numbered from 1, so that memory that nobody wrote is
            none of them, and the order is part of the format.
        shape: name of an array's shape: "scan", "pattern", "deviation", "traction" or "poses", which has a row for each
            tap.
    """

    label: str
    array: str = ""
    packed: str = ""
    message: str = ""
    unknown: Any = None
    words: tuple[str, ...] = ()
    shape: str = ""


class Column(NamedTuple):
    """One value to read: `make` makes it of an attribute that is not None; `unknown` stands for None.

    `decimals` of a number, or of each number of a vector, are kept; None keeps all.
    """

    attribute: str
    make: Function | None
    unknown: Any
    decimals: int | None = None


class Columns:
    """Values of several fields of a result, read with one call for all plain attributes."""

    def __init__(self, columns: Iterable[Column]) -> None:
        columns = tuple(columns)
        self._get = attrgetter(*(column.attribute for column in columns))
        self._made = tuple((index, one.make) for index, one in enumerate(columns) if one.make is not None)
        # Here and not in `make`: a record rounds a dozen numbers, and a function for each costs more than the rounding.
        self._rounded = tuple((index, one.decimals) for index, one in enumerate(columns) if one.decimals is not None)
        self._unknown = tuple((index, one.unknown) for index, one in enumerate(columns) if one.unknown is not None)
        # From the last to the first, so that spreading out a vector does not move those still to come.
        self._vectors = tuple(index for index, unknown in reversed(self._unknown) if isinstance(unknown, tuple))

    def of(self, result: Result) -> list[Any]:
        """Return the values, in the order of the columns."""
        values = list(self._get(result))
        for index, make in self._made:
            if (value := values[index]) is not None:
                values[index] = make(value)
        for index, decimals in self._rounded:
            if isinstance(value := values[index], tuple):
                values[index] = list(map(round, value, repeat(decimals)))
            elif value is not None:
                values[index] = round(value, decimals)
        for index, unknown in self._unknown:
            if values[index] is None:
                values[index] = unknown
        return values

    def flat(self, result: Result) -> list[Any]:
        """Return the values with each vector replaced by its components."""
        values = self.of(result)
        for index in self._vectors:
            values[index : index + 1] = values[index]
        return values


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a result, in every output that holds it."""

    name: str  # in every output; ends with the unit if it has one
    kind: Kind  # type of the value, or of each component of a vector
    attribute: str  # dotted path from the result to the attribute that the value is made of
    text: str  # description of the value, for the pages
    make: Function | None = None  # converts the attribute into the value, unless that is None; None takes it as it is
    decimals: int | None = None  # decimals of a number in JSON
    parts: tuple[str, ...] = ()  # names of a vector's components, for outputs that hold them one by one
    json: Function | None = None  # converts the attribute into the JSON value, if `make` and `decimals` do not
    out: Out = Out.ALL  # outputs that hold it
    byte: int | None = None  # its first byte in a half of shared memory. The layout only grows at its end.
    left_out: bool = False  # a record omits the key while the value is unknown

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the components, or the field's own."""
        return self.parts or (self.name,)

    def in_record(self) -> Column:
        """Return the column of the JSON record, in which null stands for an unknown value."""
        if self.json is not None:
            return Column(self.attribute, self.json, None)
        if self.kind.shape and self.decimals is not None:
            return Column(self.attribute, methodcaller("round", self.decimals), None)
        return Column(self.attribute, self.make, None, self.decimals)

    def in_message(self) -> Column:
        """Return the column of ROS messages; a vector is a tuple."""
        unknown = self.kind.unknown
        return Column(self.attribute, self.make, (unknown,) * len(self.parts) if self.parts else unknown)

    def in_memory(self) -> Column:
        """Return the column of shared memory, as struct packs it; a vector is a tuple."""
        kind = self.kind
        if kind.words:
            numbers = {word: number for number, word in enumerate(kind.words, 1)}
            return Column(self.attribute, _then(self.make, numbers.__getitem__), None if kind.unknown is None else 0)
        if kind.packed.endswith("s"):
            return Column(self.attribute, _then(self.make, partial(_utf8, most_bytes=int(kind.packed[:-1]))), None)
        return self.in_message()


def _then(first: Function | None, second: Function) -> Function:
    """Chain two functions; the second is never called with None."""
    return second if first is None else lambda value: None if (made := first(value)) is None else second(made)


def _utf8(text: str, most_bytes: int) -> bytes:
    """Return the beginning of a text, never half a character."""
    return text.encode()[:most_bytes].decode(errors="ignore").encode()
