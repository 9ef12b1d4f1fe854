"""Fate of every frame, and the counts that its reader must have reached.

The truth parses no line: its own bookkeeping holds the ends of whole frames in the stream, and the kind of all other
bytes. So it cannot share a mistake with the decoder.
"""

import math
import struct
from collections import Counter, deque
from collections.abc import Callable
from itertools import takewhile
from typing import Final

import numpy as np
from fault_frames import READ, BusFrame
from fault_lines import LINE_ENDS, Piece

from firmware_bridge.scans.can_id_maps import USPA44_MAP

FATES: Final = (
    *READ,
    *("lost", "dead", "silent", "vanished", "bus-off"),
    *("truncated", "merged", "non-ascii"),
    *("overflow", "unread", "unheard"),
)
"""Fates of frames. The last three are no faults: no room, since the reader was too slow; not fetched when the channel
was closed; sent while no channel was open."""
ROW: Final = np.dtype(
    [
        ("handed_ns", "<i8"),
        ("written_ns", "<i8"),
        ("bus_us", "<i8"),
        ("cycle", "<u4"),
        ("can_id", "<u2"),
        ("xyz", "<u2", 3),
        ("opening", "<u2"),
        ("fate", "u1"),
    ],
    align=False,
)
"""Row of a frame in a log: monotonic times before and after it was handed on, in [ns]; time on the bus, in [us] since
the first scan; cycle and id; the reading that the reader gets; openings of the channel so far; and the number of its
fate."""
_pack = struct.Struct("<qqqIH3HHB").pack
_xyz = struct.Struct(">xHHHx").unpack
_FATE_NUMBERS: Final = {fate: number for number, fate in enumerate(FATES)}


class Truth:
    """Bookkeeping of the bytes that go to the reader.

    Attributes:
        fates: number of frames by fate.
        frames: number of frames that the reader must have received whole.
        foreign: number of these that are frames of another device.
        bad_lines: number of lines that are no frame, with or without bytes that are no characters.
        skipped_bytes: number of bytes that belong to no frame.
        duplicates: number of frames equal to that sensor's frame before.
        openings: number of openings of the channel.
        noise: number of bursts without a frame.
    """

    def __init__(self, log: Callable[[bytes], object] = lambda row: None) -> None:
        """Start without a frame; `log` receives a ROW for every frame once its fate is certain."""
        self.fates: Counter[str] = Counter()
        self.frames = 0
        self.foreign = 0
        self.bad_lines = 0
        self.skipped_bytes = 0
        self.duplicates = 0
        self.openings = 0
        self.noise = 0
        self._log = log
        self._on_the_way: deque[tuple[Piece, int, int, int]] = deque()
        self._on_the_way_bytes = 0
        self._pending = 0
        self._last: dict[str, tuple[int, tuple[int, ...]]] = {}

    def counters(self) -> dict[str, int]:
        """Return the counts that a reader must have, by its names; `bad_lines` includes `non_ascii_lines`."""
        names = ("frames", "foreign", "bad_lines", "skipped_bytes", "duplicates")
        return {name: getattr(self, name) for name in names}

    def hand_on(self, piece: Piece, written_bytes: int, time_ns: int, written_ns: int) -> None:
        """Record a piece that went out, as far as there was room for it, between two monotonic times in [ns]."""
        if written_bytes < len(piece.data) and piece.sent is not None and not piece.sent.lost:
            piece = piece._replace(sent=piece.sent._replace(fate="overflow"))
        self.noise += piece.sent is None and not piece.answer
        self._on_the_way.append((piece, written_bytes, time_ns, written_ns))
        self._on_the_way_bytes += written_bytes

    def settle(self, unread_bytes: int, counted_ns: float = math.inf) -> None:
        """Settle the pieces that the reader has fetched: all but the unread bytes and the newest ones.

        Args:
            unread_bytes: number of unread bytes as counted by the kernel.
            counted_ns: monotonic time in [ns]; the kernel may not have counted all bytes handed on later.
        """
        young = takewhile(lambda one: one[2] > counted_ns, reversed(self._on_the_way))
        unread_bytes += sum(written_bytes for _, written_bytes, *_ in young)
        while self._on_the_way and self._on_the_way_bytes - self._on_the_way[0][1] >= unread_bytes:
            piece, written_bytes, time_ns, written_ns = self._on_the_way.popleft()
            self._on_the_way_bytes -= written_bytes
            self._read(piece, written_bytes, time_ns, written_ns)

    def open_channel(self) -> None:
        """Note that the reader begins again: its unfinished line belongs to no frame."""
        self.openings += 1
        self.skipped_bytes += self._pending
        self._pending = 0
        self._last.clear()

    def close_channel(self, unread_bytes: int) -> None:
        """Note that the reader has gone and left `unread_bytes`."""
        self.settle(unread_bytes)
        for piece, written_bytes, time_ns, _ in self._on_the_way:
            fetched = max(0, self._on_the_way_bytes - unread_bytes)
            self._pending += fetched  # at most the head of a line, since whole pieces are settled
            self._on_the_way_bytes -= written_bytes
            unread_bytes -= written_bytes - fetched
            if piece.sent is not None:
                lost = piece.sent if piece.sent.lost else piece.sent._replace(fate="unread")
                self.lose(lost, time_ns)
        self._on_the_way.clear()
        self._on_the_way_bytes = 0

    def lose(self, sent: BusFrame, time_ns: int) -> None:
        """Record a frame without a byte that is read, with the fate of its loss."""
        self._keep(sent, time_ns, time_ns)

    def _read(self, piece: Piece, written_bytes: int, time_ns: int, written_ns: int) -> None:
        sent = piece.sent
        if sent is not None and not sent.lost:
            self.skipped_bytes += self._pending
            self._pending = 0
            self.frames += 1
            self._keep(sent, time_ns, written_ns)
            return
        if sent is not None:
            self._keep(sent, time_ns, written_ns)
        if piece.answer and not self._pending:
            return
        for byte in piece.data[:written_bytes]:
            if byte not in LINE_ENDS:
                self._pending += 1
            elif self._pending:
                self.bad_lines += 1
                self.skipped_bytes += self._pending
                self._pending = 0

    def _keep(self, sent: BusFrame, time_ns: int, written_ns: int) -> None:
        self.fates[sent.fate] += 1
        place = USPA44_MAP.taxels.get(sent.frame.can_id)
        xyz = _xyz(sent.frame.data) if len(sent.frame.data) == 8 else (0, 0, 0)
        if not sent.lost:
            if place is None:
                self.foreign += 1
            else:
                reading = (sent.frame.can_id, xyz)
                self.duplicates += self._last.get(place[0]) == reading
                self._last[place[0]] = reading
        fate, bus_us = _FATE_NUMBERS[sent.fate], round(sent.time_s * 1e6)
        self._log(_pack(time_ns, written_ns, bus_us, sent.cycle, sent.frame.can_id, *xyz, self.openings, fate))
