"""Far ends of pseudo-terminals, which emulate adapters' ports and cables, and the thread that plays the adapters.

Several share one thread: where each has a thread or a process of its own, each wakes up a thousand times a second, and
takes the processor from the program that reads them.
"""

import fcntl
import os
import select
import struct
import termios
import threading
import time
from collections.abc import Generator, Iterable, Sequence
from pathlib import Path
from typing import Protocol, Self


class PseudoPort:
    """Port whose clients may come and go; `path` is theirs, and it is `plugged` while the cable is in."""

    def __init__(self, link: Path | None = None) -> None:
        """Prepare a port that is not plugged in; a link points to its present pseudo-terminal, as udev's does."""
        self.path = ""
        self.plugged = False
        self._link = link
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
        return os.read(self._far_fd, 4096)

    def write(self, data: bytes) -> int:
        """Send the bytes that find room and return their number; an adapter cannot keep the rest."""
        try:
            return os.write(self._far_fd, data) if self.plugged else 0
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


def listen(ports: Iterable[PseudoPort], timeout_s: float) -> dict[PseudoPort, bytes]:
    """Return the bytes that clients have written, by port; waits at most `timeout_s` [s] for the first."""
    readable, _, _ = select.select([port for port in ports if port.plugged], [], [], timeout_s)
    return {port: port.received() for port in readable}


class Playing(Protocol):
    """Emulator as its thread sees it; its client is at the port `line`."""

    line: PseudoPort

    def plug(self) -> None:
        """Put the cable in."""

    def course(self) -> Generator[float, None, None]:
        """Play; yield the monotonic time, in [s], at which to go on, or earlier when the client has written."""
        ...

    def obey(self, received: bytes) -> None:
        """Process what the client has written."""


class EmulatorThread:
    """Thread that plays emulators to their ends, or until it is closed, which ends them where they are."""

    def __init__(self, emulators: Sequence[Playing]) -> None:
        """Prepare to play them; nothing is plugged in yet."""
        self._courses = {emulator: emulator.course() for emulator in emulators}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._play, name="emulator", daemon=True)

    def __enter__(self) -> Self:
        for emulator in self._courses:
            emulator.plug()
        self._thread.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._stop.set()
        self._thread.join()

    def _play(self) -> None:
        try:
            due_s = {emulator: next(course) for emulator, course in self._courses.items()}
            while due_s and not self._stop.is_set():
                left_s = min(due_s.values()) - time.monotonic()
                received = listen([emulator.line for emulator in due_s], min(max(left_s, 0.0), 0.05))
                now_s = time.monotonic()
                for emulator in list(due_s):
                    if data := received.get(emulator.line):
                        emulator.obey(data)
                    if data or due_s[emulator] <= now_s:
                        next_s = next(self._courses[emulator], None)
                        if next_s is None:
                            del due_s[emulator]
                        else:
                            due_s[emulator] = next_s
        finally:
            for course in self._courses.values():
                course.close()
