"""Faults of the bytes between adapter and reader.

Only `flipped` makes well-formed frames that were never sent, with that fate. To ensure this, noise holds no line end
but its own, and a line is cut from its end and never down to a whole frame.
"""

import random
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

from fault_frames import BusFrame, share

LINE_ENDS: Final = b"\r\a"
SHORTEST_NOISE: Final = 12
"""Least bytes of noise: shorter noise might look like an adapter's answer."""
LONGEST_NOISE: Final = 200
MOST_LEFT_BYTES: Final = 20
"""Most bytes of a line that is cut: one less than a whole frame without a time stamp."""
_NOISE_BYTES: Final = bytes(value for value in range(256) if value not in LINE_ENDS)
_READING_DIGITS: Final = range(7, 19)
"""Positions of the digits of x, y and z in a line."""


class Piece(NamedTuple):
    """Bytes for the reader.

    Attributes:
        data: bytes that go out.
        sent: the frame whose line `data` is, or a remainder of it if it is lost; None for bytes without a frame.
        answer: True for the adapter's answer to a command.
    """

    data: bytes
    sent: BusFrame | None
    answer: bool = False


class LineFault(ABC):
    """Fault on the line during an interval, which strikes a share of the lines."""

    usual_share = 0.02

    def __init__(self, draw: random.Random, parameter: str) -> None:
        """Begin the fault; `parameter` is the share as the user wrote it, empty for the usual one.

        Raises:
            ValueError: it is no share.
        """
        self.draw = draw
        self._share = share(parameter, self.usual_share)

    def take(self, piece: Piece) -> Iterator[Piece]:
        """Yield the pieces that replace a line whose frame is not lost yet."""
        sent = piece.sent
        if sent is None or sent.lost or self.draw.random() >= self._share:
            yield piece
        else:
            yield from self.strike(piece.data, sent)

    @abstractmethod
    def strike(self, line: bytes, sent: BusFrame) -> Iterator[Piece]:
        """Yield the pieces that replace the struck line."""


class Garbage(LineFault):
    """Bursts of any bytes before a line, every other one with a line end."""

    def strike(self, line: bytes, sent: BusFrame) -> Iterator[Piece]:
        """Yield a burst before the line."""
        length = self.draw.randint(SHORTEST_NOISE, LONGEST_NOISE)
        yield Piece(bytes(self.draw.choices(_NOISE_BYTES, k=length)) + self.draw.choice((b"", b"\r")), None)
        yield Piece(line, sent)


class Truncated(LineFault):
    """Lines that end too soon."""

    def strike(self, line: bytes, sent: BusFrame) -> Iterator[Piece]:
        """Cut the line."""
        yield Piece(line[: self.draw.randint(1, MOST_LEFT_BYTES)] + b"\r", sent._replace(fate="truncated"))


class Merged(LineFault):
    """Lines cut before their end, so that the next one follows at once."""

    def strike(self, line: bytes, sent: BusFrame) -> Iterator[Piece]:
        """Remove the end of the line."""
        yield Piece(line[: self.draw.randint(1, len(line) - 1)], sent._replace(fate="merged"))


class NonAscii(LineFault):
    """Lines with a byte that is no ASCII character."""

    def strike(self, line: bytes, sent: BusFrame) -> Iterator[Piece]:
        """Set the highest bit of a byte."""
        at = self.draw.randrange(len(line) - 1)
        spoilt = line[:at] + bytes([line[at] | 0x80]) + line[at + 1 :]
        yield Piece(spoilt, sent._replace(fate="non-ascii"))


class Flipped(LineFault):
    """Readings with a changed digit. The serial line has no checksum, so no reader can detect it."""

    usual_share = 0.002

    def strike(self, line: bytes, sent: BusFrame) -> Iterator[Piece]:
        """Change a digit of the reading."""
        if sent.fate == "foreign":
            yield Piece(line, sent)
            return
        at = self.draw.choice(_READING_DIGITS)
        digit = self.draw.choice([value for value in b"0123456789ABCDEF" if value != line[at]])
        line = line[:at] + bytes([digit]) + line[at + 1 :]
        frame = sent.frame._replace(data=bytes.fromhex(line[5:21].decode()))
        yield Piece(line, sent._replace(frame=frame, fate="flipped"))


LINE_FAULTS: Final[Mapping[str, Callable[[random.Random, str], LineFault]]] = MappingProxyType(
    {
        "garbage": Garbage,
        "truncated": Truncated,
        "merged": Merged,
        "non-ascii": NonAscii,
        "flipped": Flipped,
    }
)


def through(faults: Sequence[LineFault], piece: Piece) -> Iterator[Piece]:
    """Pass a piece through one fault after the other."""
    if not faults:
        yield piece
        return
    for left in faults[0].take(piece):
        yield from through(faults[1:], left)
