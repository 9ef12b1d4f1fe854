"""slcan text to CAN frames and back. No I/O.

A line ends at CR (or at BEL, an adapter's refusal). Within a line the frame is the text from the
LAST frame letter (t T r R) to the CR: hex digits hold no such letter, so a letter in mid-line is
the start of a whole frame behind the wreck of another, or of noise. That text must fit its own
length digit exactly, or nothing is given.

What a prefix can do: nothing to the frame behind it, which is checked as if it stood alone. A data
digit corrupted INTO a letter starts a false frame, but too few characters follow it for eight data
bytes; only the length digit of a line with a time stamp (which we never ask for) leaves enough.

The limit: slcan has no checksum on the serial leg. A flipped hex digit, a loss of exactly one
line's length across two lines (the head of one frame with the tail of the next), and in a line with
a time stamp the loss of four data digits, all give a well-formed frame that was never sent. Nobody
can tell from the text. Such a value lives for one scan.
"""

import re
import struct
from binascii import hexlify, unhexlify
from typing import Final, NamedTuple

CLOSE: Final = b"C\r"
BITRATE_1M: Final = b"S8\r"
OPEN: Final = b"O\r"

LONGEST_LINE: Final = 30
"""Characters before the CR: T, 8 of id, 1 of length, 16 of data, 4 of time stamp."""
LAST_TIMESTAMP_MS: Final = 59_999

USUAL_LINE_BYTES: Final = 22
"""A standard frame of eight bytes without a time stamp, with its CR: what a sensor sends."""
PACKED_BYTES: Final = 10
"""Such a frame packed: twelve bits of id, four of length (8), eight bytes of data."""

_USUAL_LINES = re.compile(rb"(?:t[0-7][0-9A-Fa-f]{2}8[0-9A-Fa-f]{16}\r)+")
_FRAME = re.compile(rb"(?:([tr])([0-7][0-9A-Fa-f]{2})|([TR])([01][0-9A-Fa-f]{7}))([0-8])([0-9A-Fa-f]*)")
_LINE_END = re.compile(rb"[\r\a]")
_REPLY = re.compile(rb"[zZ]?|[VN][0-9A-Za-z]{4}|F[0-9A-Fa-f]{2}")
_unpack_frames = struct.Struct(">H8s").iter_unpack
_STATUS = re.compile(rb"s[awpb][0-9]{6}|e[1-9][abBcfoOs]{1,9}")


class CanFrame(NamedTuple):
    """One CAN 2.0 frame. A remote frame has no data; the length it asks for is not kept."""

    can_id: int
    data: bytes
    extended: bool = False
    remote: bool = False
    timestamp_ms: int | None = None


class SlcanDecoder:
    """Cuts a byte stream into frames. Any chunking gives the same frames and the same counters."""

    def __init__(self) -> None:
        self._pending = b""
        self._frames = 0
        self._bad_lines = 0
        self._non_ascii_lines = 0
        self._skipped_bytes = 0
        self._replies = 0
        self._refusals = 0
        self._status_lines = 0

    @property
    def pending_bytes(self) -> int:
        """Bytes of an unfinished line."""
        return len(self._pending)

    def feed(self, data: bytes) -> list[CanFrame]:
        """Frames whose last byte lies in `data`; what comes after it waits for the next call."""
        frames: list[CanFrame] = []
        for piece in self.cut(data):
            if isinstance(piece, CanFrame):
                frames.append(piece)
            else:
                frames += [CanFrame(id_and_length >> 4, payload) for id_and_length, payload in _unpack_frames(piece)]
        return frames

    def cut(self, data: bytes) -> list[bytes | CanFrame]:
        """The same frames in their order, those of the usual form packed, PACKED_BYTES each, run by run.

        A sensor sends no other form, and a run of sixteen costs about what one frame by itself does.
        """
        buffer = self._pending + data
        pieces: list[bytes | CanFrame] = []
        position = 0
        while True:
            if usual := _USUAL_LINES.match(buffer, position):
                packed = unhexlify(usual[0].translate(None, b"t\r"))
                self._frames += len(packed) // PACKED_BYTES
                pieces.append(packed)
                position = usual.end()
                if position == len(buffer):
                    break
                continue
            end = _LINE_END.search(buffer, position)
            if end is None:
                break
            frame = self._read_line(buffer[position : end.start()], refused=end[0] == b"\a")
            if frame is not None:
                self._frames += 1
                pieces.append(frame)
            position = end.end()
        # Of an unfinished line only the last characters can still become a frame: memory is bounded.
        cut = max(position, len(buffer) - LONGEST_LINE)
        self._skipped_bytes += cut - position
        self._pending = buffer[cut:]
        return pieces

    def counters(self) -> dict[str, int]:
        """Frames, lines of each other sort, and bytes that belong to none of them."""
        return {
            "frames": self._frames,
            "bad_lines": self._bad_lines,
            "non_ascii_lines": self._non_ascii_lines,
            "skipped_bytes": self._skipped_bytes,
            "replies": self._replies,
            "refusals": self._refusals,
            "status_lines": self._status_lines,
        }

    def _read_line(self, line: bytes, *, refused: bool) -> CanFrame | None:
        self._refusals += refused
        start = max(line.rfind(letter) for letter in (b"t", b"T", b"r", b"R"))
        # A frame ends at CR alone: a BEL says that what stands before it went wrong.
        if start >= 0 and not refused:
            frame = _parse_frame(line[start:])
            if frame is not None:
                self._skipped_bytes += start
                return frame
        if _REPLY.fullmatch(line):
            self._replies += not refused
        elif _STATUS.fullmatch(line):
            self._status_lines += 1
        else:
            self._skipped_bytes += len(line)
            if line[-LONGEST_LINE:].isascii():
                self._bad_lines += 1
            else:
                self._non_ascii_lines += 1
        return None


def encode_frame(frame: CanFrame) -> bytes:
    r"""A frame as an slcan line, with its CR.

    Raises:
        ValueError: the id, the data or the time stamp does not fit a CAN 2.0 frame.
    """
    highest_id = 0x1FFFFFFF if frame.extended else 0x7FF
    if not 0 <= frame.can_id <= highest_id:
        raise ValueError(f"CAN id is {frame.can_id:#x}, expected 0..{highest_id:#x}")
    if len(frame.data) > 8 or (frame.remote and frame.data):
        raise ValueError(f"frame holds {len(frame.data)} bytes of data, expected at most 8, none in a remote frame")
    letter = ("tr", "TR")[frame.extended][frame.remote]
    line = f"{letter}{frame.can_id:0{8 if frame.extended else 3}X}{len(frame.data)}".encode() + hexlify(frame.data)
    if frame.timestamp_ms is not None:
        if not 0 <= frame.timestamp_ms <= LAST_TIMESTAMP_MS:
            raise ValueError(f"time stamp is {frame.timestamp_ms} ms, expected 0..{LAST_TIMESTAMP_MS}")
        line += f"{frame.timestamp_ms:04X}".encode()
    return line[:1] + line[1:].upper() + b"\r"


def _parse_frame(text: bytes) -> CanFrame | None:
    match = _FRAME.fullmatch(text)
    if match is None:
        return None
    remote = text[:1] in b"rR"
    digits = match[6]
    data_length = 0 if remote else 2 * int(match[5])
    stamp = digits[data_length:]
    timestamp_ms = int(stamp, 16) if len(stamp) == 4 else None
    if len(digits) < data_length or len(stamp) not in (0, 4) or (timestamp_ms or 0) > LAST_TIMESTAMP_MS:
        return None
    extended = match[3] is not None
    return CanFrame(int(match[4] or match[2], 16), unhexlify(digits[:data_length]), extended, remote, timestamp_ms)
