"""Printer of events as lines on stderr, above the live line where there is one."""

import sys
import time
from collections.abc import Callable, Mapping
from typing import Final, TextIO

from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.sink import Sink
from edge.terminal.text_wrap import drawn, rewritable
from firmware_bridge.errors import harmless
from firmware_bridge.silence import SHOWN_AT_REST_S

CLEAR_LINE: Final = "\r\x1b[K"
FIRST_HINT_S: Final = 5.0
"""Time without a scan before the first hint, in [s]; the next hints come after twice, four times, ... as long."""


class MessageSink(Sink):
    """Printer of each event as a line."""

    patience_s = SHOWN_AT_REST_S

    def __init__(
        self,
        stream: TextIO | None = None,
        *,
        hint: Callable[[], str] | None = None,
        first: str | None = None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Print on stderr by default, `first` with the first result, and `hint()` now and then until a scan comes."""
        self._first, self._hint = first, hint
        self._stream = sys.stderr if stream is None else stream
        self._clock_s, self._begun_s = clock_s, clock_s()
        self._patience_s = FIRST_HINT_S
        self._doubted: set[str] = set()

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Print the events before this scan, and once in a contact that its pattern is not to be believed."""
        self._hint = None
        if self._first is not None:
            self._say(self._first)
            self._first = None
        for event in result.events:
            self.say(event)
        sensor = result.scan.sensor
        if result.contact is False:
            self._doubted.discard(sensor)
        elif result.state == "contact" and result.trusted is False and sensor not in self._doubted:
            self._doubted.add(sensor)
            self._say(f"sensor {sensor}: pattern not to be believed: {result.untrusted_text}")

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Print one event."""
        self.say(event)

    def wait(self) -> None:
        """Print that no scan has come, with the hint."""
        silent_s = self._clock_s() - self._begun_s
        if self._hint and silent_s >= self._patience_s:
            self._patience_s *= 2
            self._say(f"no scan in {silent_s:.0f} s: {self._hint()}")

    def say(self, event: Event) -> None:
        """Print an event without counters."""
        self._say(event.text)

    def _say(self, text: str) -> None:
        if self._stream is None:
            return
        try:
            start = CLEAR_LINE if rewritable(self._stream) else ""
            drawn(self._stream).write(f"{start}edge-sr: {harmless(text, kept='')}\n")
            self._stream.flush()
        except OSError:
            self._stream = None  # the window was closed; that ends no recording

    def close(self) -> None:
        """Do nothing: there is nothing to finish."""
