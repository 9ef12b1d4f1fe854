"""Pairing of the results of several sensors by their times. No I/O, no clock."""

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from edge.errors import UsageError
from edge.perception.result import Result
from edge.pipeline.loop import ALL_HEARD_SCANS
from edge.pipeline.result_stream import Stream
from edge.pipeline.scan_reader import CAPACITY_SCANS
from edge.validation import check_positive

APART_S: Final = 0.02  # longest time between the results of a pair, in [s]: two periods of a sensor at 100 Hz


def paired(
    results: Iterable[Result], sensors: Sequence[str], *, apart_s: float = APART_S
) -> Iterator[tuple[Result, ...]]:
    """Yield the results of several sensors that belong together in time: one of each, in the order of their names.

    Times are those of the scans on the bus, where the device states them. Each result is used once at most; of two that
    could follow, the nearer one is taken, which is known a period later. Results without a partner are left out. Those
    of one sensor may come long before those of another, as they do from a loop that was held up. `apart_s` is the
    longest time from the first to the last result of a pair, in [s].

    Raises:
        UsageError: fewer than two sensors, one twice, or the time is out of range; while pairs are taken, no sensor
            has one of these names.
    """
    check_positive("apart_s", apart_s)
    if isinstance(sensors, str) or len(sensors) < 2 or len(set(sensors)) < len(sensors):
        raise UsageError(f"sensors are {sensors!r}, expected two or more different names")
    waiting: dict[str, deque[Result]] = {name: deque(maxlen=CAPACITY_SCANS) for name in sensors}
    return _pairs(results, waiting, round(apart_s * 1e9))


def _pairs(results: Iterable[Result], waiting: dict[str, deque[Result]], apart_ns: int) -> Iterator[tuple[Result, ...]]:
    newest_ns = 0
    missing, heard = set(waiting), Counter[str]()
    for result in results:
        sensor = result.scan.sensor
        if missing:
            missing.discard(sensor)
            heard[sensor] += 1
            if isinstance(results, Stream):
                for name in missing:
                    results.check_sensor(name)
        queue = waiting.get(sensor)
        if queue is None:
            continue
        queue.append(result)
        newest_ns = max(newest_ns, result.scan.on_bus_ns)
        yield from _matches(waiting, apart_ns, newest_ns)
    yield from _matches(waiting, apart_ns, None)
    if missing and max(heard.values(), default=0) >= ALL_HEARD_SCANS:
        raise UsageError(f"no result of sensor {min(missing)!r}: there are those of {', '.join(sorted(heard))}")


def _matches(waiting: dict[str, deque[Result]], apart_ns: int, newest_ns: int | None) -> Iterator[tuple[Result, ...]]:
    """Yield the pairs that nothing newer can better; `newest_ns` is None where nothing newer will come."""
    while all(waiting.values()):
        times_ns = [queue[0].scan.on_bus_ns for queue in waiting.values()]
        first_ns, last_ns = min(times_ns), max(times_ns)
        earliest = list(waiting.values())[times_ns.index(first_ns)]
        spread_ns, better = last_ns - first_ns, False
        if len(earliest) > 1:
            times_ns[times_ns.index(first_ns)] = earliest[1].scan.on_bus_ns
            better = max(times_ns) - min(times_ns) < spread_ns
        if better or spread_ns > apart_ns:
            earliest.popleft()
        elif len(earliest) == 1 and newest_ns is not None and newest_ns - last_ns < spread_ns:
            return  # its next one may be nearer
        else:
            yield tuple(queue.popleft() for queue in waiting.values())
