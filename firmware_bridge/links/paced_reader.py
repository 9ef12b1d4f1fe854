"""Reader of a port at times of its own, for scans that may come late.

Where the processor slept before, a scan costs not what its code takes but what fetching that code takes: decoding eight
scans together costs little more than one. And the frames of several sensors on a bus come in pieces so small that to
wake up for each costs many times what reading it does. So the scans of many sensors are read together a few times a
period. As long as readings hold still within noise, and nobody needs them at once, the port is read once a period, and
scans are handed on a few times a second. The first one that does not hold still ends that, and is handed on with all
before it.
"""

import time
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from firmware_bridge.links.base import Pace
from firmware_bridge.links.fd_reader import BurstReader
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.slcan_scans import SlcanScans

LATE_S: Final = 0.003
"""Time from the expected end of a scan to its reading at rest, in [s]: scans jitter by a millisecond, and
an adapter forwards them another one later."""
SHORTEST_S: Final = 0.005
"""Shortest period of a sensor that rests, in [s]: what a faster one sends meanwhile might not fit into the kernel."""


class Piece(NamedTuple):
    """Bytes received together.

    Attributes:
        data: the bytes.
        time_ns: monotonic time at which they were read, in [ns].
        empty_ns: latest monotonic time before it at which the port was empty, in [ns].
    """

    data: bytes
    time_ns: int
    empty_ns: int


class PacedReader:
    """Reader of scans that may come late, next to the `BurstReader` of the same port.

    Attributes:
        pace: how late scans may come. Any thread may set it.
        due_s: monotonic time of the next read, in [s]; None while bytes are to be read as they come.
    """

    def __init__(
        self,
        scans: SlcanScans,
        *,
        clock_s: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        """Begin to read bytes as they come.

        Args:
            scans: decoder of the port's bytes.
            clock_s: monotonic, in [s].
            sleep: sleeps for a time in [s].
        """
        self.pace = Pace()
        self.due_s: float | None = None
        self._scans = scans
        self._clock_s = clock_s
        self._sleep = sleep
        self._step_s = self._hold_s = self._together_s = 0.0
        self._pieces: list[Piece] = []

    def reset(self) -> int:
        """Read bytes as they come, since the port is opened or closed; return the number of bytes that were held."""
        pieces, self._pieces, self.due_s = self._pieces, [], None
        return sum(len(piece.data) for piece in pieces)

    def follow(self, data: bytes, scans: Sequence[Scan]) -> None:
        """Choose the time of the next read, after `data` was read and gave these scans.

        A port rests only with time stamps: by the times of reads, the next one would drift away from the end of a scan.
        """
        pace, now_s = self.pace, self._clock_s()
        held_s = pace.still_s
        stamped_ns = scans[-1].device_ns if held_s and scans else None
        period_s = None if stamped_ns is None else self._scans.period_s
        self._hold_s, self._together_s = 0.0, pace.together_s
        if stamped_ns is not None and period_s is not None and SHORTEST_S <= period_s <= held_s:
            self._scans.level(data)
            self._hold_s, self._step_s = held_s, period_s
            late_s = max(now_s - stamped_ns / 1e9 - LATE_S, 0.0)
            self.due_s = self._aligned_s(stamped_ns / 1e9 + LATE_S + period_s * (1 + late_s // period_s))
        elif pace.together_s:
            self._step_s = pace.together_s
            self.due_s = self._aligned_s(now_s)
        else:
            self.due_s = None

    def _aligned_s(self, due_s: float) -> float:
        """Return the next of the times at which all ports are read together."""
        return due_s if not self._together_s else self._together_s * (due_s // self._together_s + 1)

    def read(self, bursts: BurstReader, timeout_s: float) -> list[Piece]:
        """Return what is to be decoded now, once there is any; an empty list after `timeout_s` at the latest.

        A piece without data is returned where the port was empty though a scan was due.

        Raises:
            OSError: the port is gone, and all earlier bytes have been returned.
        """
        due_s, pieces = self.due_s or 0.0, self._pieces
        now_s = self._clock_s()
        end_s = now_s + timeout_s
        while True:
            if now_s < due_s:
                if due_s > end_s:
                    self._sleep(max(end_s - now_s, 0.0))
                    return []
                self._sleep(due_s - now_s)
            empty_s = bursts.empty_s
            try:
                data = bursts.take_all()
            except OSError:
                if not pieces:
                    raise
                break
            now_s = self._clock_s()
            pieces.append(Piece(data, round(1e9 * now_s), round(1e9 * empty_s)))
            self.due_s = due_s = self._step_s + (due_s if now_s - due_s < LATE_S else now_s)
            if due_s - pieces[0].time_ns / 1e9 > self._hold_s or not self.pace.still_s or not self._scans.still(data):
                break
        self._pieces = []
        return pieces
