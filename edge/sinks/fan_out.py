"""Fan-out to all sinks of a run; a sink that fails is given up while the others go on."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter, methodcaller
from typing import Final

from edge.errors import SinkClosedError, SinkError
from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.sink import Sink
from firmware_bridge.poses.timed_pose import TimedPose

LOOK_NS: Final = 500_000_000
"""Pause between two checks of the sinks' trouble, in [ns]: discovery of a reader may take a moment."""
_UNWRITTEN: Final = attrgetter("unwritten")


class Fan(Sink):
    """Fan-out of results and events to several sinks.

    Attributes:
        failures: of sinks given up, in their order.
    """

    def __init__(self, tell: Callable[[Event], object], clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """Begin without a sink; `tell` is called first with the event of one that is given up or reports trouble."""
        self.failures: list[SinkError] = []
        self._sinks: list[Sink] = []
        self._given_up_unwritten = 0
        self._counters: Mapping[str, int] = {}
        self._tell = tell
        self._clock_ns = clock_ns
        self._look_ns = clock_ns() + LOOK_NS
        self._known_trouble: set[str] = set()

    def add(self, sink: Sink) -> None:
        """Add one open sink; the failure of the last sink ends the run."""
        self._sinks.append(sink)

    @property
    def trouble(self) -> str | None:
        """Trouble that any of the sinks reports, or None."""
        return "; ".join(sorted(self._troubles())) or None

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Pass on one result, or raise where no sink is left; a SinkClosedError if only their readers have gone."""
        self._each(methodcaller("write", result, counters), counters)

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Pass on one event."""
        self._each(methodcaller("tell", event, counters), counters)

    def pose(self, poses: Sequence[TimedPose]) -> None:
        """Pass on poses."""
        self._each(methodcaller("pose", poses), self._counters)

    def wait(self) -> None:
        """Pass on that no scan came."""
        self._each(methodcaller("wait"), self._counters)

    def close(self) -> None:
        """Close every sink; raises the error of the first that failed, now or before, unless another ends the run."""
        for sink in self._sinks:
            try:
                sink.close()
            except SinkError as error:
                self.failures.append(error)
        self._sinks = []
        if self.failures and sys.exception() is None:  # else the error that ended the run is reported
            raise self.failures[0]

    def _each(self, act: Callable[[Sink], None], counters: Mapping[str, int]) -> None:
        self._counters = counters  # still true for a sink that fails while no scan comes
        for sink in tuple(self._sinks):
            if sink not in self._sinks:  # given up by an earlier call of this loop
                continue
            try:
                act(sink)
            except SinkError as error:
                self._give_up(sink, error, counters)
        self.unwritten = self._given_up_unwritten + sum(map(_UNWRITTEN, self._sinks))
        if self._clock_ns() >= self._look_ns:
            self._look_ns = self._clock_ns() + LOOK_NS
            known, self._known_trouble = self._known_trouble, self._troubles()
            for trouble in sorted(self._known_trouble - known):
                self._tell_all(trouble, counters)

    def _troubles(self) -> set[str]:
        return {sink.trouble for sink in self._sinks if sink.trouble is not None}

    def _give_up(self, sink: Sink, error: SinkError, counters: Mapping[str, int]) -> None:
        self._sinks.remove(sink)
        self._given_up_unwritten += sink.unwritten
        closed = isinstance(error, SinkClosedError)
        if not closed:
            self.failures.append(error)
        try:
            sink.close()
        except SinkError as another:
            self.failures.append(another)
        if not self._sinks:
            self.unwritten = self._given_up_unwritten
            raise self.failures[0] if self.failures else error
        self._tell_all(f"{error}; the other sinks continue", counters)

    def _tell_all(self, text: str, counters: Mapping[str, int]) -> None:
        event = Event(self._clock_ns(), "sink", None, text)
        self._tell(event)
        self.tell(event, counters)
