"""Pace of reading: late where no one needs scans at once, since to wake up for each costs more than to decode it.

Where the processor slept before, a scan costs what fetching its code takes. So the scans of many sensors are read
together a few times a period. While no sensor is touched, and every sink can wait, bytes are only taken once a period,
and made into scans together some periods later. Which scans they make, and with which times, does not depend on that:
each piece keeps the time at which it was taken.
"""

import math
from typing import Final, NamedTuple

from edge.perception.result import Result
from firmware_bridge.scans.scan import Scan

TOGETHER_SENSORS: Final = 4
"""Fewest sensors whose scans are read together."""
READS_A_PERIOD: Final = 4
"""Reads of many sensors in a period."""
SHORTEST_REST_S: Final = 0.005
"""Shortest period, in [s], of sensors that rest: faster ones give their scans at once."""
LONGEST_PERIOD_S: Final = 0.05
"""Period from which scans come too seldom to be read together, in [s]."""
SAME_SHARE: Final = 0.1
"""Share by which a measured period may change before links are read at another pace."""
RESTLESS_NS: Final = 1_000_000_000
"""Time after a contact, in [ns], during which every scan is still read at once."""


class Pace(NamedTuple):
    """Times of reading, the same for all links.

    Attributes:
        every_s: time between two reads, in [s]; 0: as scans come.
        reads: number of reads after which bytes are made into scans.
    """

    every_s: float = 0.0
    reads: int = 1


class PaceSetter:
    """Chooser of the pace, by the results.

    Attributes:
        pace: the pace chosen last.
    """

    def __init__(self, patience_s: float) -> None:
        """Begin with reading as scans come; those at rest may wait for `patience_s` [s]."""
        self.pace = Pace()
        self._patience_s = patience_s
        self._restless_ns = self._newest_ns = -RESTLESS_NS
        self._waited_ns = 0.0

    def follow(self, result: Result) -> None:
        """Take the next result; only time stamps show pauses that a late read hides."""
        self._newest_ns = result.scan.time_ns
        if result.state != "idle" or result.scan.device_ns is None:
            self._restless_ns = self._newest_ns

    def waited(self, scan: Scan) -> bool:
        """Return True if a scan came late because of the pace, so that its pattern is no worse for being late."""
        return scan.time_ns < self._waited_ns

    def choose(self, sensors: int, period_s: float) -> Pace:
        """Return the pace for so many sensors of this shortest period in [s]."""
        pace, before = Pace(), self.pace
        rests = self._newest_ns - self._restless_ns > RESTLESS_NS
        if rests and SHORTEST_REST_S <= period_s < min(LONGEST_PERIOD_S, self._patience_s / 2):
            pace = Pace(period_s, int(self._patience_s / period_s))
        elif sensors >= TOGETHER_SENSORS and period_s < LONGEST_PERIOD_S:
            pace = Pace(period_s / READS_A_PERIOD)
        if (pace.reads > 1) == (before.reads > 1) and abs(pace.every_s - before.every_s) < SAME_SHARE * pace.every_s:
            return before
        if pace.reads > 1:
            self._waited_ns = math.inf
        elif before.reads > 1:
            self._waited_ns = self._newest_ns + 2e9 * before.every_s
        self.pace = pace
        return pace
