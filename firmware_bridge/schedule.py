"""Deadlines on an absolute grid, on an injected clock."""

import math
import time
from collections.abc import Callable
from typing import Final

NS_PER_S: Final = 1_000_000_000

Clock = Callable[[], int]
"""Monotonic time in [ns]."""
Sleep = Callable[[float], object]
"""Sleeps for a time in [s]; may come back early or late."""


def sleep_until(deadline_ns: int, clock: Clock = time.monotonic_ns, sleep: Sleep = time.sleep) -> int:
    """Sleep until `deadline_ns`; returns the time at waking, in [ns]. Past deadlines return at once."""
    while (now_ns := clock()) < deadline_ns:
        sleep((deadline_ns - now_ns) / NS_PER_S)
    return now_ns


class Ticker:
    """Ticks at start + n / rate. A late tick does not move the ones after it.

    Attributes:
        late: ticks that were already past when they were asked for.
        skipped: ticks that were left out, because the next one was past as well.
    """

    def __init__(self, rate_hz: float, clock: Clock = time.monotonic_ns, sleep: Sleep = time.sleep) -> None:
        if not (math.isfinite(rate_hz) and rate_hz > 0):
            raise ValueError(f"rate is {rate_hz} Hz, expected a positive number")
        self.late = 0
        self.skipped = 0
        self._rate_hz = rate_hz
        self._clock = clock
        self._sleep = sleep
        self._start_ns = clock()
        self._tick = 0

    def wait(self) -> int:
        """Sleep until the next tick and return its number, from 1.

        Behind by whole periods, it leaves those ticks out and gives the newest that is past.
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
        """When a tick is due, in [ns] of the clock."""
        return self._start_ns + round(tick * NS_PER_S / self._rate_hz)
