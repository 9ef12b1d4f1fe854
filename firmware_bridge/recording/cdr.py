"""Encoding of ROS 2 messages by the text of their own definition, so that the two cannot differ. No I/O.

CDR version 1, little-endian: a header of four bytes, then each field at a multiple of its size; texts and sequences
begin with their length, which is checked against the bytes that are there.
"""

import re
import struct
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from firmware_bridge.errors import CdrError

LAST_STAMP_NS: Final = (1 << 31) * 1_000_000_000  # latest time of ROS 2, in [ns] since 1970 (in 2038)
HEADER: Final = b"\x00\x01\x00\x00"
_NUMBERS: Final = {"bool": "?", "byte": "B", "float32": "f", "float64": "d"} | {
    f"{sign}int{bits}": code.upper() if sign else code
    for sign in ("", "u")
    for bits, code in ((8, "b"), (16, "h"), (32, "i"), (64, "q"))
}
_LENGTH: Final = struct.Struct("<I")
_FIELD = re.compile(r"([A-Za-z][A-Za-z0-9_/]*)(\[([0-9]*)\])? +([a-z][a-z0-9_]*)")
_RULE: Final = "=" * 80


class Field(NamedTuple):
    """One field: a number, a text, or a message."""

    name: str
    kind: str  # such as "uint8", "string" or "std_msgs/Header"
    number: struct.Struct | None = None  # encoding of a number, else None
    dtype: np.dtype[Any] | None = None  # type of the numbers in an array, else None
    length: int | None = None  # length of an array, 0 if it is variable; None for a single value
    message: "MessageType | None" = None  # type of a message, or of those in a sequence, else None


class MessageType:
    """Type of a message: its name, such as "std_msgs/msg/Header", its fields, and its encoding as bytes."""

    def __init__(self, name: str, text: str, *parts: "MessageType") -> None:
        """Read the text of a .msg file, or raise a ValueError, as for defaults; `parts` are the messages in it."""
        self.name = name
        self._text = text.strip()
        self._parts = tuple(dict.fromkeys(nested for part in parts for nested in (part, *part._parts)))
        messages = {part.name.replace("/msg/", "/"): part for part in parts}
        lines = (line.partition("#")[0].strip() for line in text.splitlines())
        self.fields = tuple(_field(line, messages) for line in lines if line)

    @classmethod
    def of(cls, name: str, definition: str) -> "MessageType":
        """Return the type of a message by its whole definition, as `definition` gives it; errors as for its text."""
        text, *sections = definition.split(f"\n{_RULE}\nMSG: ")
        parts: list[MessageType] = []
        for section in reversed(sections):  # each comes before its own parts
            part, _, body = section.partition("\n")
            parts.append(cls(part, body, *parts))
        return cls(name, text, *parts)

    @property
    def definition(self) -> str:
        """Its text, followed by those of the messages in it, the format of MCAP for the encoding "ros2msg"."""
        parts = (f"\n{_RULE}\nMSG: {part.name.replace('/msg/', '/')}\n{part._text}" for part in self._parts)
        return self._text + "".join(parts) + "\n"

    def encode(self, values: Mapping[str, Any]) -> bytes:
        """Encode a message from the values of its fields; arrays of numbers may be of any shape."""
        out = bytearray()
        self._write(out, values)
        return HEADER + out

    def decode(self, data: bytes) -> dict[str, Any]:
        """Decode the fields of a message, or raise a CdrError; arrays of numbers are flat and read-only."""
        if bytes(data[: len(HEADER)]) != HEADER:
            raise CdrError(f"a {self.name} begins with {bytes(data[:4]).hex()}, expected {HEADER.hex()}")
        body = memoryview(data)[len(HEADER) :]
        try:
            values, _ = self._read(body, 0)
        except (struct.error, ValueError) as error:
            raise CdrError(f"{len(data)} bytes are not a whole {self.name}: {error}") from error
        return values

    def _write(self, out: bytearray, values: Mapping[str, Any]) -> None:
        for name, _, number, dtype, count, message in self.fields:
            value = values[name]
            if message is not None:
                if count is not None:
                    out += bytes(-len(out) % 4) + _LENGTH.pack(len(value))
                for part in (value,) if count is None else value:
                    message._write(out, part)
            elif number is None:
                text = value.encode() + b"\0"
                out += bytes(-len(out) % 4) + _LENGTH.pack(len(text)) + text
            elif count is None:
                out += bytes(-len(out) % number.size) + number.pack(value)
            else:
                array = np.asarray(value, dtype)
                if count == 0:
                    out += bytes(-len(out) % 4) + _LENGTH.pack(array.size)
                elif array.size != count:
                    raise ValueError(f"{name} has {array.size} numbers, expected {count}")
                if array.size:  # an empty sequence has no padding after its length
                    out += bytes(-len(out) % number.size) + array.tobytes()

    def _read(self, body: memoryview, at: int) -> tuple[dict[str, Any], int]:
        values: dict[str, Any] = {}
        for name, _, number, dtype, count, message in self.fields:
            length = 1 if count is None else count
            if count == 0 or (number is None and message is None):
                at += -at % 4
                (length,) = _LENGTH.unpack_from(body, at)
                at += 4
            if message is not None:
                read: list[dict[str, Any]] = []
                for _ in range(length):
                    part, at = message._read(body, at)
                    read.append(part)
                values[name] = read[0] if count is None else read
            elif number is None:
                if not 0 < length <= len(body) - at:
                    raise ValueError(f"{name} has {length} bytes, {len(body) - at} are there")
                values[name] = str(body[at : at + length - 1], "utf-8")
                at += length
            else:
                if length:
                    at += -at % number.size
                if count is None:
                    (values[name],) = number.unpack_from(body, at)
                else:  # frombuffer refuses to read beyond the end
                    values[name] = np.frombuffer(body, dtype, length, at) if length else np.empty(0, dtype)
                at += length * number.size
        return values, at


def _field(line: str, messages: Mapping[str, MessageType]) -> Field:
    match = _FIELD.fullmatch(line)
    if match is None:
        raise ValueError(f"{line!r} is not a field of a message")
    kind, array, length, name = match.groups()
    count = None if array is None else int(length or 0)
    if kind in messages and not count:
        return Field(name, kind, length=count, message=messages[kind])
    if kind == "string" and count is None:
        return Field(name, kind)
    if kind in _NUMBERS:
        number = struct.Struct("<" + _NUMBERS[kind])
        return Field(name, kind, number, np.dtype(number.format), count)
    raise ValueError(f"{line!r}: {kind} is not a supported kind")


TIME: Final = MessageType("builtin_interfaces/msg/Time", "int32 sec\nuint32 nanosec")
STD_HEADER: Final = MessageType("std_msgs/msg/Header", "builtin_interfaces/Time stamp\nstring frame_id", TIME)


def stamp(unix_ns: int) -> dict[str, int]:
    """Convert a time in [ns] since 1970 to the fields of TIME."""
    sec, nanosec = divmod(unix_ns, 1_000_000_000)
    return {"sec": sec, "nanosec": nanosec}
