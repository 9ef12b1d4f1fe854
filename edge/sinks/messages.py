"""Events as lines on stderr, above the live line where there is one."""

import sys
from collections.abc import Mapping
from typing import Final, TextIO

from edge.event import Event
from edge.result import Result
from edge.sinks.base import Sink

CLEAR_LINE: Final = "\r\x1b[K"


class MessageSink(Sink):
    """Writes each event as a line."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._begun = False

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Say what happened before this scan; why it began with its model was said before the first."""
        if result.event is not None and self._begun:
            self._say(result.event)
        self._begun = True

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Say what happened."""
        self.say(event)

    def say(self, event: Event) -> None:
        """Say it without counters."""
        self._say(event.text)

    def _say(self, text: str) -> None:
        if self._stream is None:
            return
        try:
            self._stream.write(f"{CLEAR_LINE if self._stream.isatty() else ''}edge-sr: {text}\n")
            self._stream.flush()
        except OSError:
            self._stream = None  # the window was closed; that ends no recording

    def close(self) -> None:
        """Nothing to finish."""
