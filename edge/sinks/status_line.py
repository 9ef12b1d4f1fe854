"""Lines for the person at the terminal: one live line, and above it the events."""

import shutil
import sys
import time
from collections.abc import Callable, Mapping
from typing import Final, TextIO

from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.sink import Sink
from edge.terminal.progress_bar import drawn, rewritable
from firmware_bridge.errors import harmless
from firmware_bridge.schedule import SHOWN_AT_REST_S, SHOWN_SILENT_S

CLEAR_TO_END: Final = "\x1b[K"
_COUNTED: Final = ("dropped", "overruns", "torn_wire", "unwritten", "poses", "poses_refused", "poses_dropped")
"""Counters on the line. Of scans torn at the source, noise makes one in forty of a healthy sensor: not an alarm."""


class StatusSink(Sink):
    """Live line, rewritten at most ten times a second; nothing is written where there is no terminal."""

    patience_s = SHOWN_AT_REST_S

    def __init__(self, stream: TextIO | None = None, *, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._clock_s = clock_s
        self._terminal = rewritable(self._stream)
        self._latest: dict[str, Result] = {}
        self._counters: Mapping[str, int] = {}
        self._last_scan_s = clock_s()
        self._received_s: dict[str, float] = {}
        self._last_shown_s: float | None = None
        self._without_poses: set[str | None] = set()

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Show one result, unless the line is fresh."""
        self._latest[result.scan.sensor] = result
        self._counters = counters
        self._last_scan_s = self._received_s[result.scan.sensor] = self._clock_s()
        self._refresh()

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Keep which sensors' poses have stopped."""
        if event.kind == "poses_silent":
            self._without_poses.add(event.sensor)
        elif event.kind == "poses_back":
            self._without_poses.discard(event.sensor)

    def wait(self) -> None:
        """Show the time without a scan."""
        self._refresh()

    def close(self) -> None:
        """Leave the last line standing."""
        if self._last_shown_s is not None:
            self._show("\n")

    def _refresh(self) -> None:
        now_s = self._clock_s()
        if self._terminal and (self._last_shown_s is None or now_s - self._last_shown_s >= SHOWN_AT_REST_S):
            self._last_shown_s = now_s
            self._show()

    def _show(self, end: str = "") -> None:
        # The last column stays free: some terminals wrap as soon as it is filled.
        try:
            drawn(self._stream).write("\r" + self._fitted(shutil.get_terminal_size().columns - 1) + CLEAR_TO_END + end)
            self._stream.flush()
        except OSError:
            self._terminal = False  # the window was closed; that ends no recording

    def _fitted(self, columns: int) -> str:
        """Return the line, cut on a narrow terminal between two parts, or between words where that would cut half."""
        line = self.line()
        if len(line) <= columns:
            return line
        room = max(columns - len(" ..."), 0)
        ends = [line.rfind(between, 0, room + len(between)) for between in (" | ", " ")]
        return (line[: next((end for end in ends if end > room // 2), max(*ends, 0))] + " ...")[: max(columns, 0)]

    def line(self) -> str:
        """Return the line of what a person acts on, the most important part first."""
        parts = sorted({result.source.upper() for result in self._latest.values()} - {"DEVICE"})
        silence_s = self._clock_s() - self._last_scan_s
        if silence_s >= SHOWN_SILENT_S or not self._latest:
            parts.append(f"no scan for {silence_s:.0f} s")
        parts += [self._sensor_text(name) for name in sorted(self._latest)]
        if self._without_poses:
            of = ",".join(sorted(name or "" for name in self._without_poses))
            parts.append(f"NO POSES {of}".rstrip())
        counted = ((name, self._counters.get(name, 0)) for name in _COUNTED)
        return " | ".join([*parts, *(f"{count} {name.replace('_', ' ')}" for name, count in counted if count)])

    def _sensor_text(self, name: str) -> str:
        result = self._latest[name]
        silence_s = self._clock_s() - self._received_s[name]
        if silence_s >= SHOWN_SILENT_S and len(self._latest) > 1:
            return f"{name} no scan for {silence_s:.0f} s"
        words = [f"{name} {result.state}"]
        if result.state in ("zeroing", "incomplete") and result.note is not None:
            return f"{name} {result.note}"
        if result.state == "baseline_in_doubt":
            return f"{name} BASELINE IN DOUBT: zero the free pad"
        if result.dead:
            words.append(f"without taxel {','.join(map(str, result.dead))}")
        if result.drift is not None and result.drift.step_counts:
            words.append(f"rest off by {result.drift.step_counts:.0f}")
        if result.trusted is None and result.pattern is not None:
            words.append("not checked")
        if result.trusted is False:
            words.append(f"NOT BELIEVED ({result.untrusted_reason})")
        if result.force_n is not None:
            words.append(f"{result.force_n:.2f} N")
        elif result.force_counts is not None:
            words.append(f"{result.force_counts:.0f} counts")
        if result.area_mm2 is not None:
            words.append(f"{result.area_mm2:.0f} mm2")
        return " ".join(words)


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
        self._patience_s = 5.0  # before the first hint; the next ones come after twice, four times, ... as long
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
            start = "\r" + CLEAR_TO_END if rewritable(self._stream) else ""
            drawn(self._stream).write(f"{start}edge-sr: {harmless(text, kept='')}\n")
            self._stream.flush()
        except OSError:
            self._stream = None  # the window was closed; that ends no recording
