"""Stage that takes the readings of a scan: which taxels are believed, and what stands for those that are not."""

import numpy as np

from edge.perception.dead_taxel_fill import Filler, TaxelEstimator
from edge.perception.step import Step
from edge.perception.taxel_health import TaxelWatch
from firmware_bridge.zeroing.baseline import Baseline


class Health:
    """Stage: the newest reading of each taxel over the baseline, and estimates of those of dead taxels.

    Args:
        watch: over the sensor's taxels.
        estimator: of dead taxels; None where there is no pattern while a taxel is dead.
    """

    def __init__(self, watch: TaxelWatch, estimator: TaxelEstimator | None) -> None:
        self._watch, self._estimator = watch, estimator
        self._filler: Filler | None = None

    def __call__(self, step: Step, baseline: Baseline | None) -> bool:
        """Take the step's readings; return whether other taxels are dead than before."""
        watch = self._watch
        before = watch.dead
        step.zeroed = watch.push(step.scan, baseline)
        step.dead = watch.reasons
        if watch.dead is before:
            return False
        dead = np.count_nonzero(watch.dead)
        possible = self._estimator is not None and 0 < 2 * dead <= watch.dead.size
        self._filler = self._estimator.filler(watch.dead) if self._estimator is not None and possible else None
        return True

    def fill(self, step: Step) -> None:
        """Set the readings for a pattern; none where a taxel has not arrived yet, or too many are dead."""
        watch, zeroed = self._watch, step.zeroed
        if zeroed is not None and self._filler is not None and watch.may_be_estimated:
            filled = self._filler(zeroed)
            step.readings, step.force_counts, step.filled = filled.counts, filled.z_counts, filled.filled
        if not watch.sound:
            step.notes = (*step.notes, *watch.notes(step.filled))
            if watch.waiting or (step.dead and step.readings is None):
                step.readings = step.force_counts = None
                return
        if step.readings is None and zeroed is not None:
            step.readings, step.force_counts = zeroed, float(np.add.reduce(zeroed[2], axis=None))
