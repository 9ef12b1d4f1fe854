"""Events as lines on stderr, above the live line where there is one."""

import sys
import time
from collections.abc import Callable, Mapping
from typing import Final, TextIO

from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.sink import Sink

CLEAR_LINE: Final = "\r\x1b[K"
FIRST_HINT_S: Final = 5.0
"""After so long without a scan, then after twice, four times, ... as long."""


class MessageSink(Sink):
    """Writes each event as a line."""

    def __init__(
        self,
        stream: TextIO | None = None,
        *,
        hint: str = "",
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin without an event.

        Args:
            stream: written to; stderr unless given.
            hint: what to do while no scan has come at all; it is said ever more seldom.
            clock_s: monotonic, in [s].
        """
        self._stream = sys.stderr if stream is None else stream
        self._hint = hint
        self._clock_s = clock_s
        self._begun_s = clock_s()
        self._patience_s = FIRST_HINT_S

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Print what happened before this scan."""
        self._hint = ""
        for event in result.events:
            self.say(event)

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Say what happened."""
        self.say(event)

    def wait(self) -> None:
        """Say that nothing has come, and what to do."""
        silent_s = self._clock_s() - self._begun_s
        if self._hint and silent_s >= self._patience_s:
            self._patience_s *= 2
            self._say(f"no scan in {silent_s:.0f} s: {self._hint}")

    def say(self, event: Event) -> None:
        """Say it without counters."""
        self._say(event.text)

    def _say(self, text: str) -> None:
        if self._stream is None:
            return
        try:
            self._stream.write(f"{CLEAR_LINE if self._stream.isatty() else ''}edge-sr: {_harmless(text)}\n")
            self._stream.flush()
        except OSError:
            self._stream = None  # the window was closed; that ends no recording

    def close(self) -> None:
        """Nothing to finish."""


def _harmless(text: str) -> str:
    """Text that moves no cursor and sets no title: what devices and files say is in it."""
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
