"""From a link through the runtime into sinks, in one loop."""

import gc
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

from edge.commands import Commands, obey
from edge.deadline import Deadline
from edge.event import Event
from edge.reader import CAPACITY_SCANS, POLL_S, Arrival, ScanReader
from edge.runtime import Runtime
from edge.silence import Silence
from edge.sinks.base import Sink
from edge.statistics import Statistics
from firmware_bridge.links.base import Link, Notice


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
    expected: Iterable[str] = (),
    clock_s: Callable[[], float] = time.monotonic,
    clock_ns: Callable[[], int] = time.monotonic_ns,
) -> None:
    """Run until the link ends, `stop` is set or `duration_s` is over.

    Of the scans that wait, the newest of each sensor gets a pattern; the older ones get their
    record without one.

    Args:
        link: open.
        runtime: makes the results.
        sinks: get every result and event, and the counters: the link's, `dropped`, `overruns`, `late` and `missed`.
        statistics: filled on the way, so that they are there however the run ends.
        stop: ends the run after the scans in hand.
        duration_s: longest time to run, in [s].
        commands: asked between scans.
        capacity_scans: how many scans may wait.
        rate_hz: of each sensor, for the deadline of its patterns; by default as its scans come.
        expected: names of sensors that there should be; one that is never heard is told.
        clock_s: monotonic, in [s].
        clock_ns: the clock of the scans, in [ns].

    Raises:
        LinkLostError: after every scan before it got its record.
        SinkError: a sink cannot be written; SinkClosedError if its reader has gone.
        ModelError: the model gave a pattern that is not finite, or a deviation that is not finite and above zero.
    """
    deadlines: dict[str, Deadline] = {}
    silence = Silence(expected)
    counters: Mapping[str, int] = link.counters()

    def tell(event: Event) -> None:
        statistics.tell(event)
        for sink in sinks:
            sink.tell(event, counters)

    with ScanReader(link, capacity_scans) as reader, _uncollected():
        end_s = None if duration_s is None else clock_s() + duration_s
        while not stop.is_set() and (end_s is None or clock_s() < end_s):
            taken = reader.take(POLL_S)
            statistics.overruns = reader.overruns
            if taken is None:
                return
            if commands is not None:
                obey(commands, runtime)
                statistics.commands_refused = commands.refused
            for notice, arrivals in _between_notices(taken):
                if notice is not None:
                    if notice.kind in ("lost", "silent", "back"):
                        runtime.lose_touch(notice.sensors)
                        silence.begin_anew(notice.time_ns, notice.sensors)
                    tell(Event.of(notice))
                newest = {arrival.scan.sensor: index for index, arrival in enumerate(arrivals)}
                scans = [(a.scan, newest[a.scan.sensor] == index) for index, a in enumerate(arrivals)]
                results = runtime.push_together(scans)
                done_ns = clock_ns()
                for arrival, result in zip(arrivals, results, strict=True):
                    deadline = deadlines.get(arrival.scan.sensor)
                    if deadline is None:
                        deadline = deadlines[arrival.scan.sensor] = Deadline(rate_hz)
                    deadline.follow(arrival.scan.time_ns)
                    heard_again = silence.follow(arrival.scan, deadline.period_ns)
                    if result.pattern is not None:
                        statistics.late += deadline.check(arrival.scan.time_ns, done_ns)
                        result = replace(result, latency_us=(done_ns - arrival.scan.time_ns) / 1e3)
                    statistics.add(result)
                    statistics.missed, statistics.unwritten = silence.missed, counters.get("unwritten", 0)
                    counters = {
                        **arrival.counters,
                        "dropped": statistics.dropped,
                        "overruns": statistics.overruns,
                        "late": statistics.late,
                        "missed": silence.missed,
                        "unwritten": sum(sink.unwritten for sink in sinks),
                    }
                    if heard_again is not None:
                        tell(heard_again)
                    for sink in sinks:
                        sink.write(result, counters)
            for event in silence.look():
                tell(event)
            if not taken:
                for sink in sinks:
                    sink.wait()


def _between_notices(
    taken: Sequence[Arrival | Notice],
) -> Iterator[tuple[Notice | None, list[Arrival]]]:
    """Cut what was taken at its notices: each, and the scans behind it."""
    notice, arrivals = None, []
    for heard in taken:
        if isinstance(heard, Arrival):
            arrivals.append(heard)
            continue
        if notice is not None or arrivals:
            yield notice, arrivals
        notice, arrivals = heard, []
    if notice is not None or arrivals:
        yield notice, arrivals
