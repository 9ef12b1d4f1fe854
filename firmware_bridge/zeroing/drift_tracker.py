"""Drift of a free pad, followed while nothing touches it.

A press is local, drift is common: of thousands of simulated taps none moves the median taxel without moving another
by more than that again, on z, and by twice that on x and y; a warming pad moves all taxels alike but for a quarter, the
earth's field all but for their gains. So what is common to all taxels is followed fast, what is a taxel's own only as
far as a share of the common explains it, and beyond that at a creep. Whatever a taxel does beyond that is a touch, long
before it is a tap, and stops it all.

It is done in blocks of half a second: a scan costs next to nothing, and a median neither hears noise nor a reading far
off. A block counts once the next one was free, too: what a contact begins with is not followed.

A press so slow and so even that it is drift by all of this cannot be told from drift, and is eaten. Simulated taps that
grow to 1500 counts of summed z in 10 s lose .2 % where they are of middling evenness and 4 % where they are the most
even of all; in 30 s 14 and 44 %.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.geometry import AXES
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import Baseline, deformation

BLOCK_NS: Final = 500_000_000
SAMPLE_NS: Final = 25_000_000
"""Between scans of a block: twenty are enough for a median that is off by a third of the noise, and cost a fifth."""
FEWEST_SCANS: Final = 8
"""In a block, which lasts longer for it where scans are rare."""
GAP_NS: Final = 5_000_000_000
"""Without a scan, after which the pad may be another one, or the same elsewhere."""
REST_BLOCKS: Final = 4
"""Two seconds of stillness before anything is followed, and before a rest level is compared: the pad has recovered from
all but the last hundredth of a press by then, and a robot that taps every few seconds still leaves so much."""
COMMON_PER_S: Final = 20.0
"""Of what is common to all taxels, on each axis: 1000 counts in a minute, more than the field has shown, and more."""
COMMON_COUNTS: Final = 50.0
"""The most by which all taxels may be ahead of what is followed: a pad turned over in the earth's field moves by twice
its 18 counts; twice that margin is still half of what makes a contact. More at once is a touch."""
OWN_SHARE: Final = 0.65
"""A taxel's own drift to the common one: a quarter of the mean taxel's is the spread of it, so that twice that may be
six tenths of the median taxel's. A press has above one."""
OWN_PER_S: Final = 0.05
"""Of what is a taxel's own beyond that share: 3 counts a minute. There is no figure in the field that asks for more,
and what it eats of a touch before that is seen is a count or so."""
TOUCH_COUNTS: Final = 10.0
"""By which a taxel may be ahead of the common drift: .01 N on it, nine times the noise of a block at its loudest."""
RATE_S: Final = 2.0
"""Over which the rate of the common drift is smoothed: a taxel's share of it must not be a share of noise."""
NOISE_PER_S: Final = 0.2
"""Rate that noise makes: four of its deviations."""
SLOW_PER_S: Final = 1.0
"""Common drift by which a taxel that may be touched is not followed on its own."""
STILL_COUNTS: Final = 7.0
"""By which blocks of a pad at rest differ: the loudest known noise is 4.7 counts, that of two blocks' change 1.6."""
STEP_COUNTS: Final = 15.0
"""A change of rest level over a contact that the user is told of: above what noise and the last of a recovery make. A
smaller one that is a taxel's own stays in the readings all the same, a common one is followed."""
BACK_COUNTS: Final = 8.0
"""Of a step, below which there is none: what is left is followed. Less than what is a touch."""
VOTE_COUNTS: Final = 4.0
"""Of a step, up to which a taxel tells what is common: what noise makes."""
FEWEST_VOTERS: Final = 4

_ZEROED: Final = "since it was zeroed"
_BACK: Final = "rest level is back where it was"


@dataclass(frozen=True, slots=True)
class Drift:
    """What has become of a rest level since it was zeroed.

    Attributes:
        common_counts: followed of all taxels, of x, y, z; subtracted from the readings.
        own_counts: the largest that was followed beyond it, of any taxel and axis; subtracted as well.
        step_counts: the largest step in rest level, signed; it stays in the readings. 0 without one.
    """

    common_counts: tuple[float, float, float] = (0.0, 0.0, 0.0)
    own_counts: float = 0.0
    step_counts: float = 0.0


class DriftTracker:
    """Follows the rest level of one sensor.

    Attributes:
        counts: (3, rows, cols) float32, to be added to the baseline; a new array whenever it changes.
        summary: the same in a few numbers, with the step that stays in the readings.
        note: what the user should know as long as it lasts, with the figures that it began with.
        doubted: there is a contact, and it looks like drift.
    """

    def __init__(self, baseline: Baseline) -> None:
        """Start with an unmoved baseline; nothing is followed before the pad has been at rest for a while."""
        self.counts: NDArray[np.float32] = np.zeros_like(baseline.counts)
        self.summary = Drift()
        self.note: str | None = None
        self.doubted = False
        self._baseline = baseline
        self._unzeroed = np.isnan(baseline.counts).any(axis=0)
        self._dead: NDArray[np.bool_] | None = None
        self._contact = False
        self._rate_per_s = np.zeros((len(AXES), 1, 1), dtype=np.float32)
        self._step: NDArray[np.float32] | None = None
        self._voters: NDArray[np.bool_] | None = None
        self._cause = _ZEROED
        self._event: str | None = None
        self._block: list[NDArray[np.int32]] = []
        self._last_ns = 0  # the first scan interrupts, which sets what is not here

    def push(self, scan: Scan, contact: bool, dead: NDArray[np.bool_]) -> bool:
        """Follow one scan.

        Args:
            scan: the sensor's next one.
            contact: a tap is going on.
            dead: taxels (rows, cols) that are not believed; another array only where they are others than before.

        Returns:
            Whether `counts`, `summary` or `note` have changed, or there is an event.
        """
        time_ns = scan.time_ns
        since_ns, self._last_ns = time_ns - self._last_ns, time_ns
        if contact != self._contact or dead is not self._dead or not 0 <= since_ns <= GAP_NS:
            return self._interrupt(scan, contact, dead)
        if time_ns < self._next_ns:
            return False
        if scan.complete or bool((scan.fresh | dead).all()):
            self._block.append(scan.counts)
            self._next_ns = time_ns + SAMPLE_NS
        if time_ns - self._start_ns < BLOCK_NS or len(self._block) < FEWEST_SCANS:
            return False
        level, seconds = self._middle_half(), (time_ns - self._start_ns) / 1e9
        self._begin_block(time_ns)
        return self._follow(level, seconds) if self._resting else self._wait(level, seconds)

    def forget(self) -> None:
        """Something happened that scans do not show, such as a link that was away: wait for rest, then compare."""
        self._last_ns = -GAP_NS

    def take_event(self) -> str | None:
        """What has just happened to the rest level, once."""
        event, self._event = self._event, None
        return event

    def _interrupt(self, scan: Scan, contact: bool, dead: NDArray[np.bool_]) -> bool:
        if contact or self._contact:
            self._cause = "after a contact"
        elif dead is self._dead:
            self._cause = "after a gap"
        elif self._dead is not None:
            self._cause = "after a taxel was out"
        self._contact, self._dead = contact, dead
        self._live = ~(dead | self._unzeroed)
        self._all_live = bool(self._live.all())
        self._begin_block(scan.time_ns)
        self._stop()
        self.doubted = False
        before, self.note = self.note, self._step_note()
        return self.note != before

    def _stop(self) -> None:
        self._resting, self._quiet_blocks = False, 0
        self._level: NDArray[np.float32] | None = None
        self._followed = self.counts  # what the last block added may have been the touch
        self._rate_per_s.fill(0)

    def _begin_block(self, time_ns: int) -> None:
        self._block.clear()
        self._start_ns = self._next_ns = time_ns

    def _middle_half(self) -> NDArray[np.float32]:
        """How far the block's scans are from the baseline; anything where no taxel lives.

        The mean of the middle half: a median of whole counts jumps by whole counts.
        """
        readings = deformation(np.stack(self._block), self._baseline)
        readings.sort(axis=0)
        outer = len(readings) // 4
        return readings[outer : len(readings) - outer].mean(axis=0)

    def _parts(
        self, counts: NDArray[np.float32], voters: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """What all living taxels have in common, (3, 1, 1), and what is a taxel's own, 0 where it does not live.

        Args:
            counts: (3, rows, cols).
            voters: taxels (rows, cols) that tell what is common; None for all that live.
        """
        if voters is not None:
            common = self._middle(counts[:, voters])
            return common, np.where(self._live, counts - common, np.float32(0))
        if not self._all_live:
            # Left out, a taxel lies in the middle of the others: their median stays.
            counts = np.where(self._live, counts, self._middle(counts[:, self._live]) if self._live.any() else 0)
        common = self._middle(counts.reshape(len(AXES), -1))
        return common, counts - common

    @staticmethod
    def _middle(counts: NDArray[np.float32]) -> NDArray[np.float32]:
        """Median over taxels, (3, 1, 1); np.median takes ten times as long over so few."""
        ordered = np.sort(counts, axis=1)
        count = ordered.shape[1]
        middle = np.float32(0.5) * (ordered[:, (count - 1) // 2] + ordered[:, count // 2])
        return middle[:, None, None]

    def _wait(self, level: NDArray[np.float32], seconds: float) -> bool:
        """Wait until the pad has been still for a while, then see where it rests."""
        before, self._level = self._level, level
        if before is None:
            return False
        common, own = self._parts(level - before)
        allowed = STILL_COUNTS + OWN_SHARE * np.abs(common)
        still = np.abs(common).max() <= STILL_COUNTS + COMMON_PER_S * seconds and (np.abs(own) <= allowed).all()
        self._quiet_blocks = self._quiet_blocks + 1 if still else 0
        if self._quiet_blocks < REST_BLOCKS:
            return False
        return self._doubt(level) if self._contact else self._settle(level)

    def _doubt(self, level: NDArray[np.float32]) -> bool:
        """A still contact that every taxel feels alike is none that a surface makes."""
        common, own = self._parts(level - self.counts)
        self.doubted = bool((np.abs(own) <= TOUCH_COUNTS + OWN_SHARE * np.abs(common)).all())
        before, self.note = self.note, None
        if self.doubted:
            self.note = f"all taxels alike read {common[-1, 0, 0]:.0f} counts on z: if nothing touches, zero again"
        return self.note != before

    def _settle(self, level: NDArray[np.float32]) -> bool:
        self._resting = True
        step = np.where(self._live, level - self.counts, np.float32(0))
        known = self._step
        common, own = self._parts(step)
        told = np.abs(step).max() > STEP_COUNTS
        if self._cause == _ZEROED and np.abs(common).max() <= COMMON_COUNTS and _alike(common, own):
            # Nothing has touched since: what a pad does that is warmer, or held otherwise, than when it was zeroed.
            step, told = np.zeros_like(step), False
        elif not told:
            step = own
        self._step = step if np.abs(step).max() > BACK_COUNTS else None
        # Taxels that may be touched do not tell what the others drift by.
        untouched: NDArray[np.bool_] = np.logical_and.reduce(np.abs(own) <= VOTE_COUNTS) & self._live
        self._voters = untouched if self._step is not None and untouched.sum() >= FEWEST_VOTERS else None
        before, self.note = self.note, self._step_note()
        if not told:
            self._event = None if before is None else _BACK
        elif before is None or known is None or np.abs(step - known).max() > STEP_COUNTS:
            self._event = self.note
        self._sum_up()
        return self.note != before or self._event is not None

    def _follow(self, level: NDArray[np.float32], seconds: float) -> bool:
        step = self._step
        ahead = level - self._followed if step is None else level - self._followed - step
        common, own = self._parts(ahead, self._voters)
        touched = (np.abs(own) > TOUCH_COUNTS + OWN_SHARE * np.abs(common)).any()
        if touched or np.abs(common).max() > COMMON_COUNTS:
            self._cause = "after a touch too light for a tap"
            self._stop()
            return False
        most = np.float32(COMMON_PER_S * seconds)
        moved = np.clip(common, -most, most)
        own_per_s = OWN_PER_S if step is None else 0.0
        # The block before this one is now known to have been free.
        self.counts = self._followed
        self._rate_per_s += np.float32(min(seconds / RATE_S, 1.0)) * (moved / np.float32(seconds) - self._rate_per_s)
        slow_per_s = np.float32(NOISE_PER_S if step is None else SLOW_PER_S)
        share_per_s = np.maximum(np.abs(self._rate_per_s) - slow_per_s, 0)
        most_own = np.float32(seconds) * (np.float32(OWN_SHARE) * share_per_s + np.float32(own_per_s))
        own_moved = np.clip(own, -most_own, most_own)
        self._followed = self.counts + moved + own_moved
        self._sum_up()
        return True

    def _sum_up(self) -> None:
        common, own = self._parts(self.counts)
        x, y, z = common[:, 0, 0].tolist()
        step = 0.0 if self._step is None else float(self._step.flat[np.abs(self._step).argmax()])
        self.summary = Drift((x, y, z), float(np.abs(own).max()), step)

    def _step_note(self) -> str | None:
        if self._step is None or np.abs(self._step).max() <= STEP_COUNTS:
            return None
        common, own = self._parts(self._step)
        alike = _alike(common, own)
        shown = np.broadcast_to(common, self._step.shape) if alike else self._step
        axis, row, col = np.unravel_index(int(np.abs(shown).argmax()), shown.shape)
        counts = float(shown[axis, row, col])
        where = "all taxels alike, as drift or another attitude" if alike else f"taxel {row * shown.shape[2] + col}"
        above = "above" if counts > 0 else "below"
        what = f"rest level {abs(counts):.0f} counts {above} the one before on {AXES[axis]} ({where})"
        return f"{what} {self._cause}: free the pad and zero again"


def _alike(common: NDArray[np.float32], own: NDArray[np.float32]) -> bool:
    """Whether a change is that of a pad that drifts or turns, and not that of some taxels."""
    large = bool(np.abs(common).max() > STEP_COUNTS / 2)
    return large and bool((np.abs(own) <= STILL_COUNTS + OWN_SHARE * np.abs(common)).all())
