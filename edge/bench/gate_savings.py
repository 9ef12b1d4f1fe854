"""Inference that a scene makes unnecessary, and its cost in error: whole taps through the runtime, with ever less work.

The stream is made of the frozen test set: of every fourth tap the ends of the taps before, then its own frames, the
last one held for a second, released, and a second of rest, with a sensor's noise in every scan. Each scan in which the
tap goes on is evaluated against its truth.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.evaluation.test_set import FrozenSet
from edge.inference.model_interface import Model
from edge.perception.change_gate import NOISE_COUNTS
from edge.perception.contact_options import RuntimeOptions
from edge.perception.runtime import Runtime
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import Scan, ScanSeries
from firmware_bridge.zeroing.baseline import Baseline

SEED: Final = 1
HELD_SCANS: Final = 100
SENSOR: Final = "4"
REST: Final = np.full(USPA44.scan_shape, 20_000, dtype=np.int32)
_EVERY: Final = 4
_EARLIER_SCANS: Final = 5
_PERIOD_NS: Final = 10_000_000
_UNJUDGED: Final = -1


@dataclass(frozen=True, slots=True)
class Saving:
    """Row of the table.

    Attributes:
        left_out: name of the work that is left out.
        model: its name.
        scans: of the stream.
        inferred: windows that the network was run on.
        cpu_us: processor time a scan, back to back, in [us].
        taps_used: mean over the evaluated scans.
        psnr_db: mean over the same, in [dB].
    """

    left_out: str
    model: str
    scans: int
    inferred: int
    cpu_us: float
    taps_used: float
    psnr_db: float


def savings(model: Model, frozen: FrozenSet) -> Iterator[Saving]:
    """Yield all rows of a model: first nothing is left out, then one thing more in each."""
    scans, frames = stream(frozen, model.contract.taps)
    yield _measured("nothing", model, frozen, scans, frames, idle=True, every_scan=True)
    yield _measured("where nothing touches", model, frozen, scans, frames, every_scan=True)
    yield _measured("+ where nothing has changed", model, frozen, scans, frames)


def stream(frozen: FrozenSet, taps: int) -> tuple[list[Scan], list[int]]:
    """Return scans, and for each the frame of the set that it shows, or -1 where it is not evaluated."""
    series, rng = ScanSeries(SENSOR, USPA44), np.random.default_rng(SEED)
    scans: list[Scan] = []
    frames: list[int] = []
    for zeroed, frame in _readings(frozen, taps):
        noise = NOISE_COUNTS * rng.standard_normal(REST.shape)
        scans.append(series.close(REST + np.rint(zeroed + noise).astype(np.int32), len(scans) * _PERIOD_NS))
        frames.append(frame)
    return scans, frames


def _readings(frozen: FrozenSet, taps: int) -> Iterator[tuple[NDArray[np.int16], int]]:
    """Yield zeroed counts (3, rows, cols) without noise, and the frame."""
    nothing = (np.zeros_like(frozen.newest[0]), _UNJUDGED)
    for tap in range(0, len(frozen.touched), _EVERY):
        for earlier in frozen.earlier[tap, : taps - 1][::-1]:
            yield from [(earlier, _UNJUDGED)] * _EARLIER_SCANS
            yield from [nothing] * _EARLIER_SCANS
        own = np.flatnonzero(frozen.tap == tap)
        for frame in (*own, *[own[-1]] * HELD_SCANS):
            yield frozen.newest[frame], int(frame)
        # Longer than the runtime remembers a tap, so that the next object starts without earlier taps.
        yield from [nothing] * HELD_SCANS


class _Counted:
    """Model that counts the windows it is run on."""

    def __init__(self, model: Model) -> None:
        self.name, self.contract, self.windows = model.name, model.contract, 0
        self._model = model

    @property
    def deviation(self) -> NDArray[np.float32] | None:
        return self._model.deviation

    @property
    def traction(self) -> NDArray[np.float32] | None:
        return self._model.traction

    def run(
        self,
        window: NDArray[np.float32],
        pad: NDArray[np.float32] | None = None,
        poses: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        self.windows += 1
        return self._model.run(window, pad, poses)

    def run_together(
        self,
        windows: Sequence[NDArray[np.float32]],
        pads: Sequence[NDArray[np.float32]] | None = None,
        poses: Sequence[NDArray[np.float32]] | None = None,
    ) -> NDArray[np.float32]:
        self.windows += len(windows)
        return self._model.run_together(windows, pads, poses)


def _measured(
    left_out: str,
    model: Model,
    frozen: FrozenSet,
    scans: Sequence[Scan],
    frames: Sequence[int],
    *,
    idle: bool = False,
    every_scan: bool = False,
) -> Saving:
    """Measure a row; `idle`: the network runs where nothing touches, too."""
    counted = _Counted(model)
    baseline = Baseline.of(SENSOR, REST.astype(np.float32), created_unix_s=0.0, scans=100, origin="start-up")
    runtime = Runtime(
        counted,
        source="replay",
        baselines={SENSOR: baseline},
        options=RuntimeOptions(idle_reset_s=HELD_SCANS * _PERIOD_NS / 2e9, every_scan=every_scan),
    )
    nothing = np.zeros((model.contract.taps, *USPA44.scan_shape), dtype=np.float32)
    results = []
    before_s = time.process_time()
    for scan in scans:
        results.append(runtime.push(scan))
        if idle and not results[-1].contact:
            counted.run(nothing)
    cpu_us = 1e6 * (time.process_time() - before_s) / len(scans)
    with_pattern = [
        (frame, result) for frame, result in zip(frames, results, strict=True) if frame >= 0 and result.contact
    ]
    truth = frozen.patterns()[[frame for frame, _ in with_pattern]]
    patterns = np.stack([result.pattern for _, result in with_pattern if result.pattern is not None])
    error_db = float(np.mean(psnr_db(patterns, truth, frozen.full_scale_mm)))
    taps_used = float(np.mean([result.taps_used for _, result in with_pattern]))
    return Saving(left_out, model.name, len(scans), counted.windows, cpu_us, taps_used, error_db)
