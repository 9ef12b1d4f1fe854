"""Time stamps of ROS on the monotonic clock of this machine. No I/O.

A stamp is wall time. Where the clocks of both machines agree, the offset of this machine's wall clock converts it, and
what a camera or a network delayed stays visible as such. Clocks that do not agree show it: of the poses of the last
seconds even the fastest seems to arrive before its time, or long after it. Their time is then by the smallest delay, as
for a device with a clock of its own: a constant delay is lost, but the poses keep their distances in time.
"""

import time
from collections.abc import Callable
from typing import Final

from firmware_bridge.scans.device_clock import DeviceClock

EARLY_NS: Final = 2_000_000
"""Longest time before its stamp at which a pose seems to arrive, in [ns]: the error of clocks that are synchronised."""
LATE_NS: Final = 250_000_000
"""Longest time after its stamp at which the fastest pose arrives, in [ns]: later, no scan could use it."""


def unix_offset_now_ns() -> int:
    """Return what is added to monotonic time for the time since 1970, now, in [ns]."""
    return time.time_ns() - time.monotonic_ns()


class StampClock:
    """Map from stamps of one source of poses to monotonic time.

    Attributes:
        warn: takes one line for the user where the clocks do not agree.
    """

    def __init__(self, warn: Callable[[str], object], unix_offset_ns: Callable[[], int] = unix_offset_now_ns) -> None:
        self._warn = warn
        self._unix_offset_ns = unix_offset_ns
        self._clock = DeviceClock(1, None)

    def monotonic_ns(self, stamp_ns: int | None, arrival_ns: int) -> int:
        """Return the monotonic time of a stamp in [ns], never after its arrival.

        Args:
            stamp_ns: since 1970; None or 0 where a message has none, whose time is its arrival.
            arrival_ns: monotonic.
        """
        if not stamp_ns:
            return arrival_ns
        by_arrivals_ns = self._clock.host_ns(stamp_ns, arrival_ns)
        by_wall_ns = stamp_ns - self._unix_offset_ns()
        delay_ns = by_arrivals_ns - by_wall_ns  # the smallest of the last seconds
        if -EARLY_NS <= delay_ns <= LATE_NS:
            return min(by_wall_ns, arrival_ns)
        side = "behind" if delay_ns > 0 else "ahead of"
        self._warn(
            f"the time stamps of poses are {abs(delay_ns) / 1e9:.3g} s {side} this machine's clock, so they are placed "
            "by their arrival: keep both clocks together (chrony, PTP)"
        )
        return by_arrivals_ns
