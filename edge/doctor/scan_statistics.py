"""Statistics of the scans that one sensor sent while it was watched. No I/O, no clock."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.scans.scan import ABSENT, Scan
from firmware_bridge.schedule import NS_PER_S
from firmware_bridge.zeroing.baseline import COUNTS_ON_CIRCLE

PERIODS_TOGETHER: Final = 100
"""Number of periods that are averaged: an adapter that delivers scans in bunches makes single periods meaningless."""
AROUND: Final = 16
"""Scans before and after a scan that show whether it alone was late."""
FEWEST_SCANS: Final = 50
_TRIMMED: Final = 0.02
_TRIMMED_RMS: Final = 0.9346
"""RMS of a normal variable of deviation 1 without the 2 % that lie farthest out."""
_ENDS: Final = 0.1


class Samples:
    """Scans of one sensor, without the first, which may have been cut in mid-cycle.

    Attributes:
        scans: number of scans.
        counts: (n, 3, taxels) raw counts, ABSENT where a taxel was silent.
        fresh: (n, taxels), True where the taxel sent a reading.
        renewed: (n, taxels), True where that reading is new.
        time_s: (n,) from the first, in [s].
        living: (taxels,), True for taxels that sent in at least half of the scans.
    """

    def __init__(self, scans: Sequence[Scan]) -> None:
        kept = scans[1:]
        self.scans = len(kept)
        self.counts: NDArray[np.int32] = np.array([scan.counts.reshape(3, -1) for scan in kept], dtype=np.int32)
        self.fresh = self.counts[:, 0] != ABSENT
        self.renewed: NDArray[np.bool_] = np.array([scan.renewed.ravel() for scan in kept], dtype=bool)
        self.time_s = np.array([scan.time_ns - kept[0].time_ns for scan in kept], dtype=np.float64) / NS_PER_S
        self.living: NDArray[np.bool_] = self.fresh.mean(axis=0) >= 0.5

    @property
    def enough(self) -> bool:
        """True if there are enough scans for any finding."""
        return self.scans >= FEWEST_SCANS

    def period_s(self) -> float:
        """Return the period from scan to scan, in [s]."""
        together = min(PERIODS_TOGETHER, self.scans // 2)
        return float(np.median(self.time_s[together:] - self.time_s[:-together])) / together

    def held_back_ms(self) -> float:
        """Return the upper quartile of the scans' delays after the most punctual ones around them, in [ms]."""
        period_s = self.period_s()
        late_s = self.time_s - period_s * np.arange(self.scans)
        around = np.lib.stride_tricks.sliding_window_view(late_s, 2 * AROUND + 1)
        return 1000 * float(np.percentile(around[:, AROUND] - around.min(axis=1), 75))

    def lost(self) -> int:
        """Count the scans that never came, by steps in time; a scan that is only late is followed by less late ones."""
        period_s = self.period_s()
        behind = self.time_s / period_s - np.arange(self.scans)
        lost, last_gap = 0, 0
        gaps_s = np.diff(self.time_s)[:-AROUND]  # nothing can be concluded from a gap at the very end
        for gap in np.flatnonzero(gaps_s > 1.5 * period_s) + 1:
            before = behind[max(last_gap, gap - AROUND) : gap].min()
            step = round(float(behind[gap : gap + AROUND].min() - before))
            lost += max(step, 0)
            last_gap = gap
        return lost

    def torn(self) -> NDArray[np.bool_]:
        """Return (n,), True for scans in which a living taxel was silent."""
        return ~self.fresh[:, self.living].all(axis=1)

    def half_old(self) -> NDArray[np.bool_]:
        """Return (n,), True for scans in which a quarter of the living taxels or more sent an old reading again."""
        old = (self.fresh & ~self.renewed)[:, self.living]
        return 4 * old.sum(axis=1) >= max(1, int(self.living.sum()))

    def stuck(self) -> NDArray[np.bool_]:
        """Return (taxels,), True for living taxels with a new reading in one scan in a hundred at most."""
        arrived = np.maximum(self.fresh.sum(axis=0), 1)
        return self.living & ((self.renewed & self.fresh).sum(axis=0) <= 0.01 * arrived)

    def noise_counts(self) -> NDArray[np.float64]:
        """Return (3, taxels), the standard deviation from scan to scan, without creep; NaN where too little came."""
        noise = np.full(self.counts.shape[1:], np.nan)
        both = self.fresh[1:] & self.fresh[:-1]
        steps = around_counts(np.diff(self.counts, axis=0))
        for taxel in np.flatnonzero(self.living):
            sizes = np.sort(np.abs(steps[both[:, taxel], :, taxel]), axis=0)
            kept = sizes[: int((1 - _TRIMMED) * len(sizes))].astype(np.float64)
            if len(kept):
                noise[:, taxel] = np.sqrt((kept**2).mean(axis=0) / 2) / _TRIMMED_RMS
        return noise

    def rest_counts(self) -> NDArray[np.float64]:
        """Return (3, taxels), the median reading; NaN where a taxel is not living."""
        return self._median(slice(None))

    def drift_counts(self) -> NDArray[np.float64]:
        """Return (3, taxels), the last tenth less the first; NaN where a taxel is not living."""
        part = max(1, int(_ENDS * self.scans))
        return around_counts(self._median(slice(-part, None)) - self._median(slice(part)))

    def _median(self, part: slice) -> NDArray[np.float64]:
        medians = np.full(self.counts.shape[1:], np.nan)
        for taxel in np.flatnonzero(self.living):
            read = self.counts[part, :, taxel][self.fresh[part, taxel]]
            if len(read):
                medians[:, taxel] = (read[0] + np.median(around_counts(read - read[0]), axis=0)) % COUNTS_ON_CIRCLE
        return medians


def around_counts(steps: NDArray[Any]) -> NDArray[Any]:
    """Return steps the short way round the circle."""
    half = COUNTS_ON_CIRCLE // 2
    return (steps + half) % COUNTS_ON_CIRCLE - half
