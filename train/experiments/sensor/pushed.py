"""Readings pushed through the runtime as the scans of one sensor, with the pad free before and after each contact."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.perception.change_gate import NOISE_COUNTS
from edge.perception.contact_options import RuntimeOptions
from edge.perception.result import Result
from edge.perception.runtime import Model, Runtime
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses.pad_pose import PadPose
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import Scan, ScanSeries
from firmware_bridge.zeroing.baseline import Baseline

SHIPPED: Final = RuntimeOptions(follow_drift=False)
"""Options of the shipped runtime, but for the rest level, which follows a pad that is free for longer than here."""
_REST: Final = np.array((16_000, 16_400, 38_600), dtype=np.int32)[:, None, None] * np.ones((1, 4, 4), dtype=np.int32)
_SENSOR: Final = "4"
_PERIOD_NS: Final = 10_000_000
_FREE_SCANS: Final = 2
_TAP_SCANS: Final = 2
"""Scans of an earlier tap: one alone may be a flipped bit, and is not remembered."""


class PushedSensor:
    """Sensor whose scans go through a runtime of its own.

    Attributes:
        suspected: whether the last scan's events leave the sensor suspected.
    """

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

    def scan(self, counts: NDArray[np.floating]) -> Scan:
        """Return the next scan, of zeroed counts (3, rows, cols)."""
        self._time_ns += _PERIOD_NS
        raw = np.clip(_REST + np.rint(counts).astype(np.int32), 1, 65_534)
        return self._series.close(raw, self._time_ns)

    def push(self, counts: NDArray[np.floating], *, infer: bool = True, pose: PadPose | None = None) -> Result:
        """Return the result of the next scan, of zeroed counts (3, rows, cols), with the pad's pose at that time."""
        if pose is not None:
            self._runtime.pose(pose, self._time_ns + _PERIOD_NS)
        return self.take(self.scan(counts), infer=infer)

    def take(self, scan: Scan, *, infer: bool = True) -> Result:
        """Return the result of a scan."""
        result = self._runtime.push(scan, infer=infer)
        for event in result.events:
            self.suspected = event.kind == "suspected" or (self.suspected and event.kind != "cleared")
        return result

    def free(self) -> Result:
        """Return the last result of a free pad's scans."""
        return [self.push(self.noise()) for _ in range(_FREE_SCANS)][-1]

    def touch(self, counts: NDArray[np.floating]) -> Result:
        """Return the result of one scan of a contact on a pad that was free before."""
        self.free()
        return self.push(counts)

    def tap(self, window: Sequence[NDArray[np.floating]] | NDArray[np.floating]) -> Result:
        """Return the result of the newest of several taps (K, 3, rows, cols), after those that are not inferred."""
        for earlier in reversed(window[1:]):
            self.free()
            for _ in range(_TAP_SCANS):
                self.push(earlier + self.noise(), infer=False)
        return self.touch(window[0])
