"""Decision whether a pattern is to be believed, by its own readings, its earlier taps and the contacts before.

Three things are asked of each pattern: do its readings look like those of any contact (a magnet, a wrong id map or axis
do not), does it explain them, and is the model itself sure of it? Of each earlier tap: does it belong to the contact
that goes on? What repeats over contacts speaks against the sensor, not the contact. The limits are one for all models;
those of strange readings and of earlier taps travel in the model, from `train.trust`, UNFAMILIAR and FOREIGN.
"""

import math
import sys
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from edge.inference.trust_model import Trust, contact_features, pose_tap_features
from edge.perception.event import Report
from edge.perception.result import Reason, Window, WrenchOrigin
from edge.perception.taps import TapTracker
from edge.perception.taxel_health import REPEATS
from firmware_bridge.pad_geometry import AXES
from firmware_bridge.scans.pad_constants import GAIN_SPREAD, Pad
from firmware_bridge.sensor_file.model import with_scale

LEAST_COUNTS: Final = 100.0  # largest z of the weakest contact that is checked: below it, drift is half of the reading
MOST_MISMATCH: Final = 0.8  # nine in ten of another press's patterns exceed it, and one in 300 right ones
# Doubt, at a strongest z of 1000 counts, beyond which the model is not sure. With the other checks 3.5 % of simulated
# contacts less than 30 % off are not believed, and 34 % of those over 50 % off.
MOST_DOUBT: Final = 0.61
NOT_OF_IT: Final = 0.5  # share from which an earlier tap does not belong to the contact


class SensorPad:
    """Constants and gains of a sensor, which may be learned while it runs."""

    def __init__(
        self,
        contract: Contract,
        trust: Trust | None,
        pad: Pad | None,
        counts_per_newton: float | None,
        interval: tuple[float, float] | None = None,
    ) -> None:
        self._interval = interval  # of these counts per newton, which stand for those that the pad lacks
        self.counts_per_newton, self._contract, self._trust = counts_per_newton, contract, trust
        self.use(pad)

    def use(self, pad: Pad | None) -> None:
        """Take a pad, converted once for all runs of the model."""
        contract, self.pad = self._contract, pad
        pad = with_scale(pad, self.counts_per_newton, self._interval)
        self.row: NDArray[np.float32] = contract.pad_row(pad)
        # (3, rows or 1, cols or 1), with the gains that the model wants out
        self.counts_per_unit = np.asarray(contract.counts_per_unit, dtype=np.float32)[:, None, None]
        if contract.takes_gains and pad is not None and pad.gains is not None:
            gains = np.asarray(pad.gains, dtype=np.float32).reshape(len(AXES), contract.rows, contract.cols)
            self.counts_per_unit = self.counts_per_unit * gains
        self.gains_certainty = None if pad is None or pad.gains is None else pad.gains_certainty
        self.outside = contract.is_outside(pad)
        self.gain_error = GAIN_SPREAD * (1 - (float(self.row[-1]) if contract.takes_gains else 0.0))
        taken = [name for name, _, _ in contract.pad_inputs]
        self.operator = None if self._trust is None else self._trust.forward.of_pad(self.row[: len(taken)])
        per_newton = None if pad is None else pad.counts_per_newton
        self.wrench_origin: WrenchOrigin = "nominal"
        self.scale_error: float | None = None  # share by which counts per newton may be off, by their 90 % interval
        if "counts_per_newton" in taken:
            at = taken.index("counts_per_newton")
            _, centre, spread = contract.pad_inputs[at]
            if self.row[len(taken) + at]:
                self.wrench_origin = "calibrated"
            else:  # unknown, or too little: the model is given none
                per_newton, self.scale_error = None, 0.9 * spread / centre  # pads were drawn evenly
        if pad is not None and per_newton is not None and "counts_per_newton" in pad.intervals:
            low, high = pad.intervals["counts_per_newton"]
            self.scale_error = max(high - per_newton, per_newton - low) / per_newton


class TrustVerdict(NamedTuple):
    """Outcome of the checks of one pattern."""

    trusted: bool | None  # None for a contact that is too light to tell
    reason: Reason | None = None  # why it is not to be believed
    mismatch: float | None = None  # share of the readings' energy that it does not explain; None without traction


class PatternCheck:
    """Checks of one sensor's patterns and of the earlier taps that they are made from, with what its contacts show."""

    def __init__(
        self,
        trust: Trust,
        contract: Contract,
        pad: SensorPad | None = None,
        report: Report = lambda kind, detail="": None,
    ) -> None:
        self._trust, self._report = trust, report
        self._pad = SensorPad(contract, trust, None, None) if pad is None else pad
        self._unit_counts = contract.counts_per_unit[2]
        self._deepest = 1.1 * contract.output_full_scale  # a little more than the deepest press in training
        self._evidence = 0.0
        self._tap: int | None = None
        self._strongest, self._score = -math.inf, 0.0
        self.suspected = self._wrong_file = False

    def suspect_file(self) -> None:
        """Believe no further pattern: the sensor file holds the gains of another sensor."""
        self.suspected = self._wrong_file = True

    def belonging(
        self, window: NDArray[np.float32], taps: int, poses: NDArray[np.float32] | None = None
    ) -> list[float]:
        """Return how little each earlier tap of a window in network units belongs to the newest, 0 to 1."""
        if taps < 2 or poses is None:  # a model that takes no poses has no such check
            return []
        check, features = self._trust.tap, pose_tap_features(window[:taps], poses[:taps])
        return [_share(score - check.limit) for score in check.network(features)]

    def taps_of_contact(
        self, tracker: TapTracker, window: Window, scaled: NDArray[np.float32], *, posed: bool
    ) -> tuple[list[int], tuple[float, ...]]:
        """Return the numbers of the taps of a window that belong to the contact, and how little each earlier one does.

        A press nearly as strong as an earlier one settles it, and the tracker forgets that tap; a lighter one may only
        have begun.
        """
        belonging = tuple(self.belonging(scaled, window.taps, window.poses))
        dropped = [number for number, share in enumerate(belonging, 1) if share >= NOT_OF_IT]
        if dropped and not posed:  # the taps before it go, too: their turns are counted over it
            dropped = list(range(dropped[0], window.taps))
        forgotten = [
            number
            for number in (dropped if posed else dropped[:1])
            if scaled[0, 2].sum() >= 0.85 * scaled[number, 2].sum()
        ]
        for number in forgotten:
            which = "the tap before" if number == 1 else "an earlier tap"
            self._report("tap_dropped", f"{which} does not belong to this contact, and is forgotten")
        if forgotten:
            slots = window.slots
            tracker.forget([slots[tap] for tap in forgotten] if posed else range(slots[forgotten[0]], sys.maxsize))
        return [number for number in range(window.taps) if number not in dropped], belonging

    def judge(
        self,
        tap: int,
        newest: NDArray[np.float32],
        pattern: NDArray[np.float32],
        doubt: float | None,
        traction: NDArray[np.float32] | None,
        repeats: int,
    ) -> TrustVerdict:
        """Return the verdict on a contact's pattern (H, W), and remember what the contact shows of the sensor.

        Readings (3, rows, cols) are in network units, the doubt is that of `intervals.doubt`, repeats are of `Health`.
        """
        strength = float(newest[2].max())
        z_counts = strength * self._unit_counts
        if z_counts < LEAST_COUNTS:
            return TrustVerdict(False, "stuck") if repeats >= REPEATS else TrustVerdict(None)
        trust, pad = self._trust, self._pad
        (score,) = trust.contact.network(contact_features(newest, pad.row))
        if tap != self._tap:
            self._begin_contact(tap)
        if strength > self._strongest and math.isfinite(score):
            self._strongest, self._score = strength, score
        mismatch, explained = None, traction is None
        if traction is not None and pad.operator is not None:
            mismatch = trust.forward.mismatch(pad.operator, newest, pattern, traction, pad.gain_error)
            explained = mismatch <= MOST_MISMATCH and np.isfinite(traction).all()
        reason: Reason | None = None
        if repeats >= REPEATS:
            reason = "stuck"
        elif pad.outside:
            reason = "pad"
        elif not score <= trust.contact.limit or _alternates(newest[2]):  # NaN fails here too, as below
            reason = "unfamiliar"
        elif pattern.max() > self._deepest or z_counts > 6_500 or newest[2].sum() * self._unit_counts > 58_000:
            reason = "beyond"  # than all presses of the training, up to 40 N, but for one in a thousand
        elif not explained:
            reason = "unexplained"
        elif doubt is not None and not 0 <= doubt <= MOST_DOUBT * (z_counts / 1e3) ** 0.1:
            reason = "uncertain"  # light contacts are wrong more often than they state
        elif self.suspected:
            reason = "sensor"
        return TrustVerdict(reason is None, reason, mismatch)

    def _begin_contact(self, tap: int) -> None:
        """Add the evidence of the contact before, by its strongest scan."""
        if self._tap is not None:
            # A doubtful contact, up to 1.5, speaks for the sensor; none counts for more than 4.5 either way. So three
            # clear faults in a row pass 12, and two to four good contacts lead from 12 to 20 below 6.
            step = min(max(self._score - 1.5, -4.5), 4.5)
            self._evidence = min(max(self._evidence + step, 0.0), 20.0)
            suspected = self._wrong_file or self._evidence > (6.0 if self.suspected else 12.0)
            if suspected != self.suspected:
                self.suspected = suspected
                text = "several contacts in a row read like none: is a magnet or steel near it, is it another --id-map?"
                self._report(*(("suspected", text) if suspected else ("cleared", "")))
        self._tap, self._strongest = tap, -math.inf


def _alternates(z: NDArray[np.float32]) -> bool:
    """Return whether z (rows, cols) is a checkerboard that no layer transmits."""
    change = z - z.mean()
    along = change[::2, ::2].sum() + change[1::2, 1::2].sum() - change[::2, 1::2].sum() - change[1::2, ::2].sum()
    # Crossed bars of two pitches reach a share of 0.84 in simulation.
    return float(along) ** 2 > 0.9 * z.size * float(np.vdot(change, change))


def _share(log_odds: float) -> float:
    if math.isnan(log_odds):
        return 1.0
    return 1 / (1 + math.exp(-min(max(log_odds, -30.0), 30.0)))  # beyond 30 it is 0 or 1 to ten digits
