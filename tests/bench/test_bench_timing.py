"""Run times on a clock of its own, and the front."""

import numpy as np
import pytest

from edge.bench.command import front
from edge.bench.timing import back_to_back, paced, summary


class Clock:
    """Goes on when someone sleeps or works."""

    def __init__(self):
        self.now_ns = 1_000_000

    def __call__(self):
        return self.now_ns

    def sleep(self, time_s):
        self.now_ns += round(time_s * 1e9)

    def work(self, *took_ms):
        """Return a run that takes these times in turn, then always the last one, and the list of its numbers."""
        numbers = []

        def run(number):
            numbers.append(number)
            self.now_ns += round(1e6 * took_ms[min(len(numbers), len(took_ms)) - 1])

        return run, numbers


def pace(clock, run, ticks, rate_hz=100.0):
    return paced(run, rate_hz, ticks, clock, clock.sleep, cpu_clock=lambda: clock.now_ns // 4)


@pytest.mark.parametrize(
    ("took_ms", "ticks", "done", "missed"),
    [
        ((2,), 20, range(1, 21), 0),
        ((2, 12, 2), 10, range(1, 11), 1),  # not done when the next is due
        ((2, 35, 2), 10, [1, 2, 5, 6, 7, 8, 9, 10], 3),  # due at 20 ms, done at 55: 3 and 4 have passed, 5 begins late
        ((60,), 30, [1, 7, 13, 19, 25], 30),
    ],
)
def test_ticks_whose_run_is_not_done_in_time_are_missed(took_ms, ticks, done, missed):
    clock = Clock()
    run, numbers = clock.work(*took_ms)
    found = pace(clock, run, ticks)
    assert (numbers, found.missed, found.ticks, found.times.runs) == ([*done], missed, ticks, len(numbers))
    assert found.cpu_percent == pytest.approx(25)
    assert found.times.max_us == 1e3 * max(took_ms)


def test_a_machine_that_stands_still_from_the_first_still_gives_a_figure():
    clock = Clock()
    run, numbers = clock.work(1)
    asked = []

    def stalls():
        asked.append(clock.now_ns)
        clock.now_ns += 1_000_000_000 * (len(asked) == 3)  # before the first tick is waited for
        return clock.now_ns

    found = paced(run, 100.0, 10, stalls, clock.sleep, cpu_clock=lambda: 0)
    assert (found.times.runs, numbers) == (1, [10])
    assert found.missed == 10


def test_percentiles():
    took_ns = np.arange(1, 3001) * 1000
    times = summary(took_ns)
    assert times.p50_us == 1500.5
    assert (times.p99_us, times.p999_us) == pytest.approx((2970.01, 2997.001))
    assert (times.max_us, times.runs) == (3000, 3000)


@pytest.mark.parametrize(
    ("took_ms", "most", "runs"), [(1, 3000, 2000), (0.1, 3000, 3000), (200, 3000, 90), (200, 10, 10)]
)
def test_back_to_back_is_as_many_runs_as_fit(took_ms, most, runs):
    clock = Clock()
    run, _ = clock.work(took_ms)
    found = back_to_back(run, most, clock)
    assert found.runs == runs
    assert found.p50_us == took_ms * 1000


def test_the_front_is_who_is_not_beaten():
    points = [(9.0, 100.0), (5.0, 60.0), (2.0, 700.0), (2.0, 800.0), (1.9, 900.0), (5.0, 60.0)]
    assert front(points) == [False, True, True, False, True, True]
