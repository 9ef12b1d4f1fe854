"""Map of an object in its own plane, larger than the pad, in memory that does not grow with the run.

Evidence is counted by the distance that the pad has moved, and not by the scan, since a model makes the same mistake
again while the same part of the object lies under the same taxels. Heights are those of a press plus an offset, by
which it agrees with what lies on the map already where both touched.
"""

from collections import deque
from dataclasses import dataclass
from math import cos, inf, isfinite, radians, sin
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.errors import UsageError
from edge.perception.result import Result
from edge.perception.trust_check import LEAST_COUNTS
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses import PadPose

SIZE_MM: Final = 60.0
PX_PER_MM: Final = 4.0
MOST_PX: Final = 2000  # most pixels along a map's side: its layers take 100 MB


class Grid(NamedTuple):
    """Pixels along a map's side, pixels per [mm], and the place of its centre in the object's plane, in [mm]."""

    pixels: int
    px_per_mm: float
    centre_mm: tuple[float, float]


class Footprint(NamedTuple):
    """Pixels (n,) of a map under a pad, row-major, and the row and column of each in the pattern, with fractions."""

    pixels: NDArray[np.intp]
    rows: NDArray[np.floating]
    cols: NDArray[np.floating]

    def read(self, layers: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return values (n, k) between the pixels of a pattern's layers (H, W, k); beyond the outermost, theirs."""
        height, width, depth = layers.shape
        rows, cols = np.clip(self.rows, 0, height - 1), np.clip(self.cols, 0, width - 1)
        row = np.minimum(rows.astype(np.intp), height - 2)
        col = np.minimum(cols.astype(np.intp), width - 2)
        down, right = (rows - row).astype(np.float32)[:, None], (cols - col).astype(np.float32)[:, None]
        flat, corner = layers.reshape(-1, depth), row * width + col
        upper, lower = (
            _between(flat.take(left, axis=0), flat.take(left + 1, axis=0), right) for left in (corner, corner + width)
        )
        return _between(upper, lower, down)


def _between(here: NDArray[np.float32], there: NDArray[np.float32], share: NDArray[np.float32]) -> NDArray[np.float32]:
    there -= here
    there *= share
    there += here
    return there


def footprint(grid: Grid, pose: PadPose, shape: tuple[int, ...], pixel_mm: float) -> Footprint | None:
    """Return the pixels of a map under a pad whose patterns are (H, W), `pixel_mm` apart; None if there are none."""
    height, width = shape
    cosine, sine = cos(radians(pose.turn_deg)), sin(radians(pose.turn_deg))
    # Only the map's rows and columns that the pad reaches are looked at, however large the map is.
    along = _reached(grid, pose.x_mm - grid.centre_mm[0], (abs(cosine) * width + abs(sine) * height) * pixel_mm / 2)
    down = _reached(grid, pose.y_mm - grid.centre_mm[1], (abs(sine) * width + abs(cosine) * height) * pixel_mm / 2)
    if along is None or down is None:
        return None
    (first_col, x_mm), (first_row, y_mm) = along, down
    x_px, y_px = x_mm / np.float32(pixel_mm), y_mm / np.float32(pixel_mm)
    cols = np.float32(cosine) * x_px[None, :] + np.float32(sine) * y_px[:, None]
    rows = np.float32(cosine) * y_px[:, None] - np.float32(sine) * x_px[None, :]
    inside = np.flatnonzero((np.abs(cols) <= width / 2) & (np.abs(rows) <= height / 2))
    if not len(inside):
        return None
    row, col = np.divmod(inside, len(x_mm))
    return Footprint(
        (row + first_row) * grid.pixels + (col + first_col),
        rows.ravel()[inside] + np.float32((height - 1) / 2),
        cols.ravel()[inside] + np.float32((width - 1) / 2),
    )


def _reached(grid: Grid, centre_mm: float, reach_mm: float) -> tuple[int, NDArray[np.float32]] | None:
    """Return the first of the map's lines within reach, and the distance of each from a centre, in [mm]."""
    at = centre_mm * grid.px_per_mm + (grid.pixels - 1) / 2
    reach = reach_mm * grid.px_per_mm
    if not -reach <= at <= grid.pixels + reach:  # before it is made an integer: a pose may be a kilometre away
        return None
    first, last = max(0, int(np.ceil(at - reach))), min(grid.pixels - 1, int(np.floor(at + reach)))
    if first > last:
        return None
    return first, ((np.arange(first, last + 1) - at) / grid.px_per_mm).astype(np.float32)


def weigh(
    pattern: NDArray[np.float32], deviation: NDArray[np.float32] | None, pose: PadPose, pixel_mm: float, level: float
) -> tuple[NDArray[np.float32], float] | None:
    """Return the evidence (H, W, 4) of a pattern, and the height of its top in [mm]; None if it is flat.

    Evidence is the weight of what was covered, log odds of a touch, where the share of the top exceeds `level`,
    information about the height in [1/mm^2], and that information times the pattern.
    """
    height, width = pattern.shape
    top_mm = float(np.partition(pattern, -8, axis=None)[-8:].mean())
    if not top_mm >= 0.05:  # [mm]; it may be all drift: a free pad that has warmed by a few kelvin makes 0.02 mm
        return None
    variance = np.full_like(pattern, 0.05**2) if deviation is None else deviation * deviation
    variance += _moved(pattern, pose, pixel_mm)
    variance += np.float32(0.02**2)  # however sure a model is of a pixel
    spread = np.sqrt(variance + np.float32((0.15 * top_mm) ** 2))  # an edge is blurred even in a sure pattern
    # 1.702: log odds of a normal distribution per standard deviation, within 0.01 in probability.
    odds = (pattern - np.float32(level * top_mm)) * np.float32(1.702)
    odds /= spread
    np.clip(odds, -4, 4, out=odds)  # one pattern in fifty is wrong there however sure it is
    layers = np.empty((height, width, 4), dtype=np.float32)
    layers[..., 0] = 1
    layers[..., 1] = odds
    np.divide(odds > 0, variance, out=layers[..., 2])
    np.multiply(layers[..., 2], pattern, out=layers[..., 3])
    return layers, top_mm


def _moved(pattern: NDArray[np.float32], pose: PadPose, pixel_mm: float) -> NDArray[np.float32]:
    """Return the variance of each pixel by the pose's error: it matters where the pattern is steep."""
    slope = np.zeros_like(pattern)
    across = (pattern[:, 2:] - pattern[:, :-2]) / np.float32(2 * pixel_mm)
    down = (pattern[2:] - pattern[:-2]) / np.float32(2 * pixel_mm)
    slope[:, 1:-1] += across * across
    slope[1:-1] += down * down
    height, width = pattern.shape
    x2 = ((np.arange(width, dtype=np.float32) - (width - 1) / 2) * pixel_mm) ** 2
    y2 = ((np.arange(height, dtype=np.float32) - (height - 1) / 2) * pixel_mm) ** 2
    turned = np.float32(radians(pose.error_deg) ** 2 / 2)
    return slope * (np.float32(pose.error_mm**2) + turned * (x2[None, :] + y2[:, None]))


STEP_MM: Final = 0.5  # movement within which patterns are one piece of evidence, about one pixel of a pattern
_RADIUS_MM: Final = USPA44.rows * USPA44.pitch_mm / 6**0.5  # of the pad's points from its centre, root mean square


@dataclass(frozen=True, slots=True)
class MapLayers:
    """Layers of a map, (H, W) each, x to the right and y down, NaN where nothing is known."""

    height_mm: NDArray[np.float32]  # height against the map's top, which is 0, where the object was touched
    contact: NDArray[np.float32]  # probability that a press that covers it touches it
    deviation_mm: NDArray[np.float32]
    coverage: NDArray[np.float32]  # patterns that covered it and were believed, counted as the taps that they are worth
    doubted: NDArray[np.float32]  # the same of patterns that were not believed, which no other layer holds


@dataclass(slots=True)
class _Press:
    """Strongest press so far of a pad that has not left its place."""

    origin: PadPose
    pose: PadPose
    result: Result

    @property
    def rank(self) -> tuple[bool, float]:
        """Order of presses at one place: a believed one before a stronger one."""
        return self.result.trusted is not False, self.result.force_counts or 0.0


class ObjectMap:
    """Map of one object, a square of `size_mm` around `centre_mm` in the object's plane.

    A pixel of a pattern counts as touched from the share `contact_level` of its top on: a blurred edge of a flat part
    truly lies at a half. Raises a UsageError where the size or the centre is out of range.
    """

    def __init__(
        self,
        size_mm: float = SIZE_MM,
        px_per_mm: float = PX_PER_MM,
        *,
        centre_mm: tuple[float, float] = (0.0, 0.0),
        contact_level: float = 0.5,
    ) -> None:
        count = round(size_mm * px_per_mm) if 0 < size_mm * px_per_mm <= MOST_PX else 0
        if not count:
            raise UsageError(
                f"a map of {size_mm:g} mm at {px_per_mm:g} px/mm, expected 1 to {MOST_PX} pixels along a side"
            )
        if len(centre_mm) != 2 or not all(map(isfinite, centre_mm)):
            raise UsageError(f"the centre of a map is {centre_mm}, expected two finite numbers")
        self.grid = Grid(count, px_per_mm, centre_mm)
        self.counts = {"fused": 0, "doubted": 0, "light": 0, "outside": 0}  # light: not to be told from drift
        self._level = contact_level
        # Coverage, log odds of a touch, information about the height, and that times the height, as in the evidence.
        self._sums = np.zeros((count * count, 4), dtype=np.float32)
        self._doubts = np.zeros(count * count, dtype=np.float32)
        self._places: deque[PadPose] = deque(maxlen=256)  # that are counted and remembered: 128 mm of a slide
        self._checks = False
        self._presses: dict[str, _Press] = {}

    @property
    def fused(self) -> int:
        """Patterns on the map."""
        return self.counts["fused"]

    def blank(self) -> "ObjectMap":
        """Return an empty map of the same size at the same place, for another object."""
        pixels, px_per_mm, centre_mm = self.grid
        return ObjectMap(pixels / px_per_mm, px_per_mm, centre_mm=centre_mm, contact_level=self._level)

    def add(self, result: Result, pose: PadPose | None) -> None:
        """Take a result and the pose of its pad; without contact, or without a pose, the press before is over."""
        sensor = result.scan.sensor
        if result.pattern is None or pose is None:
            if pose is None or not result.contact:
                self._end(sensor)
            return
        if result.pattern_unit != "mm":
            raise UsageError(f"the model's patterns are in {result.pattern_unit}, expected mm: choose another model")
        self._checks = self._checks or result.trusted is not None
        before, press = self._presses.get(sensor), _Press(pose, pose, result)
        if before is not None and before.origin.away_mm(pose, _RADIUS_MM) < STEP_MM:
            if press.rank > before.rank:
                before.pose, before.result = pose, result
            return
        self._end(sensor)
        self._presses[sensor] = press

    def finish(self) -> None:
        """Take the presses that have not ended."""
        for sensor in tuple(self._presses):
            self._end(sensor)

    def layers(self) -> MapLayers:
        """Return the layers, with the presses that have not ended yet, which may still be replaced by stronger ones."""
        sums, doubts = self._with_open_presses()
        covered, odds, information, lifted = sums.T
        touched = (information > 0) & (odds > 0)
        nothing = np.full(len(sums), np.nan, dtype=np.float32)
        height_mm = np.divide(lifted, information, out=nothing.copy(), where=touched)
        if touched.any():
            height_mm -= np.quantile(height_mm[touched], 0.98)  # no single pixel is to define the map's top
        deviation_mm = np.divide(1, np.sqrt(information), out=nothing, where=touched)
        made = (height_mm, _contact(covered, odds), deviation_mm, covered.copy(), doubts.copy())
        shape = (self.grid.pixels, self.grid.pixels)
        return MapLayers(*(layer.reshape(shape).astype(np.float32, copy=False) for layer in made))

    def contact(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the layers `contact` and `doubted` alone, in a fifth of the time, as a live page shows them."""
        sums, doubts = self._with_open_presses()
        shape = (self.grid.pixels, self.grid.pixels)
        return _contact(sums[:, 0], sums[:, 1]).reshape(shape), doubts.reshape(shape).copy()

    def _with_open_presses(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        sums, doubts = self._sums, self._doubts
        if self._presses:
            sums, doubts = sums.copy(), doubts.copy()
            for press in self._presses.values():
                self._fuse(press, sums, doubts)
        return sums, doubts

    def _end(self, sensor: str) -> None:
        """Fuse the press of a sensor, which has ended or left its place."""
        press = self._presses.pop(sensor, None)
        if press is None:
            return
        fate = self._fuse(press, self._sums, self._doubts)
        if fate == "fused":
            self._places.append(press.pose)
        self.counts[fate] += 1

    def _fuse(self, press: _Press, sums: NDArray[np.float32], doubts: NDArray[np.float32]) -> str:
        """Add a press to layers, and return the counter of presses with its fate."""
        result, pose, pattern = press.result, press.pose, press.result.pattern
        if pattern is None:
            raise ValueError("the press has no pattern")
        pixel_mm = USPA44.rows * USPA44.pitch_mm / len(pattern)
        under = footprint(self.grid, pose, pattern.shape, pixel_mm)
        if under is None:
            return "outside"
        if result.trusted is False:
            doubts[under.pixels] += self._worth(pose)
            return "doubted"
        weighed = weigh(pattern, result.deviation, pose, pixel_mm, self._level)
        if weighed is None or (result.trusted is None and (self._checks or _too_light(result))):
            return "light"
        evidence, top_mm = weighed
        seen, before = under.read(evidence), sums[under.pixels]
        offset_mm = self._offset_mm(seen, before, top_mm)
        seen[:, 3] += np.float32(offset_mm) * seen[:, 2]
        seen *= np.float32(self._worth(pose))
        seen += before
        np.clip(seen[:, 1], -12, 12, out=seen[:, 1])  # so that an object that has moved can be seen again
        sums[under.pixels] = seen
        return "fused"

    def _offset_mm(self, seen: NDArray[np.float32], before: NDArray[np.float32], top_mm: float) -> float:
        """Return what a press adds to its pattern so that it agrees with the map where both touched."""
        both = np.flatnonzero((seen[:, 2] > 0) & (before[:, 2] > 0))
        if len(both) < 5.0 * self.grid.px_per_mm**2:  # [mm^2], about a quarter of a taxel's area
            return -top_mm  # its top is taken to be as high as the first press's, which is 0
        information, there = seen[both, 2], before[both]
        weight = information * there[:, 2] / (information + there[:, 2])
        offsets_mm = there[:, 3] / there[:, 2] - seen[both, 3] / information
        return float(weight @ offsets_mm / weight.sum())

    def _worth(self, pose: PadPose) -> float:
        """Return how many taps a pattern is worth beside those before: a whole one a pitch away, under other taxels."""
        away_mm = min((place.away_mm(pose, _RADIUS_MM) for place in self._places), default=inf)
        return min(1.0, max(0.05, away_mm / USPA44.pitch_mm))  # its noise and the error of its pose are always new


def _too_light(result: Result) -> bool:
    """Return whether a press is lighter than any that a model with checks would check, before it has checked one."""
    return result.window is not None and float(result.window[0, 2].max()) < LEAST_COUNTS


def _contact(covered: NDArray[np.float32], odds: NDArray[np.float32]) -> NDArray[np.float32]:
    nothing = np.full(len(odds), np.nan, dtype=np.float32)
    return np.divide(1, 1 + np.exp(-odds), out=nothing, where=covered > 0)
