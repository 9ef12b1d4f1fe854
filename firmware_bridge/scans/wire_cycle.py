"""Cycle of a sensor on the wire, as the stream shows it: the order of its taxels, and the longest pause within it.

Nothing marks the beginning of a cycle. Two things show it: the bus pauses between cycles, and the order of the taxels,
which is the same each time, wraps round. By default the order is that of the ids. A sensor with another order gives
fragments; then its cycles are cut by pauses alone, until two in a row came in the same order, which is then the
sensor's.

A pause within a cycle counts where whole cycles may have been lost meanwhile, so from half a period on. While the
order is to be learnt, the readings alone show the pauses, and an eighth of a period is one.
"""

from collections import deque
from collections.abc import Sequence
from typing import Final

from firmware_bridge.scans.can_id_maps import Cycle

LONGEST_PAUSE_NS: Final = 60_000_000
"""Longest pause between two readings of one scan, whatever the period, in [ns]: the slowest sensor on record has 17 ms
there, and an FTDI chip holds bytes back for 16. After a longer one, as when the bus was off, a reading may belong to
another press."""
SHORTEST_PAUSE_NS: Final = 1_500_000
"""Shortest time that counts as a pause, in [ns]: stamps and adapters with steps of 1 ms show less without one."""
WINDOW_NS: Final = 250_000_000
"""Time over which the period is averaged, in [ns]: jitter or a burst after a stall hardly changes the mean."""
MOST_DOUBTS: Final = 8
"""Signs of another order in a row, without a whole cycle between them, after which the order is dropped."""
HARMLESS_PLACES: Final = 4
"""Number of places with a pause before the very next taxel from which pauses count as late reads without lost frames.

For pauses of the bus the chance of that would be one in 65,000."""


class WireCycle:
    """Learnt properties of one sensor's cycle.

    Attributes:
        order: taxels in their order of arrival; empty while it is not learnt.
        places: place of each taxel in a cycle; NOWHERE for all while the order is not learnt.
        pause_ns: longest pause between two readings of one cycle, in [ns].
        doubts: signs of another order in a row; a whole cycle resets them.
        gaps_ns: gaps between the newest readings, of one cycle at most, in [ns]; None where they are not needed.
        period_ns: time from cycle to cycle, in [ns], by the clock of the pauses; None until it is measured.
        awaited: a cycle in this order that came as one, so that the next one like it is recognised at once.
    """

    NOWHERE: Final = -9

    def __init__(self, order: Sequence[int]) -> None:
        """Start with this order, which holds until the stream shows another."""
        self.pause_ns = LONGEST_PAUSE_NS
        self._length = len(order)
        self.gaps_ns: deque[int] | None = deque(maxlen=self._length)
        self._pace_due_ns = 0
        self.doubts = 0
        self._harmless: set[int] = set()
        self._newest_order: tuple[int, ...] = ()
        self.period_ns: int | None = None
        self._paced: tuple[int, int] | None = None
        self._cycles = 0
        self._learn(tuple(order))

    def begin_anew(self) -> None:
        """Restart the measurement of times after the link broke."""
        self._paced, self._pace_due_ns, self._newest_order = None, 0, ()

    def goes_on(self, newest: int, place: int, *, came: bool, paused: bool, stamped: bool) -> bool:
        """Return True if a reading belongs to the open cycle.

        Args:
            newest: the furthest place in the cycle so far.
            place: place of the reading.
            came: True if the cycle has a reading of this taxel already.
            paused: True if a pause came before the reading.
            stamped: True if the pause is by the device's time, and so one of the bus and not a late read.
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
        """Derive the limit of pauses from the gaps between readings, until cycles show the period."""
        if self.gaps_ns is not None and 0 <= gap_ns <= LONGEST_PAUSE_NS:
            self.gaps_ns.append(gap_ns)
            cycle_ns = sum(self.gaps_ns) * self._length // len(self.gaps_ns)
            self.pause_ns = min(max(cycle_ns // (2 if self.order else 8), SHORTEST_PAUSE_NS), LONGEST_PAUSE_NS)

    def doubt(self) -> None:
        """Count a sign of another order."""
        self.doubts += 1
        if self.doubts >= MOST_DOUBTS:
            self._learn(())

    def close_whole(self, taxels: Sequence[int]) -> None:
        """Process a whole cycle, its taxels in their order of arrival."""
        self.doubts = 0
        if not self.order:
            before, self._newest_order = self._newest_order, tuple(taxels)
            if before == self._newest_order:
                self._learn(before)

    def count(self, time_ns: int) -> None:
        """Count a cycle of at least half of the taxels that ended at `time_ns` [ns], by the clock of the pauses."""
        self._cycles += 1
        if time_ns < self._pace_due_ns:
            return
        if self._paced is not None:
            then_ns, then = self._paced
            period_ns = (time_ns - then_ns) // (self._cycles - then)
            if period_ns == 0:  # read in one piece, without stamps: the period is not visible
                return
            # The shorter of two in a row: one during which the bus was off for a time is too long.
            shorter_ns = period_ns if self.period_ns is None else min(period_ns, self.period_ns)
            self.pause_ns = min(max(shorter_ns // 2, SHORTEST_PAUSE_NS), LONGEST_PAUSE_NS)
            self.period_ns, self.gaps_ns = period_ns, None
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
            self.period_ns = self._paced = None


class _Nowhere(dict[int, int]):
    def __missing__(self, taxel: int) -> int:
        return WireCycle.NOWHERE
