"""When to step to a faster model, and when back: pure, fed with the run time of every pattern.

Time is counted while there are patterns: a pause is no evidence, neither that the machine is slow nor that it has
become fast again, and a robot that taps for half a second at a time gathers its second over several taps.

Down, when more than half of the patterns of the last such second were over the budget, that is, when the median is; a
hiccup, however long, is one pattern. Up, when for five such seconds the 99th percentile of the rung above, as it was
calibrated times the present slow-down, was within the budget. Between the median that takes a rung away and the 99th
percentile that gives it back there is room for noise, so a steady load does not make it go up and down; under a load
that comes and goes, every step up that did not last for a minute doubles the wait for the next.
"""

from bisect import bisect_left, bisect_right, insort
from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

from edge.budgeting.model_choice import Candidate
from firmware_bridge.schedule import NS_PER_S

WINDOW_NS: Final = NS_PER_S
LONGEST_STEP_NS: Final = NS_PER_S // 10
"""A longer time between patterns counts as this long; so a second takes ten patterns at least."""
FIRST_WAIT_NS: Final = 5 * NS_PER_S
LONGEST_WAIT_NS: Final = 320 * NS_PER_S
HELD_NS: Final = 60 * NS_PER_S
"""A step up that is taken back sooner came too early."""
AS_CALIBRATED: Final = 0.1
"""By so much two calibrations of a quiet machine may differ; within it the calibrated run times stand."""


class Step(NamedTuple):
    """A change of model.

    Attributes:
        rung: index of the new one.
        why: in one line, with the names of both.
    """

    rung: int
    why: str


class Governor:
    """Watches run times on one rung of a ladder, and says when to change it.

    Attributes:
        rung: index of the present one.
    """

    def __init__(self, ladder: Sequence[Candidate], rung: int, budget_us: float) -> None:
        """Start on a rung.

        Args:
            ladder: fastest first, each with less error than those below.
            rung: index of the one that runs.
            budget_us: longest run time of a pattern, in [us].

        Raises:
            IndexError: no such rung.
        """
        if not 0 <= rung < len(ladder):
            raise IndexError(f"rung {rung}, expected one of 0 to {len(ladder) - 1}")
        self.rung = rung
        self._ladder = tuple(ladder)
        self._budget_us = budget_us
        self._wait_ns = FIRST_WAIT_NS
        self._last_ns: int | None = None
        self._went_up = False
        self._arrive()

    @property
    def present(self) -> Candidate:
        """The candidate that runs."""
        return self._ladder[self.rung]

    def watch(self, time_ns: int, run_time_us: float) -> Step | None:
        """Hear of one pattern; a step that is returned is taken.

        Args:
            time_ns: monotonic, when the pattern was done, in [ns]. Time that runs backwards counts as no time.
            run_time_us: of its inference by the present rung, in [us].
        """
        if self._last_ns is not None:
            self._here_ns += min(max(time_ns - self._last_ns, 0), LONGEST_STEP_NS)
        self._last_ns = time_ns
        self._remember(run_time_us)
        if self._here_ns < WINDOW_NS:
            return None
        if self._went_up and self._here_ns >= HELD_NS:
            self._wait_ns = FIRST_WAIT_NS
        return self._down() or self._up()

    def _remember(self, run_time_us: float) -> None:
        self._window.append((self._here_ns, run_time_us))
        insort(self._sorted_us, run_time_us)
        while self._window[0][0] <= self._here_ns - WINDOW_NS:
            _, oldest_us = self._window.popleft()
            del self._sorted_us[bisect_left(self._sorted_us, oldest_us)]

    def _down(self) -> Step | None:
        patterns = len(self._sorted_us)
        missed = patterns - bisect_right(self._sorted_us, self._budget_us)
        if self.rung == 0 or 2 * missed <= patterns:
            return None
        if self._went_up and self._here_ns < HELD_NS:
            self._wait_ns = min(2 * self._wait_ns, LONGEST_WAIT_NS)
        self._went_up = False
        why = f"budget of {self._budget_us:g} us missed in {missed} of {patterns} patterns of the last second"
        return self._step(self.rung - 1, "down", why)

    def _up(self) -> Step | None:
        if self.rung == len(self._ladder) - 1:
            return None
        above = self._ladder[self.rung + 1]
        slow_down = self._sorted_us[len(self._sorted_us) // 2] / self.present.p50_us
        if abs(slow_down - 1) <= AS_CALIBRATED:
            slow_down = 1.0
        expected_us = slow_down * above.p99_us
        if expected_us > self._budget_us:
            self._no_room_ns = self._here_ns
        if self._here_ns - self._no_room_ns < self._wait_ns:
            return None
        self._went_up = True
        why = f"p99 of {expected_us:.0f} us expected, within {self._budget_us:g} us for {self._wait_ns / NS_PER_S:g} s"
        return self._step(self.rung + 1, "up", why)

    def _step(self, rung: int, direction: str, why: str) -> Step:
        before, self.rung = self.present, rung
        self._arrive()
        return Step(rung, f"stepped {direction} from {before.name} to {self.present.name}: {why}")

    def _arrive(self) -> None:
        """Forget what was seen of another rung."""
        self._here_ns = 0
        self._no_room_ns = 0
        self._window: deque[tuple[int, float]] = deque()
        self._sorted_us: list[float] = []
