"""Result of a scan with a pattern: which taps it is made from, whether it is believed, and what follows from it."""

import sys
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from edge.inference.expected_error import expect
from edge.perception.contact_patch import touched, touched_patch
from edge.perception.dead_taxel_fill import widening
from edge.perception.pattern_check import SAME_STRENGTH, strangers
from edge.perception.result import Result, replace
from edge.perception.sensor_state import Sensor
from edge.perception.wrench import wrench_of
from firmware_bridge.pad_geometry import SensorGeometry


def with_taps_that_belong(
    result: Result,
    sensor: Sensor,
    counts: NDArray[np.float32],
    window: NDArray[np.float32],
    slots: Sequence[int],
) -> Result:
    """Return the result with fewer taps where an earlier one does not belong to the contact.

    A press as strong as the earlier one settles it, and the tap is forgotten; a lighter one may only have begun. Which
    taps go with it is stated by edge.perception.pattern_check.strangers.

    Args:
        result: still without a pattern.
        sensor: its state.
        counts: (K, 3, rows, cols), the window in zeroed counts.
        window: the same in network units.
        slots: places of its taps in the window of the sensor's tracker.
    """
    if sensor.check is None or result.taps_used < 2:
        return result
    belonging = tuple(sensor.check.belonging(window, result.taps_used, result.poses))
    posed = result.pose is not None and result.poses is not None
    dropped = strangers(belonging, posed=posed)
    if not dropped:
        return replace(result, tap_mismatch=belonging, taps_dropped=0)
    settled = [
        number
        for number in (dropped if posed else dropped[:1])
        if window[0, 2].sum() >= SAME_STRENGTH * window[number, 2].sum()
    ]
    for number in settled:
        sensor.report("tap_dropped", f"{_which(number, alone=posed)} not belong to this contact, and is forgotten")
    if settled:
        sensor.taps.forget([slots[one] for one in settled] if posed else range(slots[settled[0]], sys.maxsize))
    kept = [number for number in range(result.taps_used) if number not in dropped]
    poses = None if result.poses is None else result.poses[kept]
    taps = {"taps_used": len(kept), "taps_dropped": len(dropped)}
    return replace(result, tap_mismatch=belonging, window=counts[kept], poses=poses, **taps)


def _which(number: int, *, alone: bool) -> str:
    if number == 1:
        return "the tap before does"
    return f"the {number}. tap before does" if alone else f"taps from the {number}. before on do"


def checked(result: Result, sensor: Sensor, tap: int, newest: NDArray[np.float32]) -> Result:
    """Return the result with the verdict on its pattern.

    Args:
        result: with the model's pattern.
        sensor: its state.
        tap: number of the contact.
        newest: (3, rows, cols) in network units, the readings that the pattern was made from.
    """
    pattern, deviation = result.pattern, result.deviation
    if deviation is not None and result.dead:
        deviation = deviation * np.float32(widening(len(result.dead) / newest[0].size))
        result = replace(result, deviation=deviation)
    if sensor.check is None or pattern is None:
        return result
    suspected = sensor.check.suspected
    verdict = sensor.check.judge(tap, newest, pattern, deviation, result.traction, sensor.watch.most_repeats)
    if sensor.check.suspected != suspected:
        sensor.report("cleared" if suspected else "suspected")
    return replace(result, mismatch=verdict.mismatch, trusted=verdict.trusted, untrusted_reason=verdict.reason)


class Describer:
    """Computation of everything that follows from a pattern: area, interval, expected error, wrench."""

    def __init__(self, contract: Contract, geometry: SensorGeometry) -> None:
        self._contract, self._geometry = contract, geometry
        self._pixel_mm = geometry.pixel_pitch_mm(contract.scale)

    def __call__(self, result: Result, sensor: Sensor) -> Result:
        """Return the result with what follows from its pattern, which it must have."""
        contract, pattern, deviation = self._contract, result.pattern, result.deviation
        if pattern is None:
            raise ValueError("the result has no pattern")
        touching = touched(pattern, contract.contact_level)
        area_mm2, centroid_mm = touched_patch(pattern, touching, self._pixel_mm)
        interval_mm = expected = None
        if deviation is not None:
            expected = expect(contract.confidence, result.taps_used, pattern, deviation)
            if contract.interval_factor is not None and touching.any():
                interval_mm = contract.interval_factor * float(deviation[touching].mean())
        wrench = wrench_origin = None
        if (traction := result.traction) is not None:
            wrench = wrench_of(traction, self._geometry.rows * self._geometry.pitch_mm / traction.shape[1])
            wrench_origin = sensor.wrench_origin
        return replace(
            result,
            area_mm2=area_mm2,
            centroid_mm=centroid_mm,
            interval_mm=interval_mm,
            expected_rmse_mm=None if expected is None else expected.rmse,
            another_tap=None if expected is None else expected.another_tap,
            wrench=wrench,
            wrench_origin=wrench_origin,
        )
