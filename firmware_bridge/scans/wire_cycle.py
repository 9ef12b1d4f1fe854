"""A sensor's cycle on the wire, as the stream shows it: the order of its taxels, and how long a pause within may be.

Nothing marks where a cycle begins. Two things show it: the bus pauses between cycles, and the order of the taxels,
which is the same each time, wraps round. As long as nothing speaks against it the order is taken to be that of the ids.
A sensor that does not keep to it gives fragments; then its cycles are cut by pauses alone, until two in a row came in
the same order, which is then the sensor's.

A pause within a cycle counts where whole cycles may have been lost meanwhile, so from half a period on. While the
order is to be learnt it is told from the readings alone, and an eighth of a period is one.
"""

from collections import deque
from collections.abc import Sequence
from typing import Final

from firmware_bridge.scans.can_id_maps import Cycle

LONGEST_PAUSE_NS: Final = 60_000_000
"""Between two readings of one scan, whatever the period: the slowest sensor on record has 17 ms there, and an FTDI chip
keeps them for 16. After a longer one, as where the bus was off for a moment, what comes is of another press."""
SHORTEST_PAUSE_NS: Final = 1_500_000
"""A pause is longer: less is what stamps in whole milliseconds, and adapters that hand on once in one, make of none."""
WINDOW_NS: Final = 250_000_000
"""The period is the mean over so long: neither jitter nor a burst behind a stall moves that much."""
MOST_DOUBTS: Final = 8
"""Signs in a row, without one whole cycle between them, that the sensor's order is another."""
HARMLESS_PLACES: Final = 4
"""Pauses at so many places, each followed by the very next taxel: they are of our reading, and no frame was lost. Were
they of the bus, that would be one chance in 65,000."""


class WireCycle:
    """What was learnt of one sensor's cycle.

    Attributes:
        order: taxels as they come; empty while that is not known.
        places: by taxel, where it comes in a cycle; NOWHERE of all while the order is not known.
        pause_ns: between two readings of one cycle there is no longer one.
        doubts: signs in a row that the order is another; a cycle that came whole takes them away.
        gaps_ns: between the newest readings, of one cycle at most, in [ns]; None where they are not asked for.
        awaited: a cycle in this order that came as one, so that the next one like it is known at a glance.
    """

    NOWHERE: Final = -9

    def __init__(self, order: Sequence[int]) -> None:
        """Take the order to be this one as long as nothing speaks against it."""
        self.pause_ns = LONGEST_PAUSE_NS
        self._length = len(order)
        self.gaps_ns: deque[int] | None = deque(maxlen=self._length)
        self._pace_due_ns = 0
        self.doubts = 0
        self._harmless: set[int] = set()
        self._newest_order: tuple[int, ...] = ()
        self._period_ns: int | None = None
        self._paced: tuple[int, int] | None = None
        self._cycles = 0
        self._learn(tuple(order))

    def begin_anew(self) -> None:
        """Measure times anew: the link broke."""
        self._paced, self._pace_due_ns, self._newest_order = None, 0, ()

    def goes_on(self, newest: int, place: int, *, came: bool, paused: bool, stamped: bool) -> bool:
        """Whether a reading belongs to the cycle that is open.

        Args:
            newest: the furthest place in it so far.
            place: of the reading.
            came: it has one of this taxel already.
            paused: a pause came before the reading.
            stamped: by the device's time, so that it is the bus's pause and not our own.
        """
        if not self.order:
            return not (paused or came)
        if not paused:
            # Lost frames leave places out; two frames may have changed places.
            return place > newest or (place == newest - 1 and not came)
        if place != newest + 1:
            self._harmless.clear()
            return False
        self.doubt()
        if stamped:
            return False
        self._harmless.add(place)
        return len(self._harmless) >= HARMLESS_PLACES

    def follow_gap(self, gap_ns: int) -> None:
        """Tell pauses by the gaps between readings, as long as the period is not known by cycles."""
        if self.gaps_ns is not None and 0 <= gap_ns <= LONGEST_PAUSE_NS:
            self.gaps_ns.append(gap_ns)
            cycle_ns = sum(self.gaps_ns) * self._length // len(self.gaps_ns)
            self.pause_ns = min(max(cycle_ns // (2 if self.order else 8), SHORTEST_PAUSE_NS), LONGEST_PAUSE_NS)

    def doubt(self) -> None:
        """Take a sign that the order is another."""
        self.doubts += 1
        if self.doubts >= MOST_DOUBTS:
            self._learn(())

    def close_whole(self, taxels: Sequence[int]) -> None:
        """Take a whole cycle, its taxels in their order."""
        self.doubts = 0
        if not self.order:
            before, self._newest_order = self._newest_order, tuple(taxels)
            if before == self._newest_order:
                self._learn(before)

    def count(self, time_ns: int) -> None:
        """Take a cycle of half of the taxels or more that ended at `time_ns` [ns], by the clock that pauses go by."""
        self._cycles += 1
        if time_ns < self._pace_due_ns:
            return
        if self._paced is not None:
            then_ns, then = self._paced
            period_ns = (time_ns - then_ns) // (self._cycles - then)
            if period_ns == 0:  # read in one piece, without stamps: nothing tells
                return
            # The shorter of two in a row: one in which the bus was off for a time is none.
            shorter_ns = period_ns if self._period_ns is None else min(period_ns, self._period_ns)
            self.pause_ns = min(max(shorter_ns // 2, SHORTEST_PAUSE_NS), LONGEST_PAUSE_NS)
            self._period_ns, self.gaps_ns = period_ns, None
            self._pace_due_ns = time_ns + WINDOW_NS
        self._paced = time_ns, self._cycles

    def _learn(self, order: tuple[int, ...]) -> None:
        self.order = order
        self.awaited: Cycle | None = None
        self.places = {taxel: place for place, taxel in enumerate(order)} if order else _Nowhere()
        self.doubts = 0
        self._harmless.clear()
        if not order:
            self.gaps_ns = deque(maxlen=self._length)
            self._period_ns = self._paced = None


class _Nowhere(dict[int, int]):
    def __missing__(self, taxel: int) -> int:
        return WireCycle.NOWHERE
