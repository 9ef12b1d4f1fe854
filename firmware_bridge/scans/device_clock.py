"""A device's time stamps on the host's clock. No I/O, no clock of its own.

A stamp tells when a frame was on the bus, an arrival when it was read: later by what adapter, bus and kernel took,
which is never less than nothing. So the smallest difference of late is the best guess of how the two clocks lie to
each other, and what goes beyond it is delay. Of late, since two quartzes part by milliseconds in a minute.
"""

from typing import Final, NamedTuple

WINDOW_NS: Final = 10_000_000_000
"""The smallest difference is that of this window and the one before: clocks 100 ppm apart are 2 ms off after both."""
BACK_NS: Final = 4_000_000
"""A stamp that falls back further is of a clock that was set or began anew; frames that change places, in a driver's
queues, do by less than a millisecond. A wall clock that is set back between two frames by less than this and the
pause between them goes unseen until the windows have passed: at 100 scans a second by 14 ms, and one scan then seems
missing."""


class DeviceTime(NamedTuple):
    """When something was on the bus.

    Attributes:
        host_ns: by the host's monotonic clock, in [ns], as well as is known by then.
        own_ns: by the device's own, from any beginning, in [ns]: what pauses are measured by, since the guess how the
            two clocks lie to each other may change between two stamps.
    """

    host_ns: int
    own_ns: int


class DeviceClock:
    """Maps stamps of one device, which may wrap round, to the host's monotonic time.

    Attributes:
        restarts: how often the device's clock began anew.
        begun_ns: monotonic time of the arrival by which the two clocks were first compared, since the last restart, in
            [ns]; None before there is one. Had it lain unread, it would seem new nevertheless.
    """

    def __init__(self, tick_ns: int, wrap_ticks: int | None) -> None:
        """Know nothing yet.

        Args:
            tick_ns: of a stamp, in [ns].
            wrap_ticks: stamps go from 0 to one less than this, then begin again; None if they never do.
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

    def host_ns(self, stamp: int, arrival_ns: int) -> int:
        """The same as `at`, by the host's clock alone."""
        return self.at(stamp, arrival_ns).host_ns

    def at(self, stamp: int, arrival_ns: int) -> DeviceTime:
        """When a frame was on the bus; never later than it arrived.

        Args:
            stamp: the device's, in ticks.
            arrival_ns: monotonic time at which the frame was read, in [ns], never before that of the frame before.
        """
        stamp_ns = stamp * self._tick_ns
        step_ns = stamp_ns - self._stamp_ns
        if self._wrap_ns is not None:
            # As many turns as bring it nearest to the time that went by here: a link may have been silent for hours.
            turns = round((arrival_ns - self._arrival_ns - step_ns) / self._wrap_ns)
            step_ns += turns * self._wrap_ns
        if self._smallest_ns is not None and step_ns < -BACK_NS:
            self.restarts += 1
            self._smallest_ns = self._smallest_before_ns = None
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
