"""One sensor whose scans go through the runtime, and faults that are the same in all of its contacts.

Faults are fields near the pad, wrong places and axes, and wrong gains.
"""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.perception.contact_options import RuntimeOptions
from edge.perception.result import NOISE_COUNTS, Result
from edge.perception.runtime import Model, Runtime
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.zeroing.baseline import Baseline
from train.learning.checks import magnet_field
from train.networks.symmetric import symmetries

Counts = NDArray[np.float32]  # readings of one sensor, (n, 3, rows, cols), zeroed
Fault = Callable[[np.random.Generator, Counts], Counts]  # readings of one sensor as a fault changes them
Field = Callable[[np.random.Generator], Counts]
"""Counts (3, rows, cols) that something near the pad adds to each reading."""

_MAGNET_MM, _CHIP_MM, _PAD_TOP_MM = 2.5, 0.5, 4.5
_MOVES: Final = (
    *("turned by 90 degrees", "turned by 180 degrees", "turned by 270 degrees"),
    *("mirrored", "mirrored and turned by 90", "mirrored and turned by 180", "mirrored and turned by 270"),
)


def steel_field(rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw the counts (3, rows, cols) that a steel plate above the pad adds: images of the pad's own magnets.

    The image of an upright magnet in a plate is upright too, as far above the plate as the magnet is below. The plate
    is wider than the pad, leans by up to eleven degrees, and its largest count is drawn, as a far magnet's is.
    """
    across_mm = (np.arange(USPA44.cols) - (USPA44.cols - 1) / 2) * USPA44.pitch_mm
    x_mm, y_mm = (part.ravel() for part in np.meshgrid(across_mm, across_mm))
    slope = rng.uniform(-0.2, 0.2, 2)
    lean_mm = slope[0] * x_mm + slope[1] * y_mm
    gap_mm = rng.uniform(1.0, 8.0) + lean_mm - lean_mm.min()
    image_mm = 2 * (_PAD_TOP_MM + gap_mm) - _MAGNET_MM
    away = np.stack(
        [x_mm[:, None] - x_mm, y_mm[:, None] - y_mm, np.broadcast_to(_CHIP_MM - image_mm, (16, 16))]
    )  # (3, chips, images)
    square = (away**2).sum(axis=0)
    field = 3 * away * away[2] / square**2.5
    field[2] -= square**-1.5
    total = field.sum(axis=2).reshape(USPA44.scan_shape)
    return (total / np.abs(total).max() * rng.uniform(150.0, 1500.0)).astype(np.float32)


def _added(field: Field) -> Fault:
    return lambda rng, counts: counts + field(rng)


def _moved(number: int) -> Fault:
    return lambda rng, counts: np.ascontiguousarray(symmetries("p4m")[number](counts), dtype=np.float32)


def _places(order: Callable[[np.random.Generator], NDArray[np.integer]]) -> Fault:
    """Return the fault by which taxels are at other places, the same for all axes."""
    return lambda rng, counts: counts.reshape(*counts.shape[:2], -1)[:, :, order(rng)].reshape(counts.shape)


def _neighbours(rng: np.random.Generator) -> NDArray[np.integer]:
    order = np.arange(USPA44.taxel_count)
    row, col = rng.integers(USPA44.rows), rng.integers(USPA44.cols - 1)
    taxel = row * USPA44.cols + col
    order[[taxel, taxel + 1]] = taxel + 1, taxel
    return order


def _axes(order: tuple[int, int, int], signs: tuple[int, int, int] = (1, 1, 1)) -> Fault:
    return lambda rng, counts: counts[:, order] * np.array(signs, dtype=np.float32)[:, None, None]


def _gains(rng: np.random.Generator, counts: Counts) -> Counts:
    return counts * (1 + 0.25 * rng.standard_normal(counts.shape[1:])).astype(np.float32)


_GRID: Final = np.arange(USPA44.taxel_count).reshape(USPA44.rows, USPA44.cols)
FIELDS: Final[dict[str, Field]] = {
    "a magnet near the pad": lambda rng: magnet_field(rng, 1)[0],
    "a steel plate near the pad": steel_field,
}
FAULTS: Final[dict[str, Fault]] = {
    **{name: _added(field) for name, field in FIELDS.items()},
    **{f"places {name}": _moved(number) for number, name in enumerate(_MOVES, 1)},
    "rows exchanged in pairs": _places(lambda rng: _GRID[[1, 0, 3, 2]].ravel()),
    "columns exchanged in pairs": _places(lambda rng: _GRID[:, [1, 0, 3, 2]].ravel()),
    "places shuffled": _places(lambda rng: rng.permutation(USPA44.taxel_count)),
    "two neighbours exchanged": _places(_neighbours),
    "x and y exchanged": _axes((1, 0, 2)),
    "x and z exchanged": _axes((2, 1, 0)),
    "y and z exchanged": _axes((0, 2, 1)),
    "x turned": _axes((0, 1, 2), (-1, 1, 1)),
    "y turned": _axes((0, 1, 2), (1, -1, 1)),
    "x and y turned": _axes((0, 1, 2), (-1, -1, 1)),
    "gains off by a quarter": _gains,
}


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
