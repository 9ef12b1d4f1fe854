"""Decoder and encoder of CAN frames as slcan text. No I/O.

A line ends at CR, or at BEL, an adapter's refusal. Its frame is the text from the LAST frame letter (t T r R) to the
CR: hex digits hold no such letter, so one in mid-line begins a whole frame after the remains of another, or after
noise. That text must fit its own length digit exactly, or the line gives no frame. Too few characters for eight bytes
follow a digit that was damaged into a letter, but for the length digit of a stamped line: that frame has no stamp.

An adapter stamps either every line with a time or no line. The decoder learns the form from LINES_TO_LEARN frames in a
row of one form; from then on a frame of the other form is a bad line, until as many of those come in a row. So four
data digits lost from a stamped line make no false frame without a stamp. Before a form is learnt, both are accepted.

The limit: slcan has no checksum on the serial leg. A flipped hex digit, and a loss of exactly one line's length across
two lines (the head of one frame with the tail of the next), give a well-formed frame that was never sent. Such a value
lasts for one scan.
"""

import re
from binascii import hexlify, unhexlify
from typing import Final, NamedTuple

CLOSE: Final = b"C\r"
BITRATE_1M: Final = b"S8\r"
OPEN: Final = b"O\r"
STAMPS_ON: Final = b"Z1\r"
STAMPS_OFF: Final = b"Z0\r"
STATUS_FLAGS: Final = b"F\r"  # answered by eight flags, and clears them. Source: Lawicel CAN232 manual, version 3
BUS_FLAGS: Final = 0xA0  # flags of errors on the bus, and of a controller that these have made passive

LONGEST_LINE: Final = 30  # most characters before the CR: T, 8 of id, 1 of length, 16 of data, 4 of time stamp
LAST_TIMESTAMP_MS: Final = 59_999  # where the clock starts anew each minute; some adapters count to 65,535

LINES_TO_LEARN: Final = 4  # frames in a row of one form after which it is learnt: damage does not make so many

PACKED_BYTES: Final = 10  # bytes of a usual frame packed: twelve bits of id, four of length (8), eight bytes of data
STAMPED_BYTES: Final = 12  # bytes of a usual frame packed with two bytes of time stamp, in [ms]

_STAMP = rb"[0-9A-Fa-f]{4}"
_USUAL = rb"(?:t[0-7][0-9A-Fa-f]{2}8[0-9A-Fa-f]{16}%s\r)+"
_FRAME = re.compile(rb"(?:([tr])([0-7][0-9A-Fa-f]{2})|([TR])([01][0-9A-Fa-f]{7}))([0-8])([0-9A-Fa-f]*)")
_LINE_END = re.compile(rb"[\r\a]")
_REPLY = re.compile(rb"[zZ]?|[VN][0-9A-Za-z]{4}")
_FLAGS = re.compile(rb"F[0-9A-Fa-f]{2}")


class _Form(NamedTuple):
    """Form of the lines of frames of eight bytes with a standard id, the only frames that a sensor sends."""

    lines: re.Pattern[bytes]
    line_bytes: int
    frame_bytes: int


_FORMS: Final = {
    False: _Form(re.compile(_USUAL % b""), 22, PACKED_BYTES),
    True: _Form(re.compile(_USUAL % _STAMP), 26, STAMPED_BYTES),
}


class CanFrame(NamedTuple):
    """One CAN 2.0 frame. A remote frame has no data; the length it asks for is not kept."""

    can_id: int
    data: bytes
    extended: bool = False
    remote: bool = False
    timestamp_ms: int | None = None


class PackedFrames(NamedTuple):
    """Run of usual frames, PACKED_BYTES or STAMPED_BYTES each."""

    data: bytes
    frame_bytes: int


class SlcanDecoder:
    """Decoder of a byte stream into frames. Any chunking gives the same frames and the same counters."""

    def __init__(self) -> None:
        self.flags = self.status_answers = 0  # what the adapter has answered last, and how often
        self.usual_line_bytes = _FORMS[False].line_bytes  # of a frame, with its CR; until learnt, the shorter
        self._form: _Form | None = None
        self._newest_stamped = False
        self._same_in_a_row = 0
        self._pending = b""
        self.frames = self._bad_lines = self._non_ascii_lines = 0
        self._skipped_bytes = self._replies = self._refusals = 0

    def begin_anew(self) -> None:
        """Discard an unfinished line and the learnt form: the link broke, and the next bytes belong to neither."""
        self._skipped_bytes += len(self._pending)
        self._pending = b""
        self._form, self._same_in_a_row = None, 0
        self.usual_line_bytes = _FORMS[False].line_bytes

    def cut(self, data: bytes) -> list[PackedFrames | CanFrame]:
        """Decode the frames whose last byte lies in `data`; the bytes after them wait for the next call.

        Those of the usual form are packed, run by run, once that form is learnt: sixteen cost about as much as one.
        """
        buffer = self._pending + data
        pieces: list[PackedFrames | CanFrame] = []
        position = 0
        while True:
            form = self._form
            if form and (usual := form.lines.match(buffer, position)):
                packed = unhexlify(usual[0].translate(None, b"t\r"))
                self.frames += len(packed) // form.frame_bytes
                self._same_in_a_row = 0
                pieces.append(PackedFrames(packed, form.frame_bytes))
                position = usual.end()
                if position == len(buffer):
                    break
                continue
            end = _LINE_END.search(buffer, position)
            if end is None:
                break
            frame = self._read_line(buffer[position : end.start()], refused=end[0] == b"\a")
            if frame is not None:
                self.frames += 1
                pieces.append(frame)
            position = end.end()
        # Only the last characters of an unfinished line can still become a frame, so memory is bounded.
        cut = max(position, len(buffer) - LONGEST_LINE)
        self._skipped_bytes += cut - position
        self._pending = buffer[cut:]
        return pieces

    @property
    def pending_bytes(self) -> int:
        """Number of bytes of an unfinished line."""
        return len(self._pending)

    def counters(self) -> dict[str, int]:
        """Return the counts of frames, of each other kind of line, and of bytes that belong to neither."""
        return {
            "frames": self.frames,
            "bad_lines": self._bad_lines,
            "non_ascii_lines": self._non_ascii_lines,
            "skipped_bytes": self._skipped_bytes,
            "replies": self._replies,
            "refusals": self._refusals,
            "status_answers": self.status_answers,
        }

    def _read_line(self, line: bytes, *, refused: bool) -> CanFrame | None:
        self._refusals += refused
        start = max(line.rfind(letter) for letter in (b"t", b"T", b"r", b"R"))
        # A frame ends at CR alone: a BEL means that the command before it was refused.
        if start >= 0 and not refused:
            frame = _parse_frame(line[start:])
            if frame is not None and self._takes(frame.timestamp_ms is not None):
                self._skipped_bytes += start
                return frame
        if _REPLY.fullmatch(line):
            self._replies += not refused
        elif _FLAGS.fullmatch(line):
            self.flags = int(line[1:], 16)
            self.status_answers += 1
        else:
            self._skipped_bytes += len(line)
            if line[-LONGEST_LINE:].isascii():
                self._bad_lines += 1
            else:
                self._non_ascii_lines += 1
        return None

    def _takes(self, stamped: bool) -> bool:
        """Return True if the adapter sends frames of this form, and learn the form from it."""
        self._same_in_a_row = self._same_in_a_row + 1 if stamped == self._newest_stamped else 1
        self._newest_stamped = stamped
        if self._same_in_a_row >= LINES_TO_LEARN:
            self._form = _FORMS[stamped]
            self.usual_line_bytes = self._form.line_bytes
        return self._form is None or self._form is _FORMS[stamped]


def encode_frame(frame: CanFrame) -> bytes:
    """Encode a frame as an slcan line, with its CR."""
    letter = ("tr", "TR")[frame.extended][frame.remote]
    line = f"{letter}{frame.can_id:0{8 if frame.extended else 3}X}{len(frame.data)}".encode() + hexlify(frame.data)
    if frame.timestamp_ms is not None:
        line += f"{frame.timestamp_ms:04X}".encode()
    return line[:1] + line[1:].upper() + b"\r"


def _parse_frame(text: bytes) -> CanFrame | None:
    """Parse a frame that the text must match exactly, None if it does not."""
    match = _FRAME.fullmatch(text)
    if match is None:
        return None
    remote = text[:1] in b"rR"
    digits = match[6]
    data_length = 0 if remote else 2 * int(match[5])
    stamp = digits[data_length:]
    timestamp_ms = int(stamp, 16) if len(stamp) == 4 else None
    if len(digits) < data_length or len(stamp) not in (0, 4):
        return None
    extended = match[3] is not None
    return CanFrame(int(match[4] or match[2], 16), unhexlify(digits[:data_length]), extended, remote, timestamp_ms)
