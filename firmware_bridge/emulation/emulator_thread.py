"""One thread that plays emulators: each hands on its frames when they are due, and obeys its client meanwhile.

Several share one: where each has a thread or a process of its own, each wakes up a thousand times a second, and takes
the processor from the program that reads them.
"""

import threading
import time
from collections.abc import Generator, Sequence
from typing import Final, Protocol, Self

from firmware_bridge.emulation.pty_port import PseudoPort, listen

_STOP_POLL_S: Final = 0.05


class Playing(Protocol):
    """Emulator as its thread sees it.

    Attributes:
        line: port of its client.
    """

    line: PseudoPort

    def plug(self) -> None:
        """Put the cable in."""
        ...

    def course(self) -> Generator[float, None, None]:
        """Play; yield the monotonic time, in [s], at which to go on, or earlier when the client has written."""
        ...

    def obey(self, received: bytes) -> None:
        """Process what the client has written."""
        ...


class EmulatorThread:
    """Thread that plays emulators to their ends, or until it is closed, which ends them where they are."""

    def __init__(self, emulators: Sequence[Playing]) -> None:
        """Prepare to play them; nothing is plugged in yet."""
        self._courses = {one: one.course() for one in emulators}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._play, name="emulator", daemon=True)

    def __enter__(self) -> Self:
        for one in self._courses:
            one.plug()
        self._thread.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._stop.set()
        self._thread.join()

    def _play(self) -> None:
        try:
            due_s = {one: next(course) for one, course in self._courses.items()}
            while due_s and not self._stop.is_set():
                left_s = min(due_s.values()) - time.monotonic()
                received = listen([one.line for one in due_s], min(max(left_s, 0.0), _STOP_POLL_S))
                now_s = time.monotonic()
                for one in list(due_s):
                    if data := received.get(one.line):
                        one.obey(data)
                    if data or due_s[one] <= now_s:
                        next_s = next(self._courses[one], None)
                        if next_s is None:
                            del due_s[one]
                        else:
                            due_s[one] = next_s
        finally:
            for course in self._courses.values():
                course.close()
