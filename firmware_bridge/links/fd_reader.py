"""Reader of a serial port that wakes up seldom: at the first bytes of a scan, and at its end.

A scan comes in many small pieces over some 2 ms, and waking Python up for each costs more than decoding them. A frame
takes its time on the bus, so it is known when the last one can have come: until then the reader sleeps.
"""

import errno
import math
import os
import select
import time
from collections.abc import Callable
from typing import Final, NamedTuple

try:
    import termios
except ImportError:
    termios = None

MOST_BYTES: Final = 65536  # most bytes read at once: as many as a kernel keeps for a serial port
BYTE_S: Final = 5e-6  # time in [s] for a byte of a frame's line, of which a frame of 0.13 ms has 26 at most
SHORTEST_SLEEP_S: Final = 0.0003
LONGEST_WAIT_S: Final = 0.004
"""Longest wait for the end of a scan after its first bytes, in [s]: sixteen frames take 2.1 ms on the bus."""
LONGEST_LOOK_S: Final = 0.02  # longest time between two looks that find nothing, in [s]: `Unread` tells stalls by them


class Piece(NamedTuple):
    """Bytes received together at `time_ns`, and the latest time before at which the port was empty, in [ns]."""

    data: bytes
    time_ns: int
    empty_ns: int


class PortReader:
    """Reader of bytes from the descriptor of a serial port that is in raw mode and does not block."""

    def __init__(self, descriptor: int, *, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """Begin with a port that is empty; it raises OSError, or termios.error, if the port is gone."""
        self._descriptor, self._clock_ns = descriptor, clock_ns
        self._empty_ns = clock_ns()
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)
        os.set_blocking(descriptor, False)
        if termios is not None:  # with fewer, a port that is empty reads like one that is gone
            attributes = termios.tcgetattr(descriptor)
            attributes[6][termios.VMIN], attributes[6][termios.VTIME] = 1, 0
            termios.tcsetattr(descriptor, termios.TCSANOW, attributes)

    def read(self, timeout_s: float, wanted_bytes: int) -> Piece:
        """Return the bytes received, once `wanted_bytes` have come, or no more; waits at most `timeout_s` for any.

        Raises:
            OSError: the port is gone, and all earlier bytes have been returned.
        """
        now_ns = self._clock_ns()
        end_ns = now_ns + round(timeout_s * 1e9)
        while not self._poll.poll(math.ceil(1000 * min(max((end_ns - now_ns) / 1e9, 0.0), LONGEST_LOOK_S))):
            self._empty_ns, now_ns = now_ns, self._clock_ns()  # from before the look: it may return long after it
            if now_ns >= end_ns:
                return Piece(b"", now_ns, self._empty_ns)
        piece = self.take()
        data, now_ns = piece.data, piece.time_ns
        end_ns = now_ns + round(LONGEST_WAIT_S * 1e9)
        while 0 < len(data) < wanted_bytes and now_ns < end_ns:
            time.sleep(max((wanted_bytes - len(data)) * BYTE_S, SHORTEST_SLEEP_S))
            try:
                more = self.take()
            except OSError:
                break  # left to the next call
            data, now_ns = data + more.data, more.time_ns
        return Piece(data, now_ns, piece.empty_ns)

    def take(self) -> Piece:
        """Return the bytes there, without waiting for more; raises as `read` does."""
        begun_ns, empty_ns = self._clock_ns(), self._empty_ns
        data = b""
        while len(data) < MOST_BYTES:
            try:
                part = os.read(self._descriptor, MOST_BYTES - len(data))
                if not part:
                    raise OSError(errno.EIO, "hung up")
            except BlockingIOError:
                break
            except OSError:
                if data:
                    break
                raise
            data += part
            if len(part) < 64:  # the kernel returns 64 bytes a call, and fewer only if no more are there
                break
        if len(data) < MOST_BYTES:
            self._empty_ns = begun_ns  # from before the read: this thread may not run for long after it
        return Piece(data, self._clock_ns(), empty_ns if data else self._empty_ns)
