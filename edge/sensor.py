"""What is remembered of one sensor between scans: its zeroing, its taxels, its taps and its last pattern."""

from collections.abc import Hashable

import numpy as np
from numpy.typing import NDArray

from edge.estimate import Filler, Readings, TaxelEstimator
from edge.result import Result
from edge.scene import LastReading, TapsThatMatter
from edge.taps import TapTracker
from edge.taxels import TaxelWatch
from firmware_bridge.baseline import Baseline, BaselineEstimator, deformation
from firmware_bridge.errors import BaselineRefusedError
from firmware_bridge.geometry import SensorGeometry
from firmware_bridge.scan import Scan


class Sensor:
    """What is remembered of one sensor."""

    def __init__(
        self,
        geometry: SensorGeometry,
        taps: TapTracker,
        estimator: TaxelEstimator | None,
        baseline: Baseline | None,
        note: str | None,
    ) -> None:
        self.taps = taps
        self.taps_that_matter = TapsThatMatter()
        self.last_reading = LastReading(geometry.scan_shape)
        self.last: Result | None = None
        self.baseline = baseline
        self.note = note
        self.watch = TaxelWatch((geometry.rows, geometry.cols))
        self._filler: Filler | None = None
        self._estimator = estimator
        self._zeroing = BaselineEstimator()

    def keep(self, made: Result, newest: NDArray[np.float32], made_by: Hashable) -> None:
        """Remember the last pattern, the reading (3, rows, cols) that it was made from, and what made it."""
        self.last = made
        self.last_reading.keep(newest, made_by)
        self.taps_that_matter.judge(made.force_counts or 0.0, made.another_tap)

    def hear(self, scan: Scan) -> NDArray[np.float32] | None:
        """The newest reading of every taxel over the baseline (3, rows, cols); None without a baseline."""
        before = self.watch.dead
        zeroed = self.watch.push(scan, self.baseline)
        if self.watch.dead is not before:
            self._bury()
        if self.baseline is None:
            self.zero(scan)
            zeroed = None if self.baseline is None else deformation(self.watch.held, self.baseline)
        return zeroed

    def fill(self, zeroed: NDArray[np.float32]) -> Readings | None:
        """Readings with something for the dead taxels; None where none is dead, or too many are."""
        return self._filler(zeroed) if self._filler is not None and self.watch.may_be_estimated else None

    def _bury(self) -> None:
        """Get ready to fill in for other dead taxels than before."""
        # What a taxel read before it was found out is in earlier taps; and no tap may be filled in unsaid.
        self.taps.reset()
        self._filler = None
        dead = np.count_nonzero(self.watch.dead)
        if 0 < 2 * dead <= self.watch.dead.size and self._estimator is not None:
            self._filler = self._estimator.filler(self.watch.dead)

    def zero(self, scan: Scan) -> None:
        """Use the scan for the baseline; a refusal becomes the note, and zeroing starts over."""
        try:
            silent = self.watch.silent_long
            few = 2 * np.count_nonzero(silent) < silent.size
            self.baseline = self._zeroing.push(scan, silent if few else None)
        except BaselineRefusedError as refusal:
            self.note = f"zeroing started over: {refusal}"
        else:
            if self.baseline is not None:
                self.note = None
