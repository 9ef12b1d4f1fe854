"""Decision whether a pattern is to be believed, by its own readings, its earlier taps and the contacts before.

Three things are asked of each pattern: do its readings look like those of any contact (a magnet, a wrong id map or axis
do not), does it explain them, and is the model itself sure of it? Of each earlier tap: does it belong to the contact
that goes on? What repeats over contacts speaks against the sensor, not the contact. The limits are one for all models,
so that the same reading gets the same verdict as far as their patterns agree.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from edge.inference.intervals import doubt
from edge.inference.trust import Trust, contact_features, pose_tap_features
from firmware_bridge.scans.pad_constants import GAIN_SPREAD

Reason = Literal["stuck", "unfamiliar", "unexplained", "sensor", "uncertain", "beyond", "pad", "baseline"]
"""Why a pattern is not to be believed: a taxel repeats itself; no contact reads like that; the pattern does not explain
its readings; contacts together are unfamiliar, or contradict the gains of the sensor file; the model expects a large
error; it was trained on no press so deep or strong, or on no such pad; the baseline is in doubt."""
REASONS: Final[tuple[Reason, ...]] = (
    *("stuck", "unfamiliar", "unexplained", "sensor", "uncertain", "beyond", "pad", "baseline"),
)
REASON_TEXTS: Final[dict[Reason, str]] = {
    "stuck": "a taxel repeats itself (stuck?)",
    "unfamiliar": "readings like no contact (a magnet or steel near? the id map? the axes?)",
    "unexplained": "the pattern does not explain its readings (an unusual shape? another pad?)",
    "sensor": "one contact after another reads like none (a magnet or steel near? the id map? the sensor file?)",
    "uncertain": "the model expects a large error (a light contact? fine detail? press harder, or elsewhere)",
    "beyond": "a press deeper or stronger than the model was trained on (press less)",
    "pad": "the sensor file's pad is far outside those that the model was trained on (the file? train for this pad)",
    "baseline": "the baseline is in doubt (free the pad and zero again)",
}
"""Reasons in a user's words, each with what to look for."""

LEAST_COUNTS: Final = 100.0  # largest z of the weakest contact that is checked: below it, drift is half of the reading
MOST_MISMATCH: Final = 0.8
"""Mismatch from which a pattern does not explain its readings: nine in ten of another press's patterns exceed it, and
one in 300 right ones."""
MOST_DOUBT: Final = 0.61
"""RMS of the deviations over that of the pattern, at a strongest z of 1000 counts, beyond which the model is not sure.

With the others 3.5 % of simulated contacts less than 30 % off are not believed, and 34 % of those over 50 % off."""
_DOUBT_POWER: Final = 0.1
"""Power of the strongest z with which that limit grows: light contacts are wrong more often than they state."""
_MOST_CHECKERBOARD: Final = 0.9
"""Share of z's variation over the pad that alternates from taxel to taxel, beyond which no layer transmits it: crossed
bars of two pitches reach 0.84 in simulation."""
_DEEPEST: Final = 1.1  # largest depth of a pattern over the declared full scale, which is the deepest press in training
MOST_Z: Final = 6_500.0
MOST_SUM: Final = 58_000.0
"""Largest z of a taxel, and of all, in counts: but for one press in a thousand, those of the training, up to 40 N."""
REPEATS: Final = 5
"""Repeats of a taxel in a row that make a pattern doubtful, while most of the others are new: no run of real sensors is
longer than 3."""
SAME_STRENGTH: Final = 0.85
"""Strength of a press, over that of an earlier tap, from which the two are compared for good."""
NOT_OF_IT: Final = 0.5  # share from which an earlier tap does not belong to the contact
_SUSPICION: Final = 1.5
_STEP: Final = 4.5
_LIMIT: Final = 12.0
_MOST: Final = 20.0


@dataclass(slots=True)
class Verdict:
    """Outcome of the checks of one pattern.

    Attributes:
        mismatch: share of the readings' energy that the pattern does not explain; None without traction.
        reason: why it is not to be believed; None if it is, or nothing could be checked.
        checked: False for a contact that is too light to tell.
    """

    mismatch: float | None = None
    reason: Reason | None = None
    checked: bool = True

    @property
    def trusted(self) -> bool | None:
        """Whether the pattern is to be believed; None if nothing could be checked."""
        return self.reason is None if self.checked or self.reason is not None else None


class PatternCheck:
    """Checks of one sensor's patterns, with what its contacts have shown so far."""

    def __init__(self, trust: Trust, contract: Contract) -> None:
        self._trust = trust
        self._constants = len(contract.pad_inputs)
        self._unit_counts = contract.counts_per_unit[2]
        self._deepest = _DEEPEST * contract.output_full_scale
        self.use_pad(np.zeros(contract.pad_width, dtype=np.float32))
        self._evidence = 0.0
        self._tap: int | None = None
        self._strongest, self._score = -math.inf, 0.0
        self.suspected = self._wrong_file = False

    def suspect_file(self) -> None:
        """Believe no further pattern: the sensor file holds the gains of another sensor."""
        self.suspected = self._wrong_file = True

    def use_pad(self, pad_row: NDArray[np.float32], *, outside: bool = False) -> None:
        """Check from now on with a pad as model input, maybe far outside those of the training; the evidence stays."""
        self._pad_row, self._outside = pad_row, outside
        self._operator = self._trust.forward.of_pad(pad_row[: self._constants])
        certainty = float(pad_row[-1]) if len(pad_row) > 2 * self._constants else 0.0
        self._gain_error = GAIN_SPREAD * (1 - certainty)

    def belonging(
        self, window: NDArray[np.float32], taps: int, poses: NDArray[np.float32] | None = None
    ) -> list[float]:
        """Return how little each earlier tap belongs to the newest one: 0 to 1, and from 0.5 it does not.

        The window is (K, 3, rows, cols) in network units, newest first, of so many taps; poses (K, 5) as model input.
        Taps of a model that takes no poses are not checked.
        """
        if taps < 2 or poses is None:
            return []
        check, features = self._trust.tap, pose_tap_features(window[:taps], poses[:taps])
        return [_share(score - check.limit) for score in check.network(features)]

    def judge(
        self,
        tap: int,
        newest: NDArray[np.float32],
        pattern: NDArray[np.float32],
        deviation: NDArray[np.float32] | None,
        traction: NDArray[np.float32] | None,
        repeats: int,
    ) -> Verdict:
        """Return the verdict on a contact's pattern, and remember what the contact shows of the sensor.

        Readings (3, rows, cols) are in network units, pattern and deviation (H, W) in [mm], traction (3, h, w) in
        [kPa]; repeats are scans for which some taxel has repeated itself while most others were new.
        """
        strength = float(newest[2].max())
        z_counts = strength * self._unit_counts
        if z_counts < LEAST_COUNTS:
            return Verdict(checked=False, reason="stuck" if repeats >= REPEATS else None)
        trust = self._trust
        (score,) = trust.contact.network(contact_features(newest, self._pad_row))
        self._weigh(tap, strength, score)
        mismatch, explained = None, True
        if traction is not None:
            mismatch = trust.forward.mismatch(self._operator, newest, pattern, traction, self._gain_error)
            explained = mismatch <= MOST_MISMATCH and np.isfinite(traction).all()
        reason: Reason | None = None
        if repeats >= REPEATS:
            reason = "stuck"
        elif self._outside:
            reason = "pad"
        elif not score <= trust.contact.limit or _alternates(newest[2]):  # NaN fails here too, as below
            reason = "unfamiliar"
        elif pattern.max() > self._deepest or z_counts > MOST_Z or newest[2].sum() * self._unit_counts > MOST_SUM:
            reason = "beyond"
        elif not explained:
            reason = "unexplained"
        elif deviation is not None and not doubt(pattern, deviation)[0] <= most_doubt(z_counts):
            reason = "uncertain"
        elif self.suspected:
            reason = "sensor"
        return Verdict(mismatch, reason)

    def _weigh(self, tap: int, strength: float, score: float) -> None:
        """Add the evidence of each contact once, by its strongest scan, when the next one begins."""
        if tap != self._tap:
            if self._tap is not None:
                step = min(max(self._score - _SUSPICION, -_STEP), _STEP)
                self._evidence = min(max(self._evidence + step, 0.0), _MOST)
                self.suspected = self._wrong_file or self._evidence > (_LIMIT / 2 if self.suspected else _LIMIT)
            self._tap, self._strongest = tap, -math.inf
        if strength > self._strongest and math.isfinite(score):
            self._strongest, self._score = strength, score


def foreign_taps(belonging: Sequence[float], *, posed: bool) -> list[int]:
    """Return the numbers, from 1, of the earlier taps that a pattern is made without, by `PatternCheck.belonging`.

    A tap with a pose of its own goes alone. Without poses the taps before it go, too: their turns are counted over it.
    """
    found = [number for number, share in enumerate(belonging, 1) if share >= NOT_OF_IT]
    return found if posed or not found else list(range(found[0], len(belonging) + 1))


def _alternates(z: NDArray[np.float32]) -> bool:
    """Return whether z (rows, cols) is a checkerboard that no layer transmits."""
    change = z - z.mean()
    along = change[::2, ::2].sum() + change[1::2, 1::2].sum() - change[::2, 1::2].sum() - change[1::2, ::2].sum()
    return float(along) ** 2 > _MOST_CHECKERBOARD * z.size * float(np.vdot(change, change))


def most_doubt(z_counts: float) -> float:
    """Return the largest doubt of a pattern that is believed, by the largest z of its contact."""
    return MOST_DOUBT * (z_counts / 1e3) ** _DOUBT_POWER


def _share(log_odds: float) -> float:
    if math.isnan(log_odds):
        return 1.0
    return 1 / (1 + math.exp(-min(max(log_odds, -30.0), 30.0)))
