"""The deadline of a pattern: one period of its sensor after its scan. No I/O, no clock."""

from bisect import bisect_left, insort
from collections import deque
from typing import Final

REMEMBERED_INTERVALS: Final = 31
FEWEST_INTERVALS: Final = 5
"""Fewest intervals that give a period."""
BURST_SHARE: Final = 8
"""Divisor of the period: scans nearer to each other than an eighth of it were held up. Bursts of all sixteen frames,
16 ms apart, are further apart."""
LONGEST_BURST: Final = 500
"""Scans of a burst: five seconds of a sensor at 100 Hz; a longer one is the sensor's own pace."""
NS_PER_S: Final = 1_000_000_000


class Deadline:
    """Deadline of one sensor's patterns on the sensor's own time grid: scans come when the sensor sends them.

    The period is the running median of the intervals between scans, which neither jitter nor a gap moves, unless a
    rate is given.

    Attributes:
        period_ns: between scans, in [ns]; None as long as too few have arrived.
    """

    def __init__(self, rate_hz: float | None = None) -> None:
        """Start without a scan; `rate_hz` is the sensor's rate in [Hz], None if unknown."""
        self.period_ns = None if rate_hz is None else round(NS_PER_S / rate_hz)
        self._known = rate_hz is not None
        self._intervals: deque[int] = deque()
        self._sorted: list[int] = []
        self._last_ns: int | None = None
        self._hurried = 0

    def follow(self, scan_time_ns: int) -> None:
        """Take the arrival of the next scan, pattern or not, in [ns]; a time that stands still gives no interval."""
        last_ns, self._last_ns = self._last_ns, scan_time_ns
        if last_ns is None or scan_time_ns <= last_ns:
            return
        interval_ns = scan_time_ns - last_ns
        # Held up somewhere, it came right behind the one before; unless all of late did.
        hurried = self.period_ns is not None and interval_ns * BURST_SHARE < self.period_ns
        self._hurried = self._hurried + 1 if hurried else 0
        if self._hurried > LONGEST_BURST:
            self._intervals.clear()
            self._sorted.clear()
            self.period_ns = self.period_ns if self._known else None
        elif hurried:
            return
        if len(self._intervals) == REMEMBERED_INTERVALS:
            del self._sorted[bisect_left(self._sorted, self._intervals.popleft())]
        self._intervals.append(interval_ns)
        insort(self._sorted, interval_ns)
        if not self._known and len(self._sorted) >= FEWEST_INTERVALS:
            self.period_ns = self._sorted[len(self._sorted) // 2]

    def check(self, latency_us: float) -> bool:
        """Return whether a pattern missed its deadline, so long after its scan in [us]; never without a period."""
        return self.period_ns is not None and latency_us * 1e3 > self.period_ns
