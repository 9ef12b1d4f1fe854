"""Capacity of a pipe before its writer would have to wait; on Linux."""

import fcntl
import os
import select
import stat
import struct
import sys
import termios
from contextlib import suppress
from typing import Final

PIPE_BYTES: Final = 1 << 20
"""Most that Linux gives to any user: at least a quarter of a second of two sensors' patterns, usually the double."""
PAGE_BYTES: Final = 4096


def widen(descriptor: int) -> None:
    """Enlarge a pipe to PIPE_BYTES if that is allowed; anything else stays as it is."""
    if sys.platform == "linux" and _is_pipe(descriptor):
        with suppress(OSError):  # other pipes have taken the pages that a user may have
            fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, PIPE_BYTES)


def has_room(descriptor: int, wanted_bytes: int) -> bool:
    """Return True if so many bytes can be written without waiting. A pipe whose reader has gone has room."""
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    events = poll.poll(0)
    if not events or events[0][1] & (select.POLLERR | select.POLLNVAL) or not _is_pipe(descriptor):
        return bool(events)
    if sys.platform != "linux":
        return True
    waiting_bytes = struct.unpack("i", fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4)))[0]
    if waiting_bytes == 0:
        return True  # the pipe may be too small for a record, and a reader that has taken everything is not slow
    # A pipe holds pages, and a record may begin a new page, so up to half of their room stays empty.
    return 2 * waiting_bytes + wanted_bytes + 2 * PAGE_BYTES <= fcntl.fcntl(descriptor, fcntl.F_GETPIPE_SZ)


def _is_pipe(descriptor: int) -> bool:
    return stat.S_ISFIFO(os.fstat(descriptor).st_mode)
