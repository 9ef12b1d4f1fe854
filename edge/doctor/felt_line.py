"""Line under a request of the doctor: the load that is felt, the time left, and how to skip."""

import os
import select
import sys
import time
from collections.abc import Callable
from typing import Final, TextIO

from edge.doctor.press_guide import PATIENCE_S, Guide
from edge.terminal.text_wrap import columns, drawn, rewritable

REFRESH_S: Final = 0.1
BAR: Final = 10


class FeltLine:
    """Line that is rewritten in place on a terminal; nothing is written elsewhere."""

    def __init__(self, stream: TextIO, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._stream = drawn(stream)
        self._clock_s = clock_s
        self._shown = 0
        self._shown_s = self._asked_s = clock_s()

    def asked(self) -> None:
        """Begin the time of a request."""
        self._asked_s = self._clock_s()

    def show(self, guide: Guide) -> None:
        """Show the load on the pad, at most ten times a second."""
        now_s = self._clock_s()
        if now_s - self._shown_s < REFRESH_S or not rewritable(self._stream):
            return
        self._shown_s = now_s
        full = min(int(BAR * guide.felt_counts / guide.enough_counts), BAR)
        left_s = max(PATIENCE_S - (now_s - self._asked_s), 0)
        skip = ", Enter skips" if _stdin_is_terminal() else ""
        self._write(f"felt [{'#' * full:{BAR}}] {left_s:.0f} s left{skip}")

    def clear(self) -> None:
        """Clear the line, for text that stays."""
        if self._shown:
            self._write("")
            self._stream.write("\r")

    def _write(self, text: str) -> None:
        text = text[: columns() - 1]
        self._stream.write("\r" + text.ljust(self._shown))
        self._stream.flush()
        self._shown = len(text)


def enter_pressed() -> bool:
    """Return whether Enter was pressed on the terminal since the last call; never waits."""
    if not _stdin_is_terminal() or not select.select([sys.stdin.fileno()], [], [], 0)[0]:
        return False
    return b"\n" in os.read(sys.stdin.fileno(), 1024)


def _stdin_is_terminal() -> bool:
    # Only on POSIX can a terminal be polled for input.
    return os.name == "posix" and sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty()
