"""Rate at which scans arrive, smoothed."""

from typing import Final

SMOOTHING: Final = 0.05


class Rate:
    """Rate of scans a second, smoothed over about twenty scans.

    Attributes:
        rate_hz: None before the second scan.
    """

    def __init__(self) -> None:
        self.rate_hz: float | None = None
        self._period_ns: float | None = None
        self._last_ns: int | None = None

    def add(self, time_ns: int) -> None:
        """Take the time of the next scan, in [ns]."""
        if self._last_ns is not None and time_ns > self._last_ns:
            period_ns = time_ns - self._last_ns
            if self._period_ns is None:
                self._period_ns = period_ns
            self._period_ns += SMOOTHING * (period_ns - self._period_ns)
            self.rate_hz = 1e9 / self._period_ns
        self._last_ns = time_ns
