"""Tables of users' files, read strictly: a misspelt key must not count as a missing one."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, NoReturn

LARGEST: Final = 1e12  # largest magnitude of a number in the file; a whole number can have more digits than any float


class Table:
    """One table of a file, whose keys are taken one by one; `end` refuses any left over."""

    def __init__(self, path: Path, name: str, values: Mapping[str, Any], error: type[ValueError], remedy: str) -> None:
        """Start with all values of a table, whose name, if it has one, ends in a dot.

        Where one cannot be used, the error is raised, and a user is told the remedy.
        """
        self._path, self._name, self._error, self._remedy = path, name, error, remedy
        self._values = dict(values)
        self._taken: list[str] = []

    def part(self, key: str, values: Mapping[str, Any]) -> "Table":
        """Return a table in this one."""
        return Table(self._path, f"{self._name}{key}.", values, self._error, self._remedy)

    def take(self, key: str, read: Callable[[Any], Any], *, required: bool = True) -> Any:
        """Return the value of a key, None if an optional one is missing; errors of `read` state what it expected."""
        self._taken.append(key)
        if key not in self._values:
            return self.refuse(key, "missing", "it to be there") if required else None
        value = self._values.pop(key)
        try:
            return read(value)
        except ValueError as error:
            return self.refuse(key, _shown(value), str(error))

    def end(self) -> None:
        """Refuse keys that were not taken."""
        for key in self._values:
            self.refuse(key, "not known", f"one of {', '.join(self._taken)}")

    def refuse(self, key: str, got: str, expected: str) -> NoReturn:
        """Raise the error of a key, with its value, the expected one and the remedy."""
        raise self._error(f"{self._path}, '{self._name}{key}': {got}, expected {expected}: {self._remedy}")


def _shown(value: Any) -> str:
    try:
        text = json.dumps(value, default=str)
    except ValueError:  # a hexadecimal number can have too many digits for decimal text
        return "a number of too many digits"
    return text[:60] + "..." * (len(text) > 60)


def reader(right: Callable[[Any], bool], expected: str) -> Callable[[Any], Any]:
    """Return a reader that accepts a value that is `right`, as it is, and otherwise states what it expected."""

    def read(value: Any) -> Any:
        if not right(value):
            raise ValueError(expected)
        return value

    return read


text_value: Final = reader(
    lambda value: isinstance(value, str) and value != "" and value.isprintable(), "a text of printable characters"
)
a_table: Final = reader(lambda value: isinstance(value, dict), "a table")  # whose keys a Table of its own checks
truth: Final = reader(lambda value: isinstance(value, bool), "true or false")
whole: Final = reader(lambda value: type(value) is int and 1 <= value < 2**31, "a whole number from 1")


def one_of(*values: str | int) -> Callable[[Any], Any]:
    """Return a reader that accepts one of these values, of its type."""
    allowed = [(type(value), value) for value in values]
    return reader(lambda value: (type(value), value) in allowed, " or ".join(map(repr, values)))


def between(low: float, high: float) -> Callable[[Any], Any]:
    """Return a reader that accepts a number in this range, both ends included, in its written type.

    Not as a float: a baseline's id differs between 1000 and 1000.0.
    """
    return reader(lambda value: is_number(value, low, high), f"a number from {low:g} to {high:g}")


def cells(shape: tuple[int, ...], right: Callable[[list[Any]], bool], expected: str) -> Callable[[Any], Any]:
    """Return a reader of nested lists of this shape, whose flat cells, a tuple, have to be `right`."""

    def flat(value: Any, shape: tuple[int, ...]) -> list[Any]:
        if not isinstance(value, list) or len(value) != shape[0]:
            raise ValueError(expected)
        return value if len(shape) == 1 else [cell for part in value for cell in flat(part, shape[1:])]

    def read(value: Any) -> tuple[Any, ...]:
        flat_cells = flat(value, shape)
        if not right(flat_cells):
            raise ValueError(expected)
        return tuple(flat_cells)

    return read


def numbers(
    shape: tuple[int, ...], expected: str, low: float = -LARGEST, high: float = LARGEST
) -> Callable[[Any], tuple[float, ...]]:
    """Return a reader of nested lists of numbers in a range, both ends included."""
    read = cells(shape, lambda flat_cells: all(is_number(cell, low, high) for cell in flat_cells), expected)
    return lambda value: tuple(map(float, read(value)))


def is_number(value: Any, low: float, high: float) -> bool:
    """Return True for a number in a range, both ends included."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and low <= value <= high
