"""Run times, back to back and at the sensor's rate, and the process that measures them, with JSON on its pipes."""

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from edge.bench.subjects import FROZEN_FILE, Subject, opened
from edge.errors import EdgeError
from edge.evaluation.test_set import load_frozen_set
from firmware_bridge.schedule import Clock, Sleep, Ticker

Run = Callable[[int], object]  # one inference; its argument is a number that selects the input


@dataclass(frozen=True, slots=True)
class Times:
    """Percentiles of run times in [us]; of fewer than 1000 runs `p999_us` is the longest."""

    runs: int
    p50_us: float
    p99_us: float
    p999_us: float
    max_us: float


@dataclass(frozen=True, slots=True)
class Pace:
    """Run times at a rate."""

    times: Times
    ticks: int
    missed: int  # ticks whose run was not done, or not begun, when the next was due
    cpu_percent: float  # of the whole process, of one core


def summary(took_ns: Sequence[int]) -> Times:
    """Return the percentiles of run times in [ns]."""
    took_us = np.asarray(took_ns, dtype=np.float64) / 1e3
    p50, p99, p999 = np.percentile(took_us, [50, 99, 99.9])
    return Times(len(took_us), float(p50), float(p99), float(p999), float(took_us.max()))


def _timed(run: Run, numbers: Sequence[int], clock: Clock) -> list[int]:
    """Return the time of each of these runs, one after the other, in [ns]."""
    took_ns: list[int] = []
    for number in numbers:
        start_ns = clock()
        run(number)
        took_ns.append(clock() - start_ns)
    return took_ns


def back_to_back(run: Run, most_runs: int, clock: Clock = time.perf_counter_ns) -> Times:
    """Time as many runs as fit into two seconds, 90 at least and `most_runs` at most, one right after the other."""
    estimate_ns = max(1, min(_timed(run, range(5), clock)))
    runs = min(most_runs, max(90, 2_000_000_000 // estimate_ns))
    return summary(_timed(run, range(runs), clock))


def paced(
    run: Run,
    rate_hz: float,
    ticks: int,
    clock: Clock = time.monotonic_ns,
    sleep: Sleep = time.sleep,
    cpu_clock: Clock = time.process_time_ns,
) -> Pace:
    """Time one run at each tick from 1 on, idle between; ticks that pass during a longer run have none."""
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


def main() -> int:
    """Do the job on stdin; returns 1, with a line on stderr, where it cannot be done."""
    try:
        result = _time(**json.load(sys.stdin))
    except EdgeError as error:
        sys.stderr.write(f"{' '.join(str(error).split())}\n")
        return 1
    sys.stdout.write(json.dumps(result))
    return 0


def _time(subject: dict[str, Any], rate_hz: float, ticks: int) -> dict[str, Any]:
    """Return run times on the test set's windows in turn, with all taps that there are."""
    frozen = load_frozen_set(FROZEN_FILE)
    windows = frozen.windows(1 + frozen.earlier.shape[1])
    infer = opened(Subject(**subject))

    def run(number: int) -> object:
        return infer(windows[number % len(windows)])

    return {"back_to_back": asdict(back_to_back(run, ticks)), "paced": asdict(paced(run, rate_hz, ticks))}
