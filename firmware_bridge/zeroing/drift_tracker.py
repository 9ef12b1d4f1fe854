"""Tracking of a free pad's drift while nothing touches it.

A press is local, drift is common. So the drift common to all taxels is followed fast, a taxel's own drift as far as a
share of the common drift explains it, and beyond that very slowly; a larger change of a taxel is a touch, long before
it is a tap, and stops the tracking. The tracker works in blocks of half a second, each of which counts once the next
one was free as well. A press so slow and even that it meets all these criteria is followed as drift, and lost: of
simulated taps that grow to 1500 counts of summed z in 10 s 0.2 % to 4 %, in 30 s 14 to 44 %, by their evenness.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import AXES
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import Baseline, deformation

GAP_NS: Final = 5_000_000_000  # time without a scan after which the pad may have been replaced or moved, in [ns]
COMMON_PER_S: Final = 20.0  # highest common drift that is followed, in [counts/s]: above any drift on record
# Most common change ahead of the followed drift that is no touch: a pad turned over in the earth's field moves by 36
# counts; at this limit the summed z is still half of a contact's.
COMMON_COUNTS: Final = 50.0
OWN_SHARE: Final = 0.65  # most own drift of a taxel over the common one: six tenths are seen, and a press has over one
STILL_COUNTS: Final = 7.0  # most between two blocks at rest: the highest noise measured is 4.7 counts, 1.6 for that
STEP_COUNTS: Final = 15.0  # change of rest level that is reported: more than noise and the end of a recovery cause


@dataclass(frozen=True, slots=True)
class Drift:
    """Drift since zeroing; all but the step is subtracted from readings."""

    common_counts: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of all taxels on x, y, z
    own_counts: float = 0.0  # the most of a taxel beyond it
    step_counts: float = 0.0  # largest signed step in rest level, 0 without one


class DriftTracker:
    """Tracker of the rest level of one sensor."""

    def __init__(self, baseline: Baseline) -> None:
        """Start with an unmoved baseline; drift is followed once the pad has been at rest for a while."""
        # (3, rows, cols), to be added to the baseline; a new array whenever it changes.
        self.counts: NDArray[np.float32] = np.zeros_like(baseline.counts)
        self.summary = Drift()  # the same, with the step that stays in the readings
        self.note: str | None = None  # message to the user while a step lasts
        self._baseline = baseline
        self._unzeroed = np.isnan(baseline.counts).any(axis=0)
        self._dead: NDArray[np.bool_] | None = None
        self._contact = False
        self._rate_per_s = np.zeros((len(AXES), 1, 1), dtype=np.float32)
        self._step: NDArray[np.float32] | None = None
        self._voters: NDArray[np.bool_] | None = None
        self._untouched = True  # since zeroing
        self._event: str | None = None
        self._block: list[NDArray[np.int32]] = []
        self._last_ns = 0  # the first scan interrupts, which sets the other attributes

    def push(self, scan: Scan, contact: bool, dead: NDArray[np.bool_]) -> bool:
        """Process the next scan; return True if `counts`, `summary` or `note` have changed, or there is an event.

        There is `contact` during a tap, and while the baseline is in doubt. `dead` (rows, cols) is a new array only
        where it has changed.
        """
        time_ns = scan.time_ns
        since_ns, self._last_ns = time_ns - self._last_ns, time_ns
        if contact != self._contact or dead is not self._dead or not 0 <= since_ns <= GAP_NS:
            return self._interrupt(scan, contact, dead)
        if contact or time_ns < self._next_ns:
            return False
        if scan.complete or bool((scan.fresh | dead).all()):
            self._block.append(scan.counts)
            # Twenty scans give a median within a third of the noise, at a fifth of the cost of all.
            self._next_ns = time_ns + 25_000_000
        if time_ns - self._start_ns < 500_000_000 or len(self._block) < 8:  # longer where scans are rare
            return False
        level, seconds = self._middle_half(), (time_ns - self._start_ns) / 1e9
        self._begin_block(time_ns)
        return self._follow(level, seconds) if self._resting else self._wait(level, seconds)

    def forget(self) -> None:
        """Wait for rest and compare again, after an event that scans do not show, such as a lost link."""
        self._last_ns = -GAP_NS

    def take_event(self) -> str | None:
        """Return the latest event of the rest level and clear it, None if there is none."""
        event, self._event = self._event, None
        return event

    def _interrupt(self, scan: Scan, contact: bool, dead: NDArray[np.bool_]) -> bool:
        self._untouched = self._untouched and not contact and self._dead is None
        self._contact, self._dead = contact, dead
        self._live = ~(dead | self._unzeroed)
        self._begin_block(scan.time_ns)
        self._stop()
        before, self.note = self.note, self._step_note()
        return self.note != before

    def _stop(self) -> None:
        self._resting, self._quiet_blocks = False, 0
        self._level: NDArray[np.float32] | None = None
        self._followed = self.counts  # the last block may have been part of the touch
        self._rate_per_s.fill(0)

    def _begin_block(self, time_ns: int) -> None:
        self._block.clear()
        self._start_ns = self._next_ns = time_ns

    def _middle_half(self) -> NDArray[np.float32]:
        """Return the mean deviation of the block's middle half: a median of whole counts jumps by whole counts."""
        readings = deformation(np.stack(self._block), self._baseline)
        readings.sort(axis=0)
        outer = len(readings) // 4
        return readings[outer : len(readings) - outer].mean(axis=0)

    def _parts(
        self, counts: NDArray[np.float32], voters: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Split counts into the part common to `voters`, or all live taxels, (3, 1, 1), and each taxel's own."""
        # np.median takes ten times as long for so few.
        ordered = np.sort(counts[:, self._live if voters is None else voters], axis=1)
        count = ordered.shape[1]
        if not count:
            return np.zeros_like(self._rate_per_s), np.zeros_like(counts)
        common = (np.float32(0.5) * (ordered[:, (count - 1) // 2] + ordered[:, count // 2]))[:, None, None]
        return common, np.where(self._live, counts - common, np.float32(0))

    def _wait(self, level: NDArray[np.float32], seconds: float) -> bool:
        """Wait until the pad has been still for a while, then determine its rest level."""
        before, self._level = self._level, level
        if before is None:
            return False
        common, own = self._parts(level - before)
        allowed = STILL_COUNTS + OWN_SHARE * np.abs(common)
        still = np.abs(common).max() <= STILL_COUNTS + COMMON_PER_S * seconds and (np.abs(own) <= allowed).all()
        self._quiet_blocks = self._quiet_blocks + 1 if still else 0
        # After four still blocks a pad has recovered from a press.
        return self._quiet_blocks >= 4 and self._settle(level)

    def _settle(self, level: NDArray[np.float32]) -> bool:
        self._resting = True
        step = np.where(self._live, level - self.counts, np.float32(0))
        last_step = self._step
        common, own = self._parts(step)
        stepped = np.abs(step).max() > STEP_COUNTS
        if self._untouched and np.abs(common).max() <= COMMON_COUNTS and _alike(common, own):
            # Not touched since zeroing: the change of a pad that has warmed up or is held in another attitude.
            step, stepped = np.zeros_like(step), False
        elif not stepped:
            step = own
        # A smaller step, below a touch, counts as none, and is followed.
        self._step = step if np.abs(step).max() > 8 else None
        # Taxels that may be touched, with a step above noise, do not contribute to the common drift of the others.
        untouched: NDArray[np.bool_] = np.logical_and.reduce(np.abs(own) <= 4) & self._live
        self._voters = untouched if self._step is not None and untouched.sum() >= 4 else None
        before, self.note = self.note, self._step_note()
        if not stepped:
            self._event = None if before is None else "rest level is back where it was"
        elif before is None or last_step is None or np.abs(step - last_step).max() > STEP_COUNTS:
            self._event = self.note
        self._sum_up()
        return self.note != before or self._event is not None

    def _follow(self, level: NDArray[np.float32], seconds: float) -> bool:
        step = self._step
        ahead = level - self._followed if step is None else level - self._followed - step
        common, own = self._parts(ahead, self._voters)
        # Ten counts are 0.01 N, nine times a block's highest noise.
        touched = (np.abs(own) > 10 + OWN_SHARE * np.abs(common)).any()
        if touched or np.abs(common).max() > COMMON_COUNTS:
            self._untouched = False
            self._stop()
            return False
        most = np.float32(COMMON_PER_S * seconds)
        moved = np.clip(common, -most, most)
        # This block shows that the one before it was free.
        self.counts = self._followed
        # Smoothed over 2 s, so that a taxel's share of it is not one of noise.
        self._rate_per_s += np.float32(min(seconds / 2, 1.0)) * (moved / np.float32(seconds) - self._rate_per_s)
        # In [counts/s]: four standard deviations of noise cause 0.2 of the common rate; while a taxel may be touched,
        # none follows a slow one on its own, nor creeps.
        slow_per_s, own_per_s = (np.float32(0.2), 0.05) if step is None else (np.float32(1), 0.0)
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
        return f"{what}: free the pad and zero again"


def _alike(common: NDArray[np.float32], own: NDArray[np.float32]) -> bool:
    """Return True if a change is that of a pad that drifts or turns, and not of some taxels alone."""
    large = bool(np.abs(common).max() > STEP_COUNTS / 2)
    return large and bool((np.abs(own) <= STILL_COUNTS + OWN_SHARE * np.abs(common)).all())
