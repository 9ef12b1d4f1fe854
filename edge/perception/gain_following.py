"""Pad of a sensor as the model takes it, and the contacts that a running sensor learns its gains from.

Nothing is computed while a pattern is made but a comparison: the strongest scan of a tap is kept, and is learned from
once the pad is free again, or after HELD_SCANS.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from edge.perception.event import Report
from edge.perception.gain_learning import ContactModel, GainLearner
from edge.perception.pattern_check import PatternCheck
from edge.perception.result import Estimate, Step, WrenchOrigin
from firmware_bridge.pad_geometry import AXES
from firmware_bridge.scans.pad_constants import Pad


class SensorPad:
    """Constants and gains of a sensor, which may be learned while it runs.

    Attributes:
        counts_per_newton: of the sensor, if known; it stands for those that the pad lacks.
        row: the constants as model input.
        counts_per_unit: (3, rows or 1, cols or 1), counts of a network unit, with the gains that the model wants out.
        gains_certainty: of these gains; None without.
        wrench_origin: whether the model gets the sensor's counts per newton.
    """

    def __init__(
        self, contract: Contract, pad: Pad | None, counts_per_newton: float | None, check: PatternCheck | None
    ) -> None:
        self._contract, self._check = contract, check
        self.counts_per_newton = counts_per_newton
        self.use(pad)

    def use(self, pad: Pad | None) -> None:
        """Take a pad from now on, converted once for all runs of the model."""
        contract = self._contract
        if self.counts_per_newton is not None and (pad is None or pad.counts_per_newton is None):
            pad = replace(pad or Pad(), counts_per_newton=self.counts_per_newton)
        self.row: NDArray[np.float32] = contract.pad_row(pad)
        self.counts_per_unit = np.asarray(contract.counts_per_unit, dtype=np.float32)[:, None, None]
        if contract.takes_gains and pad is not None and pad.gains is not None:
            gains = np.asarray(pad.gains, dtype=np.float32).reshape(len(AXES), contract.rows, contract.cols)
            self.counts_per_unit = self.counts_per_unit * gains
        if self._check is not None:
            self._check.use_pad(self.row, outside=contract.is_outside(pad))
        self.gains_certainty = None if pad is None or pad.gains is None else pad.gains_certainty
        calibrated = pad is not None and pad.counts_per_newton is not None
        takes = any(name == "counts_per_newton" for name, _, _ in contract.pad_inputs)
        self.wrench_origin: WrenchOrigin = "calibrated" if calibrated and takes else "nominal"


HELD_SCANS: Final = 200
CONTRADICTED: Final = 6.0
"""Disagreement of contacts with the measured gains from which these are another sensor's. The most that a sensor's own
gains reached in a thousand contacts is 4.4, on 48 simulated sensors (docs/decisions.md)."""
CONTRADICTED_CONTACTS: Final = 25  # fewest distinct contacts by which that is decided


class Learn:
    """Stage: learns the sensor's gains from its contacts, brings them into use, and reports it.

    It begins with what was measured. What an earlier run has learned is in use until this run is as sure, but is no
    beginning: counted again with each start, the same errors would come to look certain.

    Attributes:
        waiting: a contact is there to be learned from, once the pad is free.
    """

    def __init__(
        self,
        model: ContactModel,
        measured: Pad | None,
        used: Pad | None,
        pad: SensorPad,
        check: PatternCheck | None,
        report: Report,
    ) -> None:
        """Begin with the pad as measured, and the one in use, also by what was learned before."""
        self.waiting = False
        self._pad, self._check, self._report = pad, check, report
        self._learner = GainLearner(model, measured)
        self._from_file = measured is not None and measured.gains is not None
        self._used = used or measured or Pad()
        self._by_hand = Pad() if measured is None else replace(measured, gains=None, gain_half_widths=None)
        self._strongest = np.zeros(0, dtype=np.float32)
        self._force_counts = 0.0
        self._seen = 0
        self._learned: Pad | None = None

    def __call__(self, step: Step, made: Estimate, counts: NDArray[np.float32], dead: NDArray[np.bool_]) -> bool:
        """Take a contact's pattern and its readings (3, rows, cols); return whether another pad is in use since.

        A pattern that is not to be trusted teaches nothing, and nor does what came before it in the same contact.
        """
        if made.trusted is False:
            self.waiting, self._force_counts = False, 0.0
            return False
        self._seen += 1
        force_counts = step.force_counts or 0.0
        if force_counts > self._force_counts:
            self._strongest, self._force_counts = counts, force_counts
            self.waiting = True
        return self._seen >= HELD_SCANS and self.learn(dead)

    def learn(self, dead: NDArray[np.bool_]) -> bool:
        """Learn from the contact that waits; return whether another pad is in use since."""
        learner, check = self._learner, self._check
        self.waiting, self._force_counts, self._seen = False, 0.0, 0
        learned = learner.learn(self._strongest, dead)
        if (
            check is not None
            and self._from_file
            and learner.contacts >= CONTRADICTED_CONTACTS
            and learner.disagreement > CONTRADICTED
        ):
            if not check.suspected:
                why = "its contacts contradict the gains of its sensor file: is it another sensor's file?"
                self._report("suspected", why)
            check.suspect_file()
            return False
        if not learned or not self._is_better(new := learner.pad()):
            return False
        self._learned, self._used = new, new.behind(self._by_hand)
        self._pad.use(self._used)
        percent = 100 * float(np.sqrt(np.square(self._used.gain_half_widths or ()).mean()))
        self._report("gains_learned", f"gains learned from {learner.contacts} contacts, each within {percent:.0f} %")
        return True

    def _is_better(self, new: Pad) -> bool:
        """Return whether a pad is as sure as the one in use, and noticeably surer or other."""
        used = self._used
        if new.gains is None or new.gains_certainty < max(0.1, used.gains_certainty):
            return False
        shift = np.log(new.gains) - (0.0 if used.gains is None else np.log(used.gains))
        surer = new.gains_certainty >= used.gains_certainty + 0.05 or not set(new.constants) <= set(used.constants)
        return surer or bool(np.sqrt(np.square(shift).mean()) >= 0.01)

    def take_learned(self) -> Pad | None:
        """Return the pad by contacts alone if it was learned since the last call."""
        learned, self._learned = self._learned, None
        return learned
