"""Reader of a terminal with few wake-ups a scan, the last of them at the last byte of a whole scan.

A scan comes in many small pieces over some 2 ms, and waking Python up for each costs more than decoding them.
So the kernel is set to call the terminal readable only when FULL_BYTES wait in it (VMIN, which poll() respects where
VTIME is 0). If the length of a scan is given, all but its last FULL_BYTES are fetched first; then its very last byte
completes FULL_BYTES again, and wakes the reader at once. Setting VMIN for each scan would be simpler, but costs an FTDI
chip a USB transfer each time.

A sensor with a silent taxel has no whole scans: the next cycle's first frame closes each, and may wait for 2 ms, seldom
5, before it is read.
"""

import errno
import os
import select
import sys
import time
from collections.abc import Callable
from typing import Final, NamedTuple

try:
    import fcntl
    import termios
except ImportError:
    fcntl = termios = None

FULL_BYTES: Final = 255  # highest value of VMIN; a scan of sixteen taxels has 352 bytes
MOST_BYTES: Final = 65536  # most bytes read at once: as many as a kernel keeps for a serial port
LONGEST_REST_S: Final = 0.004
"""Longest wait for the end of a scan after its first bytes, in [s]: sixteen frames take 2.1 ms on the bus."""
STEP_S: Final = 0.0003  # time between polls, in [s], where VMIN does not help, because less than FULL_BYTES are missing


class Piece(NamedTuple):
    """Bytes received together at `time_ns`, and the latest time before it at which the port was empty, in [ns]."""

    data: bytes
    time_ns: int
    empty_ns: int


class BurstReader:
    """Reader of bytes from the descriptor of a serial port that is in raw mode and does not block.

    Attributes:
        descriptor: file descriptor of the port.
        empty_s: latest time at which no more than the beginning of a scan was waiting.
    """

    def __init__(self, descriptor: int, *, clock_s: Callable[[], float] = time.monotonic) -> None:
        """Configure the kernel to gather bytes; it raises OSError, or termios.error, if the port is gone."""
        self.descriptor = descriptor
        self._clock_s = clock_s
        self._newest_s = self.empty_s = clock_s()
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)
        os.set_blocking(descriptor, False)
        if termios is not None:
            attributes = termios.tcgetattr(descriptor)
            attributes[6][termios.VMIN], attributes[6][termios.VTIME] = FULL_BYTES, 0
            termios.tcsetattr(descriptor, termios.TCSANOW, attributes)

    def read(self, timeout_s: float, wanted_bytes: int) -> bytes:
        """Return the bytes received, once `wanted_bytes` have come, or no more; waits at most `timeout_s` for any.

        Raises:
            OSError: the port is gone, and all earlier bytes have been returned.
        """
        end_s = self._clock_s() + timeout_s
        while True:
            now_s = self._clock_s()
            left_s = max(end_s - now_s, 0.0)
            hurried = wanted_bytes < FULL_BYTES and now_s - self._newest_s <= LONGEST_REST_S
            # Without a whole scan there is no hurry: fewer than FULL_BYTES wait for 20 ms.
            full = self._fills(0.0 if hurried else min(left_s, 0.02))
            begun_s = self._clock_s()
            data = self._fetch(full, wanted_bytes, begun_s)
            if data:
                self._newest_s = self._clock_s()
                return data
            self.empty_s = begun_s  # from before the read: this thread may not run for long after it
            if left_s <= 0:
                return data

    def _fetch(self, full: bool, wanted_bytes: int, now_s: float) -> bytes:
        """Return the bytes there, after the end of a scan that has begun; `full` if FULL_BYTES are waiting."""
        whole = wanted_bytes >= FULL_BYTES
        early_bytes = wanted_bytes - FULL_BYTES if whole and full else wanted_bytes
        data = self._take(b"", early_bytes)
        if whole:
            on_its_way = full and len(data) == early_bytes
        else:
            on_its_way = now_s - self._newest_s <= LONGEST_REST_S and len(data) < wanted_bytes
        end_s, full = now_s + LONGEST_REST_S, False
        while on_its_way and not full and len(data) < wanted_bytes:
            left_s = max(end_s - self._clock_s(), 0.0)
            full = self._fills(left_s if whole else min(left_s, STEP_S))
            if full or not whole or left_s <= 0:
                data = self._take(data, wanted_bytes)
            on_its_way = left_s > 0
        return data

    def _fills(self, wait_s: float) -> bool:
        """Return whether FULL_BYTES are waiting, or the port is gone, after waiting at most so long for it."""
        if 0 < wait_s <= STEP_S:  # poll() counts in milliseconds
            time.sleep(wait_s)
            wait_s = 0
        return bool(self._poll.poll(1000 * wait_s))

    def take_all(self) -> bytes:
        """Return all bytes there, without waiting for more; raises as `read` does."""
        now_s = self._clock_s()
        data = self._take(b"", MOST_BYTES)
        if len(data) < MOST_BYTES:
            self.empty_s = now_s
        return data

    def look(self) -> None:
        """Update `empty_s` if no more than the beginning of a scan is waiting; raises OSError if the port is gone."""
        looked_s = self._clock_s()  # from before the look: this thread may not run for long after it
        waiting = fcntl.ioctl(self.descriptor, termios.FIONREAD, bytes(4)) if fcntl and termios else bytes(4)
        if int.from_bytes(waiting, sys.byteorder) < FULL_BYTES:
            self.empty_s = looked_s

    def _take(self, data: bytes, wanted_bytes: int) -> bytes:
        """Return `data` with the bytes there, up to `wanted_bytes`. An error after bytes is left to the next call."""
        while len(data) < wanted_bytes:
            try:
                piece = os.read(self.descriptor, wanted_bytes - len(data))
                if not piece:
                    raise OSError(errno.EIO, "hung up")
            except BlockingIOError:
                break
            except OSError:
                if data:
                    break
                raise
            data += piece
            # Where VMIN is set, the kernel returns 64 bytes a call, and fewer only if no more are there.
            if len(piece) < 64:
                break  # another read would raise an exception, which costs more than all else here
        return data
