"""Stages of a pattern: which taps it is made from, whether it is believed, and what follows, such as its patch."""

import sys

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from edge.inference.intervals import expect
from edge.inference.trust import Trust
from edge.perception.dead_taxel_fill import widening
from edge.perception.event import Report
from edge.perception.gain_following import SensorPad
from edge.perception.pattern_check import SAME_STRENGTH, PatternCheck, foreign_taps
from edge.perception.step import Estimate, Step, Window
from edge.perception.tap_tracker import TapTracker
from edge.perception.taxel_health import TaxelWatch
from edge.perception.wrench import Balance, wrench_of
from firmware_bridge.pad_geometry import SensorGeometry


def touched(pattern: NDArray[np.floating], level: float) -> NDArray[np.bool_]:
    """Return the pixels that reach `level` of the pattern's maximum, (..., H, W) bool; none if that is not positive."""
    peak = pattern.max(axis=(-2, -1), keepdims=True)
    return (pattern >= level * peak) & (peak > 0)


def touched_patch(
    pattern: NDArray[np.float32], touching: NDArray[np.bool_], pixel_pitch_mm: float
) -> tuple[float, tuple[float, float] | None]:
    """Return area in [mm2] and pattern-weighted centroid of the touched pixels of a pattern (H, W), above zero there.

    The centroid is x, y in [mm] from the pattern's centre, x to the right and y down; None if no pixel is touched.
    """
    rows, cols = np.nonzero(touching)
    if rows.size == 0:
        return 0.0, None
    weights = pattern[rows, cols].astype(np.float64)
    weights /= weights.sum()
    height, width = pattern.shape
    x_mm = (float(weights @ cols) - (width - 1) / 2) * pixel_pitch_mm
    y_mm = (float(weights @ rows) - (height - 1) / 2) * pixel_pitch_mm
    return rows.size * pixel_pitch_mm**2, (x_mm, y_mm)


class Check:
    """Stage: the checks of one sensor's patterns, and of the earlier taps that they are made from."""

    def __init__(self, check: PatternCheck | None, taps: TapTracker, watch: TaxelWatch, report: Report) -> None:
        self._check, self._taps, self._watch, self._report = check, taps, watch, report

    def belonging(
        self, step: Step, window: Window, scaled: NDArray[np.float32]
    ) -> tuple[list[int], tuple[float, ...] | None]:
        """Return the numbers of the taps of a window that belong to the contact, and the mismatch of each earlier one.

        A press as strong as the earlier one settles it, and the tap is forgotten; a lighter one may only have begun.
        `scaled` is the window in network units, (K, 3, rows, cols).
        """
        every = list(range(window.taps))
        if self._check is None or window.taps < 2 or window.poses is None or step.doubted:
            return every, None
        belonging = tuple(self._check.belonging(scaled, window.taps, window.poses))
        posed = step.pose is not None and window.poses is not None
        dropped = foreign_taps(belonging, posed=posed)
        if not dropped:
            return every, belonging
        settled = [
            number
            for number in (dropped if posed else dropped[:1])
            if scaled[0, 2].sum() >= SAME_STRENGTH * scaled[number, 2].sum()
        ]
        for number in settled:
            self._report("tap_dropped", f"{_which(number, alone=posed)} not belong to this contact, and is forgotten")
        if settled:
            slots = window.slots
            self._taps.forget([slots[one] for one in settled] if posed else range(slots[settled[0]], sys.maxsize))
        return [number for number in every if number not in dropped], belonging

    def __call__(self, step: Step, made: Estimate, tap: int, newest: NDArray[np.float32]) -> None:
        """Give the verdict on the estimate of a tap by its newest readings (3, rows, cols) in network units."""
        if made.deviation is not None and step.dead:
            made.deviation = made.deviation * np.float32(widening(len(step.dead) / newest[0].size))
        check = self._check
        if check is None or made.pattern is None:
            return
        suspected = check.suspected
        verdict = check.judge(tap, newest, made.pattern, made.deviation, made.traction, self._watch.most_repeats)
        if check.suspected != suspected:
            self._report("cleared" if suspected else "suspected")
        made.mismatch, made.trusted, made.untrusted_reason = verdict.mismatch, verdict.trusted, verdict.reason


def _which(number: int, *, alone: bool) -> str:
    if number == 1:
        return "the tap before does"
    return f"the {number}. tap before does" if alone else f"taps from the {number}. before on do"


class Describe:
    """Stage: everything that follows from a pattern: area, interval, expected error, wrench."""

    def __init__(self, contract: Contract, trust: Trust | None, geometry: SensorGeometry, pad: SensorPad) -> None:
        self._contract, self._geometry, self._pad = contract, geometry, pad
        self._balance = None if trust is None else Balance(trust.forward, geometry)
        self._pixel_mm = geometry.pixel_pitch_mm(contract.scale)

    def __call__(self, made: Estimate, tap: int, newest: NDArray[np.float32]) -> None:
        """Add to an estimate what follows from its pattern; tap and newest readings as `Check` takes them."""
        contract, pattern, deviation = self._contract, made.pattern, made.deviation
        if pattern is None:
            raise ValueError("the estimate has no pattern")
        touching = touched(pattern, contract.contact_level)
        made.area_mm2, made.centroid_mm = touched_patch(pattern, touching, self._pixel_mm)
        if deviation is not None:
            expected = expect(contract.confidence, made.taps_used, pattern, deviation)
            if expected is not None:
                made.expected_rmse_mm, made.another_tap = expected.rmse, expected.another_tap
            if contract.interval_factor is not None and touching.any():
                made.interval_mm = contract.interval_factor * float(deviation[touching].mean())
        if (traction := made.traction) is not None:
            if self._balance is not None:
                made.traction = traction = self._balance(traction, pattern, newest, tap, self._pad.row)
            made.wrench = wrench_of(traction, self._geometry.rows * self._geometry.pitch_mm / traction.shape[1])
            made.wrench_origin = self._pad.wrench_origin
