"""Deadlines on an absolute grid, on an injected clock."""

import math
import time
from collections.abc import Callable
from typing import Final

LAST_TIME_NS: Final = 1 << 60
"""Latest time in a recording, in [ns] (36 years): sums of two times stay below 2^63."""
NS_PER_S: Final = 1_000_000_000
POSITIVE: Final = (1e-9, 1e9)
"""Range of a positive number that a user gives: times and rates beyond it have no use, and no room in nanoseconds."""

Clock = Callable[[], int]
"""Clock of monotonic time, in [ns]."""
Sleep = Callable[[float], object]
"""Function that sleeps for a time in [s]; may return early or late."""


def sleep_until(deadline_ns: int, clock: Clock = time.monotonic_ns, sleep: Sleep = time.sleep) -> int:
    """Sleep until `deadline_ns` and return the time at waking, in [ns]; at once if the deadline is past."""
    while (now_ns := clock()) < deadline_ns:
        sleep((deadline_ns - now_ns) / NS_PER_S)
    return now_ns


class Ticker:
    """Source of ticks at start + n / rate: a late tick does not move the ones after it.

    It counts the ticks that were `late`, and those `skipped`, because the next one was past as well.
    """

    def __init__(self, rate_hz: float, clock: Clock = time.monotonic_ns, sleep: Sleep = time.sleep) -> None:
        if not (math.isfinite(rate_hz) and rate_hz > 0):
            raise ValueError(f"rate is {rate_hz} Hz, expected a positive number")
        self.late = self.skipped = 0
        self._rate_hz, self._clock, self._sleep = rate_hz, clock, sleep
        self._start_ns = clock()
        self._tick = 0

    def wait(self) -> int:
        """Sleep until the next tick and return its number, from 1.

        If it is late by whole periods, it leaves those ticks out and returns the newest one that is past.
        """
        self._tick += 1
        now_ns = self._clock()
        if now_ns > self.deadline_ns(self._tick):
            self.late += 1
            newest = int((now_ns - self._start_ns) * self._rate_hz / NS_PER_S)
            behind = max(0, newest - self._tick)
            self.skipped += behind
            self._tick += behind
        else:
            sleep_until(self.deadline_ns(self._tick), self._clock, self._sleep)
        return self._tick

    def deadline_ns(self, tick: int) -> int:
        """Return the time at which a tick is due, in [ns] of the clock."""
        return self._start_ns + round(tick * NS_PER_S / self._rate_hz)
