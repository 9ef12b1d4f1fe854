"""Detection of slcan text that repeats the readings before it within noise, without decoding. No I/O, no clock.

It only decides when a scan is handed on, never what it holds: what is not certainly still is handed on at once. Each
frame is compared with the one of its id that was learnt last, since frames of several sensors mix on a bus, and a read
may end within a scan. All taxels are compared at once, because after a pause of 10 ms the cost of code is that of
fetching it, and this is little.
"""

from binascii import unhexlify
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.can.slcan import PACKED_BYTES, STAMPED_BYTES

STILL_COUNTS: Final = 16
"""Change of one reading up to which it may be noise, in counts: over four standard deviations of a difference."""
_IDS: Final = 1 << 16
"""Number of values of an id with its length digit."""
_UNKNOWN: Final = -(1 << 20)
"""Reading that none is near."""
_FORMS: Final = {
    2 * size + 2: np.dtype(
        {"names": ["id", "xyz"], "formats": [">u2", (">u2", 3)], "offsets": [0, 3], "itemsize": size}
    )
    for size in (PACKED_BYTES, STAMPED_BYTES)
}
"""Places of the values in a packed frame, by the length of its line."""


class Stillness:
    """Detector of frames whose readings are within STILL_COUNTS of those learnt last."""

    def __init__(self) -> None:
        """Start without readings."""
        self._rows = np.zeros(_IDS, dtype=np.int16)
        self._lowest = np.full((1, 3), _UNKNOWN, dtype=np.int32)
        self._begun = b""

    def learn(self, data: bytes, line_bytes: int) -> None:
        """Take the readings of the whole lines in `data`, if all are usual ones, as those to compare with."""
        end = data.rfind(b"\r") + 1
        self._begun = data[end:]
        frames = _frames(data[end % line_bytes : end], line_bytes)
        if frames is None:
            return
        ids = frames["id"]
        new = np.unique(ids[self._rows[ids] == 0])
        if new.size:
            self._rows[new] = np.arange(len(self._lowest), len(self._lowest) + new.size)
            self._lowest = np.concatenate([self._lowest, np.zeros((new.size, 3), dtype=np.int32)])
        self._lowest[self._rows[ids]] = frames["xyz"].astype(np.int32) - STILL_COUNTS

    def holds(self, data: bytes, line_bytes: int) -> bool:
        """Return True if every reading is as it was, within noise, up to the last whole line, of which there is one.

        Args:
            data: bytes that follow those of the call before.
            line_bytes: length of a line, with its CR.
        """
        text = self._begun + data
        end = text.rfind(b"\r") + 1
        self._begun = text[end:]
        frames = _frames(text[:end], line_bytes) if end else None
        if frames is None:
            return False
        above = frames["xyz"] - self._lowest[self._rows[frames["id"]]]
        return bool(above.view(np.uint32).max() < 2 * STILL_COUNTS)  # one below the lowest is far above


def _frames(text: bytes, line_bytes: int) -> NDArray[Any] | None:
    """Return ids and readings of usual lines; None if these are not such lines alone."""
    digits = text.translate(None, b"t\r")
    if len(digits) * line_bytes != len(text) * (line_bytes - 2):
        return None
    try:
        return np.frombuffer(unhexlify(digits), _FORMS[line_bytes])
    except ValueError:
        return None
