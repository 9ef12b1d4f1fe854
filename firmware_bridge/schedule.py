"""Deadlines on an absolute grid, and times without data after which the bridge reacts.

The slowest sensor on record renews a taxel four times a second, so a quarter of a second without a reading is no
silence; and an adapter hands on its data after 16 ms at the latest.
"""

import time
from collections.abc import Callable
from typing import Final

LAST_TIME_NS: Final = 1 << 60  # latest time in a recording, in [ns] (36 years): sums of two times stay below 2^63
NS_PER_S: Final = 1_000_000_000
RATE_HZ: Final = 100.0  # of a uSPa44: at which run times are measured, and demos are made
POSITIVE: Final = (1e-9, 1e9)  # positive numbers that a user may give: others have no use, and no room in nanoseconds

Clock = Callable[[], int]  # clock of monotonic time, in [ns]
Sleep = Callable[[float], object]  # function that sleeps for a time in [s]; may return early or late


def sleep_until(deadline_ns: int, clock: Clock = time.monotonic_ns, sleep: Sleep = time.sleep) -> int:
    """Sleep until `deadline_ns` and return the time at waking, in [ns]; at once if the deadline is past."""
    while (now_ns := clock()) < deadline_ns:
        sleep((deadline_ns - now_ns) / NS_PER_S)
    return now_ns


class Ticker:
    """Source of ticks at start + n / rate: a late tick does not move the ones after it."""

    def __init__(self, rate_hz: float, clock: Clock = time.monotonic_ns, sleep: Sleep = time.sleep) -> None:
        self._rate_hz, self._clock, self._sleep = rate_hz, clock, sleep
        self._start_ns = clock()
        self._tick = 0

    def wait(self) -> int:
        """Sleep until the next tick and return its number, from 1; at once if it is late, without those long past."""
        newest = int((self._clock() - self._start_ns) * self._rate_hz / NS_PER_S)
        self._tick = max(self._tick + 1, newest)
        sleep_until(self.deadline_ns(self._tick), self._clock, self._sleep)
        return self._tick

    def deadline_ns(self, tick: int) -> int:
        """Return the time at which a tick is due, in [ns] of the clock."""
        return self._start_ns + round(tick * NS_PER_S / self._rate_hz)


SLOWEST_PERIOD_NS: Final = 250_000_000  # time between two scans of the slowest sensor on record, in [ns]

# ---- A sensor: times after which something happens ----

# Without a scan a sensor is reported silent, if another one goes on; without a pose, after one that does not hold, its
# source is: some scans were without one by then.
SENSOR_SILENT_NS: Final = 2 * SLOWEST_PERIOD_NS
TAPS_FORGOTTEN_NS: Final = 4 * SLOWEST_PERIOD_NS  # without a scan: earlier taps are dropped, as a tap is over by then
SERVER_READING_OLD_NS: Final = 4 * SLOWEST_PERIOD_NS  # age of a reading of the vendor's server: its sensor is silent
TAXEL_SILENT_SCANS: Final = 50  # scans without a taxel after which its loss is reported, and zeroing goes on without it
LATEST_SCAN_S: Final = 2.0  # age of the last scan at the end of its watch above which the doctor reports a sensor

# ---- A link ----

LINK_SILENT_S: Final = 0.7  # without a scan, after which a link is opened again: a little more than a sensor's silence
ADAPTER_ASKED_NS: Final = 500_000_000  # without a scan: an adapter's status, which can explain it, is requested

# ---- A person, or a program that waits ----

SHOWN_SILENT_S: Final = 1.0  # without a scan: status line and diagnostics report it; below, they would flicker
SHOWN_AT_REST_S: Final = 0.1  # for which scans at rest may wait: the status line is rewritten as seldom
GIVEN_UP_S: Final = 10.0  # without a scan: zeroing and the doctor give up; a sensor just plugged in has come by then
# Longest time until a stop, a command or a silent link is noticed: waits for scans are cut in such pieces. Scans at
# rest come more often, so that these waits seldom end before them: each end wakes two threads.
POLL_S: Final = 0.25
