"""Conversion of a device's time stamps to the host's clock. No I/O, no clock of its own.

A stamp is the time at which a frame was on the bus, an arrival the time at which it was read: later by the delay in
adapter, bus and kernel, which is never negative. So the smallest difference is the best estimate of the offset between
the two clocks, and the rest of a difference is delay. Where none has been as small for a while, the smallest one grows:
so a clock that is slow by up to 1.6 % is followed, and a delay that lasts is forgotten. Stamps that are no such clock
are dropped.
"""

from typing import Final, NamedTuple

SLOWER: Final = 64  # share of the time by which the smallest difference grows: 0.1 s that last are forgotten in 7 s
# Largest step back of the stamps before the clock counts as set or restarted: frames that change places in a driver's
# queues step back by less than a millisecond. A wall clock set back by less, plus the pause, goes unnoticed.
BACK_NS: Final = 4_000_000
LONGEST_STEP_NS: Final = 20_000_000  # most that counts between two arrivals: a late read is no evidence of a slow clock
# Judgements in a row by which stamps advance twice as far as arrivals, or too slowly while reads were late: a backlog
# makes it so once, and so does a machine that stood still.
MOST_OFF: Final = 3
SLOW_NS: Final = 10_000_000_000  # without a difference as small as the smallest, after which the clock is too slow


class DeviceTime(NamedTuple):
    """Time at which a frame was on the bus."""

    host_ns: int  # on the host's monotonic clock, by the estimated offset at that moment
    own_ns: int  # on the device's clock, from any origin: pauses are measured by it, since the offset may change


class DeviceClock:
    """Map from stamps of one device, which may wrap round, to the host's monotonic time."""

    def __init__(self, tick_ns: int, wrap_ticks: int | None) -> None:
        """Start without a stamp; ticks, of `tick_ns` [ns], wrap at `wrap_ticks`, None if they never do."""
        # Arrival that set the offset, in [ns]; its frame seems new even if it waited long to be read.
        self.begun_ns: int | None = None
        self.dropped = False  # True once the stamps have shown that they are no clock
        self._tick_ns = tick_ns
        self._wrap_ns = None if wrap_ticks is None else wrap_ticks * tick_ns
        self._stamp_ns = 0
        self._device_ns = 0
        self._arrival_ns = 0
        self._smallest_ns = self._later_ns = 0
        self._heard_ns = self._heard_whole_ns = self._told_ns = 0
        self._back = self._fast = self._slow = 0
        self._read_late = False

    def begin_anew(self) -> None:
        """Forget the offset after the link was opened again: the device may have counted from another origin since."""
        self.begun_ns = None

    def host_ns(self, stamp: int, arrival_ns: int) -> int:
        """Return `at` on the host's clock alone, in [ns], whatever the stamps are."""
        self._step(stamp, arrival_ns)
        return self._device_ns + self._smallest_ns

    def at(self, stamp: int, arrival_ns: int) -> DeviceTime | None:
        """Return the time at which a frame was on the bus, never after its arrival; None if stamps are no clock."""
        if self.dropped:
            return None
        begun, since_ns = self.begun_ns is not None, arrival_ns - self._arrival_ns
        step_ns = self._step(stamp, arrival_ns)
        if begun:
            self._judge(step_ns, since_ns)
        return DeviceTime(self._device_ns + self._smallest_ns, self._device_ns)

    def _step(self, stamp: int, arrival_ns: int) -> int:
        """Advance to a stamp, and return by how much, in [ns]."""
        stamp_ns = stamp * self._tick_ns
        step_ns, since_ns = stamp_ns - self._stamp_ns, arrival_ns - self._arrival_ns
        if self._wrap_ns is not None:
            # The number of wraps nearest to the time that passed on the host: a link may have been silent for hours.
            step_ns += round((since_ns - step_ns) / self._wrap_ns) * self._wrap_ns
        if self.begun_ns is not None and step_ns < -BACK_NS:
            self.begin_anew()
        self._stamp_ns, self._arrival_ns = stamp_ns, arrival_ns
        self._device_ns += step_ns
        difference_ns = arrival_ns - self._device_ns
        self._later_ns += min(since_ns, LONGEST_STEP_NS)
        # It holds for a quarter of a second: a clock that is slow by 1 % is 2.5 ms off after it. For up to a second
        # this machine may have stood still, which makes no clock slow.
        if self._later_ns > 250_000_000 or since_ns > SLOW_NS:
            self._smallest_ns += (since_ns if since_ns > 1_000_000_000 else min(since_ns, LONGEST_STEP_NS)) // SLOWER
        if self.begun_ns is None or difference_ns <= self._smallest_ns:
            self._smallest_ns, self._later_ns = difference_ns, 0
        if self.begun_ns is None:
            self.begun_ns = arrival_ns
        return step_ns

    def _judge(self, step_ns: int, since_ns: int) -> None:
        """Drop the stamps if they step back, stand still, or run at another rate than arrivals."""
        heard_ns = min(since_ns, LONGEST_STEP_NS)
        self._heard_ns += heard_ns
        self._heard_whole_ns += since_ns
        self._told_ns += step_ns if step_ns > -BACK_NS else since_ns  # one set back tells nothing of its rate
        self._read_late |= since_ns > LONGEST_STEP_NS
        self._back += 2 * step_ns < -BACK_NS  # on the bus one frame came after the other
        self.dropped |= self._back >= 8
        if self._heard_ns >= 50_000_000:
            # A serial line of 115,200 baud is 4 times slower than its bus, and stamps in units of 10 ms are 10 times
            # too slow.
            slow = 6 * self._told_ns < self._heard_ns
            fast = self._told_ns > 2 * self._heard_whole_ns + LONGEST_STEP_NS
            self._fast = self._fast + 1 if fast else 0
            self._slow = 0 if not slow else self._slow + 1 if self._read_late else MOST_OFF
            self._heard_ns = self._heard_whole_ns = self._told_ns = self._back = 0
            self._read_late = False
        self.dropped |= max(self._slow, self._fast) >= MOST_OFF or self._later_ns > SLOW_NS
