"""Shipped models on readings, by the session of the runtime and by the whole of it."""

import time
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import RuntimeOptions
from edge.perception.result import Result
from edge.perception.runtime import Model, Runtime
from edge.perception.taps import NOISE_COUNTS
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.zeroing.baseline import Baseline
from train.data.frozen_presses import FrozenPresses

NOTHING, ALL = "nothing", "pad and gains"
"""Levels of knowledge about a sensor: nothing, or all constants of its pad with the taxels' gains."""
SHORT: Final = {NOTHING: "model", ALL: "model, all known"}  # names of the levels in tables


class Inferred(NamedTuple):
    """Patterns and deviations (n, H, W) in [mm], zeros if the model gives none, and the median run time in [us]."""

    patterns: NDArray[np.float32]
    deviations: NDArray[np.float32]
    run_time_us: float


def known_pads(frozen: FrozenPresses, known: str) -> list[Pad | None]:
    """Return what a level of knowledge provides of each press's sensor."""
    return [frozen.pad(index, gains=True) if known == ALL else None for index in range(len(frozen))]


def infer(
    model: ModelSession,
    windows: NDArray[np.float32],
    pads: Sequence[Pad | None],
    poses: NDArray[np.float32] | None = None,
) -> Inferred:
    """Run a model as the runtime does, on each window of as many taps as it takes, (n, taps, 3, rows, cols) as read.

    `pads` are the constants that are known of each sensor; poses are (n, taps, 5), None for the paper's schedule.
    """
    contract = model.contract
    patterns, deviations, times_s = [], [], []
    for number, (window, pad) in enumerate(zip(windows, pads, strict=True)):
        gains = None
        if contract.takes_gains and pad is not None and pad.gains is not None:
            gains = np.asarray(pad.gains, dtype=np.float32).reshape(window.shape[1:])
        row = contract.pad_row(pad)
        started_s = time.perf_counter()
        pattern = model.run(contract.scale_window(window, gains), row, None if poses is None else poses[number])
        times_s.append(time.perf_counter() - started_s)
        patterns.append(pattern.copy())
        deviations.append(np.zeros_like(pattern) if model.deviation is None else model.deviation.copy())
    return Inferred(np.stack(patterns), np.stack(deviations), 1e6 * float(np.median(times_s)))


def infer_presses(model: ModelSession, frozen: FrozenPresses, known: str) -> Inferred:
    """Run a model on frozen presses with what a level of knowledge provides."""
    return infer(model, frozen.windows(model.contract.taps), known_pads(frozen, known))


SHIPPED: Final = RuntimeOptions(follow_drift=False)
"""Options of the shipped runtime, but for the rest level, which follows a pad that is free for longer than here."""
_REST: Final = np.array((16_000, 16_400, 38_600), dtype=np.int32)[:, None, None] * np.ones((1, 4, 4), dtype=np.int32)
_SENSOR: Final = "4"


class PushedSensor:
    """Sensor whose scans go through a runtime of its own; `suspected` if the last scan's events leave it so."""

    def __init__(self, model: Model, pad: Pad | None = None, seed: int = 0, options: RuntimeOptions = SHIPPED) -> None:
        baseline = Baseline.of(_SENSOR, _REST.astype(np.float32), created_unix_s=0.0, scans=100, origin="start-up")
        self._runtime = Runtime(model, source="replay", baselines={_SENSOR: baseline}, pad=pad, options=options)
        self._series = ScanSeries(_SENSOR, USPA44)
        self._rng = np.random.default_rng([seed, 11])
        self._time_ns = 0
        self.suspected = False

    def noise(self) -> NDArray[np.float32]:
        """Draw the noise of a scan, (3, rows, cols) in counts."""
        return NOISE_COUNTS * self._rng.standard_normal(USPA44.scan_shape, dtype=np.float32)

    def push(self, counts: NDArray[np.floating], *, infer: bool = True) -> Result:
        """Return the result of the next scan, of zeroed counts (3, rows, cols)."""
        self._time_ns += 10_000_000
        raw = np.clip(_REST + np.rint(counts).astype(np.int32), 1, 65_534)
        result = self._runtime.push(self._series.close(raw, self._time_ns), infer=infer)
        for event in result.events:
            self.suspected = event.kind == "suspected" or (self.suspected and event.kind != "cleared")
        return result

    def free(self) -> Result:
        """Return the last result of a free pad."""
        return [self.push(self.noise()) for _ in range(2)][-1]

    def touch(self, counts: NDArray[np.floating]) -> Result:
        """Return the result of one scan of a contact on a pad that was free before."""
        self.free()
        return self.push(counts)

    def tap(self, window: Sequence[NDArray[np.floating]] | NDArray[np.floating]) -> Result:
        """Return the result of the newest of several taps (K, 3, rows, cols), after those that are not inferred."""
        for earlier in reversed(window[1:]):
            self.free()
            for _ in range(2):  # one scan alone may be a flipped bit, and is not remembered
                self.push(earlier + self.noise(), infer=False)
        return self.touch(window[0])
