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
from edge.perception.result import WrenchOrigin
from edge.perception.step import Estimate, Step
from firmware_bridge.pad_geometry import AXES
from firmware_bridge.scans.pad_constants import Pad


class SensorPad:
    """Constants and gains of a sensor, which may be learned while it runs.

    Attributes:
        counts_per_newton: of the sensor, if known; it stands for those that the pad lacks.
        row: the constants as model input.
        gains: (3, rows, cols) that the model takes readings divided by; None where it takes them as they are.
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
        self.gains: NDArray[np.float32] | None = None
        if contract.takes_gains and pad is not None and pad.gains is not None:
            self.gains = np.asarray(pad.gains, dtype=np.float32).reshape(len(AXES), contract.rows, contract.cols)
        if self._check is not None:
            self._check.use_pad(self.row, outside=contract.is_outside(pad))
        self.gains_certainty = None if pad is None or pad.gains is None else pad.gains_certainty
        calibrated = pad is not None and pad.counts_per_newton is not None
        takes = any(name == "counts_per_newton" for name, _, _ in contract.pad_inputs)
        self.wrench_origin: WrenchOrigin = "calibrated" if calibrated and takes else "nominal"


HELD_SCANS: Final = 200
SURER: Final = 0.05  # least rise of certainty that is worth a change of the gains in use
SHIFTED: Final = 0.01  # least RMS change of the gains in use
_LEAST_CERTAINTY: Final = 0.1
CONTRADICTED: Final = 6.0
"""Disagreement of contacts with the measured gains from which these are another sensor's. The most that a sensor's own
gains reached in a thousand contacts is 4.4, on 48 simulated sensors (docs/decisions.md)."""
CONTRADICTED_CONTACTS: Final = 25  # fewest distinct contacts by which that is decided


class GainFollower:
    """Follower of one sensor's gains.

    It begins with what was measured. What an earlier run has learned is in use until this run is as sure, but is no
    beginning: counted again with each start, the same errors would come to look certain.

    Attributes:
        waiting: a contact is there to be learned from.
        contacts: distinct contacts learned from.
    """

    def __init__(self, model: ContactModel, measured: Pad | None, used: Pad | None = None) -> None:
        """Begin with the pad as measured, and the one in use, also by what was learned before."""
        self.waiting = False
        self._learner = GainLearner(model, measured)
        self._from_file = measured is not None and measured.gains is not None
        self._used = used or measured or Pad()
        self._by_hand = Pad() if measured is None else replace(measured, gains=None, gain_half_widths=None)
        self._strongest = np.zeros(0, dtype=np.float32)
        self._force_counts = 0.0
        self._seen = 0

    @property
    def contacts(self) -> int:
        """Number of distinct contacts so far."""
        return self._learner.contacts

    @property
    def contradicts_file(self) -> bool:
        """True if contacts contradict the gains that it began with: they are those of another sensor."""
        learner = self._learner
        return self._from_file and learner.contacts >= CONTRADICTED_CONTACTS and learner.disagreement > CONTRADICTED

    @property
    def learned(self) -> Pad:
        """Pad by the contacts alone."""
        return self._learner.pad()

    def see(self, trusted: bool | None, force_counts: float, counts: NDArray[np.float32]) -> bool:
        """Take note of a contact's pattern and its readings (3, rows, cols); return whether it is time to learn.

        A pattern that is not to be trusted teaches nothing, and nor does what came before it in the same contact.
        """
        if trusted is False:
            self.waiting, self._force_counts = False, 0.0
            return False
        self._seen += 1
        if force_counts > self._force_counts:
            self._strongest, self._force_counts = counts, force_counts
            self.waiting = True
        return self._seen >= HELD_SCANS

    def learn(self, dead: NDArray[np.bool_]) -> Pad | None:
        """Learn from the contact that waits; return the pad with its new gains if they have changed noticeably."""
        self.waiting, self._force_counts, self._seen = False, 0.0, 0
        if not self._learner.learn(self._strongest, dead):
            return None
        new, used = self._learner.pad(), self._used
        if new.gains is None or new.gains_certainty < max(_LEAST_CERTAINTY, used.gains_certainty):
            return None
        shift = np.log(new.gains) - (0.0 if used.gains is None else np.log(used.gains))
        surer = new.gains_certainty >= used.gains_certainty + SURER or not set(new.constants) <= set(used.constants)
        if not surer and np.sqrt(np.square(shift).mean()) < SHIFTED:
            return None
        self._used = new.behind(self._by_hand)
        return self._used


class Learn:
    """Stage: brings what contacts teach of a sensor into use, and reports it.

    Attributes:
        waiting: a contact is there to be learned from, once the pad is free.
    """

    def __init__(self, follower: GainFollower, pad: SensorPad, check: PatternCheck | None, report: Report) -> None:
        self._follower, self._pad, self._check, self._report = follower, pad, check, report
        self._learned: Pad | None = None

    @property
    def waiting(self) -> bool:  # noqa: D102 - above
        return self._follower.waiting

    def __call__(self, step: Step, made: Estimate, counts: NDArray[np.float32], dead: NDArray[np.bool_]) -> bool:
        """Take a contact's pattern and readings; return whether another pad is in use since, as `learn` does."""
        return self._follower.see(made.trusted, step.force_counts or 0.0, counts) and self.learn(dead)

    def learn(self, dead: NDArray[np.bool_]) -> bool:
        """Learn from the contact that waits; return whether another pad is in use since."""
        follower, check = self._follower, self._check
        pad = follower.learn(dead)
        if check is not None and follower.contradicts_file:
            if not check.suspected:
                why = "its contacts contradict the gains of its sensor file: is it another sensor's file?"
                self._report("suspected", why)
            check.suspect_file()
            return False
        if pad is None:
            return False
        self._learned = follower.learned
        self._pad.use(pad)
        percent = 100 * float(np.sqrt(np.square(pad.gain_half_widths or ()).mean()))
        self._report("gains_learned", f"gains learned from {follower.contacts} contacts, each within {percent:.0f} %")
        return True

    def take_learned(self) -> Pad | None:
        """Return the pad by contacts alone if it was learned since the last call."""
        learned, self._learned = self._learned, None
        return learned
