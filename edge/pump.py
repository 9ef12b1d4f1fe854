"""From a link through the runtime into sinks, with the reading beside the inference."""

import gc
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
from typing import Final, NamedTuple, Protocol

from edge.deadline import Deadline
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
        # Unlike a Condition it wakes its reader without Python on either side: half of what a scan cost was waking.
        self._waiting: SimpleQueue[Arrival | None] = SimpleQueue()
        self._capacity_scans = capacity_scans
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
        arrivals: list[Arrival] = []
        try:
            arrival = None if self._through else self._waiting.get(timeout=timeout_s)
            while arrival is not None:
                arrivals.append(arrival)
                arrival = self._waiting.get_nowait()
            self._through = True
        except Empty:
            return arrivals
        if arrivals:
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
            self._waiting.put(None)

    def _put(self, scans: Sequence[Scan]) -> None:
        counters = self._link.counters()
        for scan in scans:
            if self._waiting.qsize() >= self._capacity_scans:
                with suppress(Empty):  # taken after all, that moment
                    self._waiting.get_nowait()
                    self.overruns += 1
            self._waiting.put(Arrival(scan, counters))


@contextmanager
def _uncollected() -> Iterator[None]:
    """Without garbage collection.

    A full collection stops everything for tens of milliseconds, several periods of a sensor, and the loop makes no
    cycles that would need one: what it makes is freed at once. What is there before is kept out of later collections.
    """
    enabled = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.unfreeze()
        if enabled:
            gc.enable()


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
    rate_hz: float | None = None,
    clock_s: Callable[[], float] = time.monotonic,
    clock_ns: Callable[[], int] = time.monotonic_ns,
) -> None:
    """Run until the link ends, `stop` is set or `duration_s` is over.

    Of the scans that wait, the newest of each sensor gets a pattern; the older ones get their
    record without one.

    Args:
        link: open.
        runtime: makes the results.
        sinks: get every result and the counters: the link's, `dropped`, `overruns` and `late`.
        statistics: filled on the way, so that they are there however the run ends.
        stop: ends the run after the scans in hand.
        duration_s: longest time to run, in [s].
        commands: "reset" resets the runtime.
        capacity_scans: how many scans may wait.
        rate_hz: of each sensor, for the deadline of its patterns; by default as its scans come.
        clock_s: monotonic, in [s].
        clock_ns: the clock of the scans, in [ns].

    Raises:
        LinkLostError: after every scan before it got its record.
        SinkError: a sink cannot be written; SinkClosedError if its reader has gone.
        ModelError: the model gave a pattern that is not finite, or a deviation that is not finite and above zero.
    """
    deadlines: dict[str, Deadline] = {}
    with ScanReader(link, capacity_scans) as reader, _uncollected():
        end_s = None if duration_s is None else clock_s() + duration_s
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
            scans = [(a.scan, newest[a.scan.sensor] == index) for index, a in enumerate(arrivals)]
            results = runtime.push_together(scans)
            done_ns = clock_ns()
            for arrival, result in zip(arrivals, results, strict=True):
                deadline = deadlines.get(arrival.scan.sensor)
                if deadline is None:
                    deadline = deadlines[arrival.scan.sensor] = Deadline(rate_hz)
                deadline.follow(arrival.scan.time_ns)
                if result.pattern is not None:
                    statistics.late += deadline.check(arrival.scan.time_ns, done_ns)
                    result = replace(result, latency_us=(done_ns - arrival.scan.time_ns) / 1e3)
                statistics.add(result)
                counters = {
                    **arrival.counters,
                    "dropped": statistics.dropped,
                    "overruns": statistics.overruns,
                    "late": statistics.late,
                }
                for sink in sinks:
                    sink.write(result, counters)
            if not arrivals:
                for sink in sinks:
                    sink.wait()
