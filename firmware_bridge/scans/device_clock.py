"""Conversion of a device's time stamps to the host's clock. No I/O, no clock of its own.

A stamp is the time at which a frame was on the bus, an arrival the time at which it was read: later by the delay in
adapter, bus and kernel, which is never negative. So the smallest recent difference is the best estimate of the offset
between the two clocks, and the rest of a difference is delay. Only recent differences count, since two quartzes drift
apart by milliseconds in a minute.
"""

from typing import Final, NamedTuple

WINDOW_NS: Final = 10_000_000_000
"""Window of the smallest difference, with the one before: clocks 100 ppm apart are 2 ms off after both."""
BACK_NS: Final = 4_000_000
"""Largest step back of the stamps before the clock counts as set or restarted, in [ns].

Frames that change places in a driver's queues step back by less than a millisecond. A wall clock set back between two
frames by less than this plus the pause between them goes unnoticed until the windows have passed: at 100 scans a second
by 14 ms, and one scan then seems missing."""


class DeviceTime(NamedTuple):
    """Time at which a frame was on the bus.

    Attributes:
        host_ns: time on the host's monotonic clock, in [ns], by the estimated offset at that moment.
        own_ns: time on the device's clock, from any origin, in [ns]: pauses are measured by it, since the estimated
            offset between the two clocks may change between two stamps.
    """

    host_ns: int
    own_ns: int


class DeviceClock:
    """Map from stamps of one device, which may wrap round, to the host's monotonic time.

    Attributes:
        restarts: number of restarts of the device's clock.
        begun_ns: monotonic time of the first arrival since the last restart, which set the offset, in [ns]; None before
            it. That frame seems new even if it waited long to be read.
    """

    def __init__(self, tick_ns: int, wrap_ticks: int | None) -> None:
        """Start without a stamp.

        Args:
            tick_ns: duration of one tick of a stamp, in [ns].
            wrap_ticks: number of ticks after which stamps begin at 0 again; None if they never do.
        """
        self.restarts = 0
        self.begun_ns: int | None = None
        self._tick_ns = tick_ns
        self._wrap_ns = None if wrap_ticks is None else wrap_ticks * tick_ns
        self._stamp_ns = 0
        self._device_ns = 0
        self._arrival_ns = 0
        self._window_start_ns = 0
        self._smallest_ns: int | None = None
        self._smallest_before_ns: int | None = None

    def begin_anew(self) -> None:
        """Forget the offset after the link was opened again: the device may have counted from another origin since."""
        self.begun_ns = self._smallest_ns = self._smallest_before_ns = None

    def host_ns(self, stamp: int, arrival_ns: int) -> int:
        """Return `at` on the host's clock alone, in [ns]."""
        return self.at(stamp, arrival_ns).host_ns

    def at(self, stamp: int, arrival_ns: int) -> DeviceTime:
        """Return the time at which a frame was on the bus, never later than its arrival.

        Args:
            stamp: time stamp of the device, in ticks.
            arrival_ns: monotonic time at which the frame was read, in [ns], never before that of the frame before.
        """
        stamp_ns = stamp * self._tick_ns
        step_ns = stamp_ns - self._stamp_ns
        if self._wrap_ns is not None:
            # The number of wraps nearest to the time that passed on the host: a link may have been silent for hours.
            turns = round((arrival_ns - self._arrival_ns - step_ns) / self._wrap_ns)
            step_ns += turns * self._wrap_ns
        if self._smallest_ns is not None and step_ns < -BACK_NS:
            self.restarts += 1
            self.begin_anew()
        self._stamp_ns, self._arrival_ns = stamp_ns, arrival_ns
        self._device_ns += step_ns
        difference_ns = arrival_ns - self._device_ns
        if self._smallest_ns is None:
            self.begun_ns = self._window_start_ns = arrival_ns
            self._smallest_ns = difference_ns
        elif arrival_ns - self._window_start_ns > WINDOW_NS:
            self._smallest_before_ns, self._smallest_ns = self._smallest_ns, difference_ns
            if arrival_ns - self._window_start_ns > 2 * WINDOW_NS:  # after a silence the window before is long over
                self._smallest_before_ns = None
            self._window_start_ns = arrival_ns
        self._smallest_ns = min(self._smallest_ns, difference_ns)
        before_ns = difference_ns if self._smallest_before_ns is None else self._smallest_before_ns
        return DeviceTime(self._device_ns + min(self._smallest_ns, before_ns), self._device_ns)
