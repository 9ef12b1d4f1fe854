"""Scan in, result out: the only state there is between scans, kept per sensor."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from edge.contract import Contract
from edge.errors import UsageError, WindowError
from edge.metrics import touched
from edge.result import Result
from edge.taps import IDLE_TIMEOUT_S, OFF_COUNTS, ON_COUNTS, TapState, TapTracker
from firmware_bridge.baseline import Baseline, BaselineEstimator, deformation
from firmware_bridge.errors import BaselineRefusedError
from firmware_bridge.geometry import USPA44, SensorGeometry
from firmware_bridge.links.base import SourceKind
from firmware_bridge.scan import Scan

HOLD_SCANS: Final = 5
"""A taxel missing from a torn scan keeps its last reading this long: 50 ms at 100 Hz."""
SILENT_SCANS: Final = 50
"""A taxel not heard for so long is not lost for a moment: the user is told."""
RANGE_ENDS: Final = (0, 65535)
"""Of a chip. What stands there has left the range, and is no reading, unless the taxel rests nearby and wraps round."""
NEAR_END_COUNTS: Final = 500.0


class Model(Protocol):
    """What the runtime needs of a model session."""

    name: str
    contract: Contract

    def run(self, window: NDArray[np.float32]) -> NDArray[np.float32]:
        """Pattern (H, W) of a window (taps, 3, rows, cols) in network input units."""
        ...

    @property
    def deviation(self) -> NDArray[np.float32] | None:
        """Standard deviation (H, W) of each pixel of the last run's pattern; None where the model gives none."""
        ...


class Runtime:
    """Makes one result of every scan.

    Args:
        model: the loaded model.
        source: what kind of source the scans come from; every result says it.
        geometry: of the sensors; refused if the model was not trained for it.
        baselines: stored baselines by sensor name; a sensor without one is zeroed from its first
            scans, during which its pad must be still and free.
        counts_per_newton: summed z per [N]; without it there is no force in newtons.
        on_counts: summed z at which a tap begins.
        off_counts: summed z at which it ends.
        idle_timeout_s: time without contact after which earlier taps are forgotten.
        clock_ns: measures run time.
        unix_time_s: tells a baseline's age.

    Raises:
        ModelError: the model is for another sensor.
        UsageError: contact thresholds or an idle time-out that cannot be, or a baseline of another grid.
    """

    def __init__(
        self,
        model: Model,
        *,
        source: SourceKind,
        geometry: SensorGeometry = USPA44,
        baselines: Mapping[str, Baseline] | None = None,
        counts_per_newton: float | None = None,
        on_counts: float = ON_COUNTS,
        off_counts: float = OFF_COUNTS,
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        clock_ns: Callable[[], int] = time.perf_counter_ns,
        unix_time_s: Callable[[], float] = time.time,
    ) -> None:
        model.contract.check_sensor(geometry)
        for baseline in (baselines or {}).values():
            if baseline.counts.shape != geometry.scan_shape:
                got = f"baseline of sensor {baseline.sensor} has shape {baseline.counts.shape}"
                raise UsageError(f"{got}, expected {geometry.scan_shape}: zero again")
        self._model = model
        self._source: SourceKind = source
        self._geometry = geometry
        self._baselines = dict(baselines or {})
        self._counts_per_newton = counts_per_newton
        self._thresholds = (on_counts, off_counts, idle_timeout_s)
        self._clock_ns = clock_ns
        self._unix_time_s = unix_time_s
        self._sensors: dict[str, _Sensor] = {}
        self._new_tracker()

    def reset(self) -> None:
        """Forget the taps of every sensor, as when the robot moves to another object; zeroing stays."""
        for sensor in self._sensors.values():
            sensor.taps.reset()

    def push(self, scan: Scan, *, infer: bool = True) -> Result:
        """Make the result of one scan.

        Args:
            scan: the sensor's next one.
            infer: False spares the inference, for a scan that a newer one has overtaken; taps are
                followed all the same.

        Raises:
            WindowError: the scan is not of this sensor geometry.
            ModelError: the model gave a pattern that is not finite, or a deviation that is not finite and above zero.
        """
        if scan.counts.shape != self._geometry.scan_shape:
            raise WindowError(f"scan has shape {scan.counts.shape}, expected {self._geometry.scan_shape}")
        sensor = self._sensors.get(scan.sensor) or self._meet(scan.sensor)
        counts = sensor.hold(scan)
        if sensor.baseline is None:
            sensor.zero(scan)

        unit, note = self._model.contract.output_unit, sensor.silence() or sensor.note
        result = Result(scan, self._source, self._model.name, "zeroing", pattern_unit=unit, note=note)
        if sensor.baseline is None:
            return result
        age_s = sensor.baseline.age_s(self._unix_time_s())
        result = replace(result, state="incomplete", baseline=sensor.baseline, baseline_age_s=age_s)
        if counts is None:
            return result

        zeroed = deformation(counts, sensor.baseline)
        tap = sensor.taps.push(zeroed, scan.time_ns)
        force_counts = float(zeroed[2].sum())
        force_n = None if self._counts_per_newton is None else force_counts / self._counts_per_newton
        result = replace(
            result,
            state="idle",
            contact=tap.contact,
            taps_used=tap.taps_used,
            force_counts=force_counts,
            force_n=force_n,
        )
        if not tap.contact:
            return result
        if not infer:
            return replace(result, state="dropped")
        return self._infer(result, tap)

    def _infer(self, result: Result, tap: TapState) -> Result:
        contract = self._model.contract
        start_ns = self._clock_ns()
        pattern = self._model.run(contract.scale_window(tap.window))
        run_time_us = (self._clock_ns() - start_ns) / 1e3
        deviation = self._model.deviation
        touching = touched(pattern, contract.contact_level)
        area_mm2, centroid_mm = touched_patch(pattern, touching, self._geometry.pixel_pitch_mm(contract.scale))
        interval_mm = None
        if deviation is not None and contract.interval_factor is not None and touching.any():
            interval_mm = contract.interval_factor * float(deviation[touching].mean())
        return replace(
            result,
            state="contact",
            pattern=pattern.copy(),
            area_mm2=area_mm2,
            centroid_mm=centroid_mm,
            deviation=None if deviation is None else deviation.copy(),
            interval_mm=interval_mm,
            run_time_us=run_time_us,
        )

    def _meet(self, name: str) -> "_Sensor":
        baseline = self._baselines.get(name)
        note = None
        if baseline is None and self._baselines:
            note = f"no stored baseline for sensor {name}, only for {', '.join(sorted(self._baselines))}: zeroing"
        self._sensors[name] = sensor = _Sensor(self._geometry, self._new_tracker(), baseline, note)
        return sensor

    def _new_tracker(self) -> TapTracker:
        contract = self._model.contract
        return TapTracker(contract.taps, *self._thresholds, grid_shape=(self._geometry.rows, self._geometry.cols))


class _Sensor:
    """What is remembered of one sensor."""

    def __init__(self, geometry: SensorGeometry, taps: TapTracker, baseline: Baseline | None, note: str | None) -> None:
        self.taps = taps
        self.baseline = baseline
        self.note = note
        self._estimator = BaselineEstimator()
        self._held = np.zeros(geometry.scan_shape, dtype=np.int32)
        self._age_scans = np.full((geometry.rows, geometry.cols), HOLD_SCANS + 1)
        self._oldest_scans = 0
        self._saturated = np.zeros((geometry.rows, geometry.cols), dtype=bool)

    def hold(self, scan: Scan) -> NDArray[np.int32] | None:
        """The newest reading of every taxel, or None if one is too old or was never heard."""
        self._find_saturated(scan)
        read = scan.fresh & ~self._saturated
        np.copyto(self._held, scan.counts, where=read)
        self._age_scans += 1
        self._age_scans[read] = 0
        self._oldest_scans = int(self._age_scans.max())
        return self._held if self._oldest_scans <= HOLD_SCANS else None

    def _find_saturated(self, scan: Scan) -> None:
        """Keep which taxels stand, on some axis, at an end of the chip's range and far from rest."""
        low, high = RANGE_ENDS
        self._saturated &= ~scan.fresh
        ends = (scan.counts == low) | (scan.counts == high)
        if self.baseline is not None and ends.any():
            far = np.abs(deformation(scan.counts, self.baseline)) > NEAR_END_COUNTS
            self._saturated |= (ends & far).any(axis=0)

    def silence(self) -> str | None:
        """What to tell of taxels that are not heard, or say nothing; None while there are none."""
        notes = []
        if self._saturated.any():
            held = "its last reading is held" if self._oldest_scans <= HOLD_SCANS else "no pattern"
            saturated = ", ".join(map(str, np.flatnonzero(self._saturated)))
            notes.append(f"{held}, taxel {saturated} at the end of its range: overloaded, too near a magnet, or broken")
        if self._oldest_scans >= SILENT_SCANS:
            silent = np.flatnonzero((self._age_scans >= SILENT_SCANS) & ~self._saturated)
            remedy = "try another --id-map" if 2 * silent.size == self._age_scans.size else "it may be broken"
            if silent.size:
                notes.append(f"no pattern, taxel {', '.join(map(str, silent))} silent: {remedy}")
        return "; ".join(notes) or None

    def zero(self, scan: Scan) -> None:
        """Use the scan for the baseline; a refusal becomes the note, and zeroing starts over."""
        try:
            self.baseline = self._estimator.push(scan)
        except BaselineRefusedError as refusal:
            self.note = f"zeroing started over: {refusal}"
        else:
            if self.baseline is not None:
                self.note = None


def touched_patch(
    pattern: NDArray[np.float32], touching: NDArray[np.bool_], pixel_pitch_mm: float
) -> tuple[float, tuple[float, float] | None]:
    """Area and centroid of the touched pixels.

    Args:
        pattern: (H, W).
        touching: (H, W), which pixels are touched; their pattern is above zero.
        pixel_pitch_mm: distance of neighbouring pixels, in [mm].

    Returns:
        Area in [mm2]; pattern-weighted centroid x, y in [mm] from the pattern's centre, x to the
        right and y down, or None where nothing is touched.
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
