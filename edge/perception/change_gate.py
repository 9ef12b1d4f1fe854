"""Decision which part of a scan needs computing. No I/O, no clock.

Without contact nothing is inferred. The last pattern is reused where nothing has changed beyond noise since the scan
that it was made from; comparing with that scan and not with the newest one follows slow creep.
"""

import math
from collections.abc import Hashable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.perception.step import Estimate

NOISE_COUNTS: Final = 2.0
"""Standard deviation of a reading at rest: 1.7 to 2.6 in recordings."""
CHANGED_RMS_COUNTS: Final = 1.4 * math.sqrt(2) * NOISE_COUNTS
"""RMS change of all readings that noise, present in both scans, does not reach: four of its deviations away."""
CHANGED_COUNTS: Final = 5 * math.sqrt(2) * NOISE_COUNTS
"""Change of one reading that noise does not reach."""
MOVED: Final = np.array([0.05, 0.05, 0.25, 0.05, 0.25], dtype=np.float32)
"""Change of a relative pose, in [mm] and [deg] as model input has them: a quarter of the usual errors."""


class LastReading:
    """Readings, scan number and estimate of a sensor's last pattern; allocates nothing after construction.

    The estimate is None before the first, and where it must not be used again.
    """

    def __init__(self, scan_shape: tuple[int, int, int]) -> None:
        self.estimate: Estimate | None = None
        self.scan_number = -1
        self._counts = np.zeros(scan_shape, dtype=np.float32)
        self._change = np.zeros(scan_shape, dtype=np.float32)
        self._made_by: Hashable = None
        self._poses: NDArray[np.float32] | None = None

    def holds(self, counts: NDArray[np.float32], made_by: Hashable, poses: NDArray[np.float32] | None = None) -> bool:
        """Return whether readings (3, rows, cols) and poses (taps, 5) have not changed beyond noise, nor the maker.

        The maker is what distinguishes the pattern from others, with its number of taps; poses are None for a model
        without.
        """
        if made_by != self._made_by:
            return False
        if poses is not None and (
            self._poses is None or poses.shape != self._poses.shape or (np.abs(poses - self._poses) > MOVED).any()
        ):
            return False
        np.subtract(counts, self._counts, out=self._change)
        np.abs(self._change, out=self._change)
        if self._change.max() > CHANGED_COUNTS:
            return False
        return float(np.vdot(self._change, self._change)) <= CHANGED_RMS_COUNTS**2 * self._change.size

    def keep(self, counts: NDArray[np.float32], made_by: Hashable, poses: NDArray[np.float32] | None = None) -> None:
        """Keep the readings and poses that a pattern was made from, and its maker; None as the maker keeps nothing."""
        self._counts[...] = counts
        self._poses = poses
        self._made_by = made_by
