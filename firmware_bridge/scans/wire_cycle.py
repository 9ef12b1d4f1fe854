"""Cycle of a sensor on the wire, as the stream shows it: the order of its taxels, and the longest pause within it.

Nothing marks the beginning of a cycle. Two things show it: the bus pauses between cycles, and the order of the taxels,
by default that of the ids, wraps round. A sensor with another order gives fragments; then its cycles are cut by pauses
alone, until two in a row came in the same order, which is then the sensor's.

A pause within a cycle ends it where whole cycles may have been lost meanwhile, so from half a period on, of the shorter
ones, as a lost cycle makes them longer. Until there are enough, the shortest time between two readings of one taxel is
the period. Limit: where nearly all cycles of the first eight are lost, two may mix.

Arrivals show no pause within what was read in one piece. There a lost cycle shows by the count: cycles end a period
apart, and a read only delays them. So one that ends late by most of a period may be of two cycles, unless a later one
ends in time; where all that follow are as late, some were lost.
"""

from collections import deque
from collections.abc import Sequence
from typing import Final

LONGEST_PAUSE_NS: Final = 60_000_000
"""Longest pause between two readings of one scan, whatever the period, in [ns]: the slowest sensor on record has 17 ms
there, and an FTDI chip holds bytes back for 16. After a longer one, as when the bus was off, a reading may belong to
another press."""
SHORTEST_PAUSE_NS: Final = 1_500_000  # that counts as one: stamps and adapters with steps of 1 ms show less without one
MOST_INTERVALS: Final = 128  # intervals between cycles that give the period
LEAST_INTERVALS: Final = 8  # intervals from which it shows lost cycles, and pauses are judged by the shorter ones
MOST_DOUBTS: Final = 8  # signs of another order in a row after which the order is dropped


class WireCycle:
    """Learnt properties of one sensor's cycle."""

    NOWHERE: Final = -9

    def __init__(self, order: Sequence[int]) -> None:
        """Start with this order, which holds until the stream shows another."""
        self.pause_ns = LONGEST_PAUSE_NS  # longest pause between two readings of one cycle
        # True if several cycles seem to end at once by that clock, so that it does not show the pauses.
        self.in_pieces = False
        self._length = len(order)
        # Gaps between the newest readings, of one cycle at most, in [ns]; None where they are not needed.
        self.gaps_ns: deque[int] | None = deque(maxlen=self._length)
        self._cycle_ns, self._read_ns = self._length * LONGEST_PAUSE_NS, 0
        self._read_at_ns: dict[int, int] = {}
        self.doubts = 0  # signs of another order in a row
        self._newest_order: tuple[int, ...] = ()
        self.period_ns: int | None = None  # time from cycle to cycle, by the clock of the pauses
        self._intervals: deque[int] = deque(maxlen=MOST_INTERVALS)
        self._until_renewed = self._paused_at = 0
        self._ended_ns: int | None = None
        self._due_ns = 0
        self._later_ns = self._late = self._late_due_ns = 0
        self._learn(tuple(order))

    def begin_anew(self) -> None:
        """Restart the measurement of times after the link broke."""
        self._intervals.clear()
        self._ended_ns, self._late, self._newest_order = None, 0, ()

    def goes_on(self, newest: int, place: int, *, came: bool, paused: bool, paced: bool) -> bool:
        """Return True if a reading at a place belongs to the open cycle, whose furthest place so far is `newest`.

        `came`: the cycle has this taxel already. `paused`: a pause came before. `paced`: that may be a late read, and
        `count` will show it where cycles were lost.
        """
        if not self.order:
            return not (paused or came)
        if not paused:
            # Lost frames leave places out; two frames may have changed places.
            return place > newest or (place == newest - 1 and not came)
        if place != newest + 1:
            return False
        self.doubt()
        # The bus pauses at the same place each time where the cycle begins elsewhere; a late read may do so anywhere.
        before, self._paused_at = self._paused_at, place
        return paced and place != before

    def follow_gap(self, gap_ns: int, taxel: int) -> None:
        """Derive the limit of pauses from the gap before a reading, until cycles show the period."""
        if self.gaps_ns is None:
            return
        if not 0 <= gap_ns <= LONGEST_PAUSE_NS:
            self._read_at_ns.clear()
            return
        self.gaps_ns.append(gap_ns)
        self._read_ns += gap_ns
        # From a taxel to the same one a period passes, or several where cycles were lost: the shortest time counts.
        before_ns = self._read_at_ns.get(taxel)
        self._read_at_ns[taxel] = self._read_ns
        if before_ns is not None:
            self._cycle_ns = min(self._cycle_ns, self._read_ns - before_ns)
        cycle_ns = min(sum(self.gaps_ns) * self._length // len(self.gaps_ns), self._cycle_ns)
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

    @property
    def has_pace(self) -> bool:
        """True once the period is known so well that it shows lost cycles."""
        return self.period_ns is not None and len(self._intervals) >= LEAST_INTERVALS

    def count(self, time_ns: int, *, ended: bool = True) -> bool | None:
        """Count a cycle of at least half of the taxels that ended at `time_ns` [ns], by the clock of the pauses.

        Return True if no cycle was lost up to it, by the pace of those before; None if that does not show yet, and
        False once all come as late. One whose end was lost, not `ended`, shows nothing: it seems early.
        """
        ended_ns, self._ended_ns = self._ended_ns, time_ns
        late = self.has_pace and ended_ns is not None and time_ns - self._due_ns > self._later_ns
        if ended_ns is None or not self.has_pace:
            self._due_ns = time_ns
        if ended_ns is not None:
            self._intervals.append(time_ns - ended_ns)
            self._until_renewed -= 1
            if self._until_renewed <= 0:
                self._measure()
        period_ns, on_pace = self.period_ns or 0, None
        if not ended:
            on_pace = None
        elif not late:
            self._due_ns = min(self._due_ns + period_ns // 64, time_ns)  # since the period is an estimate
            self._late, on_pace = 0, True
        else:
            self._late += 1
            self._late_due_ns = time_ns if self._late == 1 else min(self._late_due_ns, time_ns)
            # Three in a row that end late are on their own pace; where several are read at once it takes five, since an
            # FTDI chip delays three. Not where some that waited came at once: the least late one is still to come.
            if (
                self._late >= (5 if self.in_pieces else 3)
                and ended_ns is not None
                and 2 * (time_ns - ended_ns) > period_ns
            ):
                lost = (self._late_due_ns - self._due_ns + period_ns // 4) // period_ns
                self._intervals[-1] -= lost * period_ns
                self._due_ns, self._late, on_pace = self._late_due_ns, 0, False
        self._due_ns += period_ns
        self._late_due_ns += period_ns
        return on_pace

    def _measure(self) -> None:
        usual, count = sorted(self._intervals), len(self._intervals)
        shorter_ns = usual[count // 8]
        if shorter_ns >= SHORTEST_PAUSE_NS:
            self._cycle_ns = min(self._cycle_ns, shorter_ns)
        low_ns, high_ns = usual[count // 4], usual[count - 1 - count // 4]
        self.in_pieces = low_ns < SHORTEST_PAUSE_NS < high_ns // 2  # sooner than a bus carries a cycle
        # Lost cycles make some of them longer, so the middle half counts; but all do where many are read in one piece.
        if not self.in_pieces:
            usual = usual[count // 4 : count - count // 4]
        period_ns = sum(usual) // len(usual)
        if period_ns > 0:  # if all was read in one piece, the period is not visible
            self.period_ns = period_ns
            # A lost cycle makes the next ones late by a period, which is less exact where many are read in one piece.
            self._later_ns = max(period_ns // 2 if self.in_pieces else period_ns * 3 // 4, SHORTEST_PAUSE_NS)
            # Fewer may all hold lost cycles, and none would show as a pause; but arrivals have no other measure then.
            if self.has_pace or (self.gaps_ns is not None and not self.gaps_ns):
                pause_ns = max(shorter_ns // 2, SHORTEST_PAUSE_NS)
                self.pause_ns = LONGEST_PAUSE_NS if self.in_pieces else min(pause_ns, LONGEST_PAUSE_NS)
                self.gaps_ns = None
            self._until_renewed = 32 if count == MOST_INTERVALS else 1

    def _learn(self, order: tuple[int, ...]) -> None:
        self.order = order  # taxels in their order of arrival; empty while it is not learnt
        # Place of each taxel in a cycle; NOWHERE for all while the order is not learnt.
        self.places = {taxel: place for place, taxel in enumerate(order)} if order else _Nowhere()
        self.doubts = 0
        if not order:
            self.gaps_ns, self._cycle_ns = deque(maxlen=self._length), self._length * LONGEST_PAUSE_NS
            self._read_at_ns.clear()
            self.period_ns = self._ended_ns = None
            self._intervals.clear()


class _Nowhere(dict[int, int]):
    def __missing__(self, taxel: int) -> int:
        return WireCycle.NOWHERE
