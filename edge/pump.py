"""From a link through the runtime into sinks, with the reading beside the inference."""

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final, NamedTuple, Protocol

from edge.runtime import Runtime
from edge.sinks.base import Sink
from edge.statistics import Statistics
from firmware_bridge.links.base import Link
from firmware_bridge.scan import Scan

CAPACITY_SCANS: Final = 1024
"""Five seconds of two sensors at 100 Hz: only a sink that hangs lets so many wait."""
POLL_S: Final = 0.1
"""How long a stop, a command or a silent link may go unnoticed."""


class Arrival(NamedTuple):
    """A scan, and the link's counters when it had been read."""

    scan: Scan
    counters: Mapping[str, int]


class Commands(Protocol):
    """Where a user's commands come from."""

    refused: int

    def poll(self) -> Sequence[str]:
        """Names of the commands since the last call; never waits."""
        ...


class ScanReader:
    """Reads an open link in a thread of its own; what nobody takes in time is thrown away, oldest first.

    Attributes:
        overruns: scans thrown away.
    """

    def __init__(self, link: Link, capacity_scans: int = CAPACITY_SCANS) -> None:
        self.overruns = 0
        self._link = link
        self._waiting: deque[Arrival] = deque()
        self._capacity_scans = capacity_scans
        self._changed = threading.Condition()
        self._through = False
        self._stop = threading.Event()
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="scan-reader")
        self._reading: Future[None] | None = None

    def __enter__(self) -> "ScanReader":
        self._reading = self._executor.submit(self._read)
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._stop.set()
        self._executor.shutdown()

    def take(self, timeout_s: float) -> list[Arrival] | None:
        """All scans that wait, after waiting at most `timeout_s` for one; None when no more will come.

        Raises:
            LinkLostError: and whatever else ended the reading, after all scans before it were taken.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._through, timeout_s)
            arrivals = list(self._waiting)
            self._waiting.clear()
            through = self._through
        if arrivals or not through:
            return arrivals
        if self._reading is not None:
            self._reading.result()
        return None

    def _read(self) -> None:
        try:
            while not (self._stop.is_set() or self._link.ended):
                scans = self._link.read(POLL_S)
                if scans:
                    self._put(scans)
        finally:
            with self._changed:
                self._through = True
                self._changed.notify()

    def _put(self, scans: Sequence[Scan]) -> None:
        counters = self._link.counters()
        with self._changed:
            self._waiting.extend(Arrival(scan, counters) for scan in scans)
            while len(self._waiting) > self._capacity_scans:
                self._waiting.popleft()
                self.overruns += 1
            self._changed.notify()


def pump(
    link: Link,
    runtime: Runtime,
    sinks: Sequence[Sink],
    statistics: Statistics,
    *,
    stop: threading.Event,
    duration_s: float | None = None,
    commands: Commands | None = None,
    capacity_scans: int = CAPACITY_SCANS,
    clock_s: Callable[[], float] = time.monotonic,
) -> None:
    """Run until the link ends, `stop` is set or `duration_s` is over.

    Of the scans that wait, the newest of each sensor gets a pattern; the older ones get their
    record without one.

    Args:
        link: open.
        runtime: makes the results.
        sinks: get every result and the counters: the link's, `dropped` and `overruns`.
        statistics: filled on the way, so that they are there however the run ends.
        stop: ends the run after the scans in hand.
        duration_s: longest time to run, in [s].
        commands: "reset" resets the runtime.
        capacity_scans: how many scans may wait.
        clock_s: monotonic, in [s].

    Raises:
        LinkLostError: after every scan before it got its record.
        SinkError: a sink cannot be written; SinkClosedError if its reader has gone.
        ModelError: the model gave a pattern that is not finite, or a deviation that is not finite and above zero.
    """
    end_s = None if duration_s is None else clock_s() + duration_s
    with ScanReader(link, capacity_scans) as reader:
        while not stop.is_set() and (end_s is None or clock_s() < end_s):
            arrivals = reader.take(POLL_S)
            statistics.overruns = reader.overruns
            if arrivals is None:
                return
            if commands is not None:
                if "reset" in commands.poll():
                    runtime.reset()
                statistics.commands_refused = commands.refused
            newest = {arrival.scan.sensor: index for index, arrival in enumerate(arrivals)}
            for index, arrival in enumerate(arrivals):
                result = runtime.push(arrival.scan, infer=newest[arrival.scan.sensor] == index)
                statistics.add(result)
                counters = {**arrival.counters, "dropped": statistics.dropped, "overruns": statistics.overruns}
                for sink in sinks:
                    sink.write(result, counters)
            if not arrivals:
                for sink in sinks:
                    sink.wait()
