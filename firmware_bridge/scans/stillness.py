"""Detection of slcan text that repeats the readings before it within noise, without decoding. No I/O, no clock.

It only decides when a scan is handed on, never what it holds: what is not certainly still is handed on at once. Each
frame is compared with the one of its id that was learnt last, since frames of several sensors mix on a bus, and a read
may end within a scan. All readings are compared at once, as parts of one integer, because after a pause of 10 ms the
cost of code is that of fetching it, and this is little.
"""

from binascii import unhexlify
from functools import lru_cache
from typing import Final

from firmware_bridge.can.slcan import PACKED_BYTES, STAMPED_BYTES

STILL_COUNTS: Final = 16
"""Change of one reading up to which it may be noise, in counts: over four standard deviations of a difference."""
_FRAME_BYTES: Final = {2 * size + 2: size for size in (PACKED_BYTES, STAMPED_BYTES)}
"""Bytes of a packed frame, by the length of its line."""
_XYZ: Final = 3
"""Place of the readings in a packed frame."""
_GROUPS: Final = ((0, 2), (1,))
"""Axes that are compared together: between two readings of a group lie 16 bits or more, into which differences may
overflow without reaching the next one."""


class Stillness:
    """Detector of frames whose readings are within STILL_COUNTS of those learnt last."""

    def __init__(self) -> None:
        """Start without readings."""
        self._learnt: dict[bytes, bytes] = {}
        self._begun = b""
        self._ids = b""
        self._groups: list[tuple[int, int, int]] = []

    def learn(self, data: bytes, line_bytes: int) -> None:
        """Take the readings of the whole lines in `data`, if all are usual ones, as those to compare with."""
        end = data.rfind(b"\r") + 1
        self._begun, self._ids = data[end:], b""
        frames = _frames(data[end % line_bytes : end], line_bytes)
        size = _FRAME_BYTES[line_bytes]
        for at in range(0, len(frames), size):
            self._learnt[frames[at : at + 2]] = frames[at : at + size]

    def holds(self, data: bytes, line_bytes: int) -> bool:
        """Return True if every reading is as it was, within noise, up to the last whole line, of which there is one.

        Args:
            data: bytes that follow those of the call before.
            line_bytes: length of a line, with its CR.
        """
        text = self._begun + data
        end = text.rfind(b"\r") + 1
        self._begun = text[end:]
        frames = _frames(text[:end], line_bytes)
        size = _FRAME_BYTES[line_bytes]
        ids = frames[::size] + frames[1::size]
        if ids != self._ids and not self._choose(ids, size):
            return False
        readings = int.from_bytes(frames)
        for mask, raised_by, beyond in self._groups:
            if ((readings & mask) + raised_by) & beyond:
                return False
        return bool(ids)

    def _choose(self, ids: bytes, size: int) -> bool:
        """Prepare the comparison with frames in this order; False if one of them is unknown or of another length."""
        count = len(ids) // 2
        learnt = [self._learnt.get(bytes(pair), b"") for pair in zip(ids[:count], ids[count:], strict=True)]
        if any(len(frame) != size for frame in learnt):
            return False
        before, self._ids = int.from_bytes(b"".join(learnt)), ids
        groups = _groups(size, count)
        self._groups = [(mask, raised_by - (before & mask), beyond) for mask, raised_by, beyond in groups]
        return True


@lru_cache(maxsize=256)
def _groups(size: int, count: int) -> list[tuple[int, int, int]]:
    """Return, for so many frames of a size, of each group: its readings' bits, STILL_COUNTS in each, and other bits."""
    groups: list[tuple[int, int, int]] = []
    for axes in _GROUPS:
        lowest_bits = sum(1 << 8 * (size - _XYZ - 2 * axis - 2) for axis in axes)
        lowest_bits *= sum(1 << 8 * size * frame for frame in range(count))
        groups.append((0xFFFF * lowest_bits, STILL_COUNTS * lowest_bits, ~((2 * STILL_COUNTS - 1) * lowest_bits)))
    return groups


def _frames(text: bytes, line_bytes: int) -> bytes:
    """Return the usual lines in `text`, packed; nothing if it holds any other."""
    digits = text.translate(None, b"t\r")
    if len(text) % line_bytes or len(digits) * line_bytes != len(text) * (line_bytes - 2):
        return b""
    try:
        return unhexlify(digits)
    except ValueError:
        return b""
