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
        self._descriptor = descriptor
        self._clock_s = clock_s
        self._sleep = sleep
        self._newest_s = self.empty_s = clock_s()
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)
        os.set_blocking(descriptor, False)
        if termios is not None:
            attributes = termios.tcgetattr(descriptor)
            attributes[6][termios.VMIN], attributes[6][termios.VTIME] = FULL_BYTES, 0
            termios.tcsetattr(descriptor, termios.TCSANOW, attributes)

    def read(self, timeout_s: float, wanted_bytes: int) -> bytes:
        """What has come, when `wanted_bytes` have, or when no more do; waits at most `timeout_s` for the first.

        Raises:
            OSError: the port is gone, and everything that came before was given.
        """
        end_s = self._clock_s() + timeout_s
        while True:
            now_s = self._clock_s()
            in_step = wanted_bytes >= FULL_BYTES or now_s - self._newest_s > LONGEST_REST_S
            left_s = max(end_s - now_s, 0.0)
            if in_step:
                full = self._poll.poll(1000 * min(left_s, LONGEST_WAIT_S))
                data = self._take(b"", max(wanted_bytes - FULL_BYTES, 0) if full else wanted_bytes)
                if full and len(data) == max(wanted_bytes - FULL_BYTES, 0):
                    self._poll.poll(1000 * LONGEST_REST_S)
                    data = self._take(data, wanted_bytes)
            else:
                data = self._take(b"", wanted_bytes)
                while len(data) < wanted_bytes and self._clock_s() < now_s + min(left_s, LONGEST_REST_S):
                    self._sleep(STEP_S)
                    data = self._take(data, wanted_bytes)
            if data:
                self._newest_s = self._clock_s()
            else:
                self.empty_s = self._clock_s()
            if data or left_s <= 0:
                return data

    def look(self) -> None:
        """Look whether more waits than the beginning of a scan; if not, keep when that was.

        Raises:
            OSError: the port is gone.
        """
        if _waiting_bytes(self._descriptor) < FULL_BYTES:
            self.empty_s = self._clock_s()

    def _take(self, data: bytes, wanted_bytes: int) -> bytes:
        """`data` and what is there, up to `wanted_bytes`. An error behind bytes is left for the next call to meet."""
        while len(data) < wanted_bytes:
            try:
                # Asked for VMIN, the kernel hands out 64 bytes a call however many there are.
                piece = os.read(self._descriptor, wanted_bytes - len(data))
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


def _waiting_bytes(descriptor: int) -> int:
    if fcntl is None or termios is None:
        return 0
    return int.from_bytes(fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4)), sys.byteorder)
