"""Far end of a pseudo-terminal, which emulates an adapter's port, its cable and its line."""

import fcntl
import math
import os
import random
import select
import struct
import termios
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Final

LINE_SPEED_BAUD: Final = 3_000_000
COUNTED_LATE_NS: Final = 10_000_000  # longest delay, in [ns], until a busy kernel counts sent bytes as unread
_COUNTS: Final = 4
_SPEEDS_BAUD: Final = {
    getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()
}


class PseudoPort:
    """Port whose clients may come and go; `path` is theirs, and it is `plugged` while the cable is in."""

    def __init__(self, link: Path | None = None, *, ignores_line_speed: bool = False, seed: int = 0) -> None:
        """Prepare a port that is not plugged in; a link points to its present pseudo-terminal, as udev's does."""
        self.path = ""
        self.plugged = False
        self._link = link
        self._ignores_line_speed = ignores_line_speed
        self._garble = random.Random(f"line {seed}")
        self._terminal = ""
        self._far_fd = self._client_fd = -1

    def plug(self, *, elsewhere: bool = False) -> None:
        """Put the cable in; with `elsewhere`, under another name than before."""
        # The client's side stays open in this process as well, so that clients may come and go.
        self._far_fd, self._client_fd = os.openpty()
        if elsewhere and os.ttyname(self._client_fd) == self._terminal:
            taken = self._far_fd, self._client_fd
            self._far_fd, self._client_fd = os.openpty()
            for descriptor in taken:
                os.close(descriptor)
        os.set_blocking(self._far_fd, False)
        self.path = self._terminal = os.ttyname(self._client_fd)
        if self._link is not None:
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(self._terminal)
            self.path = str(self._link)
        self.plugged = True

    def unplug(self) -> None:
        """Pull the cable out: a reader gets a hang-up, and the link is removed."""
        if self.plugged:
            self.plugged = False
            if self._link is not None and self._link.is_symlink():
                self._link.unlink(missing_ok=True)
            os.close(self._far_fd)
            os.close(self._client_fd)

    def fileno(self) -> int:
        """Return the descriptor of this end."""
        return self._far_fd

    def received(self) -> bytes:
        """Return the bytes that the client has written, of which there are some."""
        return self._through_line(os.read(self._far_fd, 4096))

    def write(self, data: bytes) -> int:
        """Send the bytes that find room and return their number; an adapter cannot keep the rest."""
        try:
            return os.write(self._far_fd, self._through_line(data)) if self.plugged else 0
        except BlockingIOError:
            return 0

    def unread_bytes(self) -> int:
        """Return the number of bytes that the client has not fetched yet."""
        if not self.plugged:
            return 0
        # select() on the client's side makes the kernel deliver the bytes that it still holds back, but reports nothing
        # below the client's VMIN; FIONREAD alone would report 0 too early.
        select.select([self._client_fd], [], [], 0)
        return struct.unpack("i", fcntl.ioctl(self._client_fd, termios.FIONREAD, bytes(4)))[0]

    def left_bytes(self) -> int:
        """Return the number of bytes left by a client that has stopped reading."""
        counted = 0
        for _ in range(_COUNTS):
            counted = max(counted, self.unread_bytes())
            time.sleep(COUNTED_LATE_NS / _COUNTS / 1e9)
        return counted

    def _through_line(self, data: bytes) -> bytes:
        """Return the bytes that arrive at the other end: at another speed they become noise of another length."""
        speed_baud = _SPEEDS_BAUD.get(termios.tcgetattr(self._client_fd)[5])
        if self._ignores_line_speed or speed_baud == LINE_SPEED_BAUD:
            return data
        return self._garble.randbytes(math.ceil(len(data) * min(1.0, (speed_baud or 0) / LINE_SPEED_BAUD)))


def listen(ports: Iterable[PseudoPort], timeout_s: float) -> dict[PseudoPort, bytes]:
    """Return the bytes that clients have written, by port; waits at most `timeout_s` [s] for the first."""
    readable, _, _ = select.select([port for port in ports if port.plugged], [], [], timeout_s)
    return {port: port.received() for port in readable}
