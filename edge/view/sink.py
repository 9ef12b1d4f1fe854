"""Sink of the live page: it stores results and events, and wakes the server now and then."""

import time
from collections.abc import Callable, Mapping
from typing import Final

from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.sink import Sink
from edge.view.frames import MAX_FPS
from edge.view.run_snapshot import RunSnapshot

PERIOD_NS: Final = round(1e9 / MAX_FPS)


class ViewSink(Sink):
    """Store of results and events that never waits.

    The server is woken from here, after a scan's last work and not by a clock of its own: so it runs while the loop
    sleeps, and does not delay it.
    """

    def __init__(
        self,
        snapshot: RunSnapshot,
        watched: Callable[[], bool],
        wake: Callable[[], object],
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Begin without a result; `watched` tells whether there is a viewer, and `wake` never waits."""
        self._snapshot, self._watched, self._wake, self._clock_ns = snapshot, watched, wake, clock_ns
        self._due_ns = 0
        self._unseen = False

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Store one result."""
        self._news(self._snapshot.add(result, counters))

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Store one event."""
        self._snapshot.tell(event, counters)
        self._news(self._clock_ns())

    def wait(self) -> None:
        """Show the newest result, once no scan follows it."""
        if self._unseen:
            self._news(self._clock_ns())

    def close(self) -> None:
        """Do nothing: there is nothing to finish."""

    def _news(self, now_ns: int) -> None:
        self._unseen = now_ns < self._due_ns
        if not self._unseen and self._watched():
            # Every fourth of a hundred scans a second, even if they come a little early or late.
            behind = now_ns - self._due_ns < PERIOD_NS
            self._due_ns = (self._due_ns if behind else now_ns) + PERIOD_NS
            self._wake()
