"""Run times, back to back and at the sensor's rate, on an injected clock."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from firmware_bridge.schedule import Clock, Sleep, Ticker

_BUDGET_NS: Final = 2_000_000_000
_LEAST_RUNS: Final = 90
"""Fewest runs of a measurement, however long one takes."""

Run = Callable[[int], object]
"""One inference; its argument is a number that selects the input."""


@dataclass(frozen=True, slots=True)
class Times:
    """Run times.

    Attributes:
        runs: number of timed runs.
        p50_us: median, in [us].
        p99_us: 99th percentile, in [us].
        p999_us: 99.9th percentile, in [us]; of fewer than 1000 runs it is the longest.
        max_us: longest, in [us].
    """

    runs: int
    p50_us: float
    p99_us: float
    p999_us: float
    max_us: float


@dataclass(frozen=True, slots=True)
class Pace:
    """Run times at a rate.

    Attributes:
        times: of all runs.
        ticks: number of ticks.
        missed: number of ticks whose run was not done, or not even begun, when the next one was due.
        cpu_percent: processor time of the whole process, in [% of one core].
    """

    times: Times
    ticks: int
    missed: int
    cpu_percent: float


def summary(took_ns: Sequence[int]) -> Times:
    """Return the percentiles of run times in [ns]."""
    took_us = np.asarray(took_ns, dtype=np.float64) / 1e3
    p50, p99, p999 = np.percentile(took_us, [50, 99, 99.9])
    return Times(len(took_us), float(p50), float(p99), float(p999), float(took_us.max()))


def timed(run: Run, numbers: Sequence[int], clock: Clock = time.perf_counter_ns) -> list[int]:
    """Return the time of each of these runs, one after the other, in [ns]."""
    took_ns: list[int] = []
    for number in numbers:
        start_ns = clock()
        run(number)
        took_ns.append(clock() - start_ns)
    return took_ns


def back_to_back(run: Run, most_runs: int, clock: Clock = time.perf_counter_ns) -> Times:
    """Time as many runs as fit into two seconds, 90 at least and `most_runs` at most, one right after the other."""
    estimate_ns = max(1, min(timed(run, range(5), clock)))
    runs = min(most_runs, max(_LEAST_RUNS, _BUDGET_NS // estimate_ns))
    return summary(timed(run, range(runs), clock))


def paced(
    run: Run,
    rate_hz: float,
    ticks: int,
    clock: Clock = time.monotonic_ns,
    sleep: Sleep = time.sleep,
    cpu_clock: Clock = time.process_time_ns,
) -> Pace:
    """Time one run at each tick, idle between; ticks that pass during a longer run have none.

    Args:
        run: called with the tick's number, from 1.
        rate_hz: of the ticks, in [Hz].
        ticks: number of ticks.
        clock: in [ns].
        sleep: to the next tick.
        cpu_clock: processor time of the process, in [ns].
    """
    took_ns: list[int] = []
    in_time = 0
    cpu_before_ns, before_ns = cpu_clock(), clock()
    ticker = Ticker(rate_hz, clock, sleep)
    tick = min(ticker.wait(), ticks)  # one at least, even if the machine stands still from the first on
    while tick <= ticks:
        start_ns = clock()
        run(tick)
        end_ns = clock()
        took_ns.append(end_ns - start_ns)
        in_time += end_ns <= ticker.deadline_ns(tick + 1)
        tick = ticker.wait()
    wall_ns = clock() - before_ns
    cpu_percent = 100 * (cpu_clock() - cpu_before_ns) / wall_ns
    return Pace(summary(took_ns), ticks, ticks - in_time, cpu_percent)
