"""Reading a terminal with as few wake-ups as a scan is worth, and none later than the last byte of a whole one.

A scan comes in many small pieces over some 2 ms, and waking Python up for each costs more than decoding them.
So the kernel is told to call the terminal readable only when FULL_BYTES wait in it (VMIN, which poll() keeps to where
VTIME is 0). Of a scan whose length is known, all but the last FULL_BYTES are fetched first; what makes FULL_BYTES
again, and wakes us at once, is then its very last byte. Setting VMIN anew for each scan would be simpler, but costs an
FTDI chip a USB transfer each time.

A sensor with a silent taxel has no whole scans: what closes one is the next cycle's first frame, which may lie unseen
for 2 ms, seldom 5.
"""

import errno
import os
import select
import sys
import time
from collections.abc import Callable
from typing import Final

try:
    import fcntl
    import termios
except ImportError:
    fcntl = termios = None

FULL_BYTES: Final = 255
"""The most that VMIN can say; a scan of sixteen taxels has 352."""
LONGEST_WAIT_S: Final = 0.02
"""How long fewer than FULL_BYTES may lie unseen: what is no scan, or the half of one, has no reader in a hurry."""
LONGEST_REST_S: Final = 0.004
"""How long the end of a scan is waited for once its first bytes are here: sixteen frames take 2.1 ms on the bus."""
STEP_S: Final = 0.0003
"""Between looks where VMIN cannot tell, because less than FULL_BYTES are missing."""


class BurstReader:
    """Reads bytes from the descriptor of a serial port that is in raw mode and does not block.

    Attributes:
        descriptor: of the port.
        held_until_s: the beginning of a scan was fetched, and its end is waited for until then; None else.
        empty_s: when no more than the beginning of a scan lay there the last time that was looked.
    """

    def __init__(
        self,
        descriptor: int,
        *,
        clock_s: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        """Ask the kernel to gather bytes.

        Raises:
            OSError: the port is gone. termios.error, which is none, as well.
        """
        self.descriptor = descriptor
        self._clock_s = clock_s
        self._sleep = sleep
        self._newest_s = self.empty_s = clock_s()
        self._held = b""
        self.held_until_s: float | None = None
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)
        os.set_blocking(descriptor, False)
        if termios is not None:
            attributes = termios.tcgetattr(descriptor)
            attributes[6][termios.VMIN], attributes[6][termios.VTIME] = FULL_BYTES, 0
            termios.tcsetattr(descriptor, termios.TCSANOW, attributes)

    def read(self, timeout_s: float, wanted_bytes: int) -> bytes:
        """Return what has come, when `wanted_bytes` have, or when no more do.

        Args:
            timeout_s: longest wait for the first byte, in [s]. At 0 nothing is waited for: what is only the beginning
                of a scan is kept, and the rest asked for by another call after `longest_wait_s`.
            wanted_bytes: until a scan can close; the same until something is returned.

        Raises:
            OSError: the port is gone, and everything that came before was given.
        """
        end_s = self._clock_s() + timeout_s
        while True:
            left_s = max(end_s - self._clock_s(), 0.0)
            wait_s = min(left_s, self.longest_wait_s(wanted_bytes))
            if 0 < wait_s <= STEP_S:  # poll() counts in milliseconds
                self._sleep(wait_s)
                wait_s = 0
            data = self._step(bool(self._poll.poll(1000 * wait_s)), wanted_bytes)
            if data or left_s <= 0:
                return data

    def longest_wait_s(self, wanted_bytes: int) -> float:
        """Return how long the next call of `read` may be put off while the descriptor is not readable, in [s]."""
        if self.held_until_s is None:
            hurried = wanted_bytes < FULL_BYTES and self._clock_s() - self._newest_s <= LONGEST_REST_S
            return 0.0 if hurried else LONGEST_WAIT_S
        left_s = max(self.held_until_s - self._clock_s(), 0.0)
        return left_s if wanted_bytes >= FULL_BYTES else min(left_s, STEP_S)

    def _step(self, full: bool, wanted_bytes: int) -> bytes:
        """Return what is there, unless it is the beginning of a scan whose end is on its way.

        Args:
            full: FULL_BYTES lie there, or the port is gone.
            wanted_bytes: as in `read`.
        """
        now_s = self._clock_s()
        if self.held_until_s is None:
            if wanted_bytes >= FULL_BYTES:
                early = wanted_bytes - FULL_BYTES
                self._held = self._take(b"", early if full else wanted_bytes)
                on_its_way = full and len(self._held) == early
            else:
                self._held = self._take(b"", wanted_bytes)
                on_its_way = now_s - self._newest_s <= LONGEST_REST_S and len(self._held) < wanted_bytes
            if on_its_way:
                self.held_until_s = now_s + LONGEST_REST_S
                return b""
        else:
            if full or wanted_bytes < FULL_BYTES or now_s >= self.held_until_s:
                self._held = self._take(self._held, wanted_bytes)
            if now_s < self.held_until_s and not (full or len(self._held) == wanted_bytes):
                return b""
        data, self._held, self.held_until_s = self._held, b"", None
        if data:
            self._newest_s = self._clock_s()
        else:
            self.empty_s = self._clock_s()
        return data

    def look(self) -> None:
        """Look whether more waits than the beginning of a scan; if not, keep when that was.

        Raises:
            OSError: the port is gone.
        """
        waiting = fcntl.ioctl(self.descriptor, termios.FIONREAD, bytes(4)) if fcntl and termios else bytes(4)
        if int.from_bytes(waiting, sys.byteorder) < FULL_BYTES:
            self.empty_s = self._clock_s()

    def _take(self, data: bytes, wanted_bytes: int) -> bytes:
        """`data` and what is there, up to `wanted_bytes`. An error behind bytes is left for the next call to meet."""
        while len(data) < wanted_bytes:
            try:
                # Asked for VMIN, the kernel hands out 64 bytes a call however many there are.
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
        return data
