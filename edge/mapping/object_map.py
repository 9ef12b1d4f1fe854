"""Map of an object in its own plane, larger than the pad, in memory that does not grow with the run.

Evidence is counted by the distance that the pad has moved, and not by the scan, since a model makes the same mistake
again while the same part of the object lies under the same taxels. Heights are those of a press plus an offset, by
which it agrees with what lies on the map already where both touched.
"""

from dataclasses import dataclass
from math import hypot, radians, sin
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.errors import UsageError
from edge.mapping.evidence import CONTACT_LEVEL, MOST_PX, PX_PER_MM, SIZE_MM, Grid, footprint, weigh
from edge.perception.pattern_check import LEAST_COUNTS
from edge.perception.result import Result
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses import PadPose

STEP_MM: Final = 0.5  # movement within which patterns are one piece of evidence, about one pixel of a pattern
PLACES: Final = 256  # places that are remembered as counted: 128 mm of a slide
_RADIUS_MM: Final = USPA44.rows * USPA44.pitch_mm / 6**0.5
"""Distance from the pad's centre at which a turn moves its points, at the root of their mean square."""


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
    """Strongest press so far of a pad that has not left its place, which began at `origin`."""

    origin: PadPose
    pose: PadPose
    result: Result

    @property
    def rank(self) -> tuple[bool, float]:
        """Order of presses at one place: a believed one before a stronger one."""
        return self.result.trusted is not False, self.result.force_counts or 0.0


class ObjectMap:
    """Map of one object, a square of `size_mm` around `centre_mm` in the object's plane.

    A pixel of a pattern counts as touched from the share `contact_level` of its top on. Raises a UsageError where the
    size is out of range.
    """

    def __init__(
        self,
        size_mm: float = SIZE_MM,
        px_per_mm: float = PX_PER_MM,
        *,
        centre_mm: tuple[float, float] = (0.0, 0.0),
        contact_level: float = CONTACT_LEVEL,
    ) -> None:
        count = round(size_mm * px_per_mm) if 0 < size_mm * px_per_mm <= MOST_PX else 0
        if not count:
            raise UsageError(
                f"a map of {size_mm:g} mm at {px_per_mm:g} px/mm, expected 1 to {MOST_PX} pixels along a side"
            )
        self.grid = Grid(count, px_per_mm, centre_mm)
        self.counts = {"fused": 0, "doubted": 0, "light": 0, "outside": 0}
        """Patterns by their fate; those of presses too light to tell from drift are left out."""
        self._level = contact_level
        # Coverage, log odds of a touch, information about the height, and that times the height, as in the evidence.
        self._sums = np.zeros((count * count, 4), dtype=np.float32)
        self._doubts = np.zeros(count * count, dtype=np.float32)
        self._places = np.full((PLACES, 3), 1e9)  # [mm]: far away
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
        """Take a result and the pose of its pad; without contact, or without a pose, the press before is over.

        Raises a UsageError where the pattern is not in [mm].
        """
        sensor = result.scan.sensor
        if result.pattern is None or pose is None:
            if pose is None or not result.contact:
                self._end(sensor)
            return
        if result.pattern_unit != "mm":
            raise UsageError(f"the model's patterns are in {result.pattern_unit}, expected mm: choose another model")
        self._checks = self._checks or result.trusted is not None
        before, press = self._presses.get(sensor), _Press(pose, pose, result)
        if before is not None and _apart_mm(before.origin, pose) < STEP_MM:
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
            pose = press.pose
            self._places[self.fused % PLACES] = pose.x_mm, pose.y_mm, radians(pose.turn_deg)
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
        evidence = weigh(pattern, result.deviation, pose, pixel_mm, self._level)
        if evidence is None or (result.trusted is None and (self._checks or _too_light(result))):
            return "light"
        seen, before = under.read(evidence.layers), sums[under.pixels]
        offset_mm = self._offset_mm(seen, before, evidence.top_mm)
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
        apart_mm = there[:, 3] / there[:, 2] - seen[both, 3] / information
        return float(weight @ apart_mm / weight.sum())

    def _worth(self, pose: PadPose) -> float:
        """Return how many taps a pattern is worth beside those before: a whole one a pitch away, under other taxels.

        It is never worth nothing, since its noise and the error of its pose are new.
        """
        x_mm, y_mm, turn_rad = self._places.T
        turned_mm = _RADIUS_MM * 2 * np.sin((turn_rad - radians(pose.turn_deg)) / 2)
        away_mm = np.sqrt((x_mm - pose.x_mm) ** 2 + (y_mm - pose.y_mm) ** 2 + turned_mm**2)
        return min(1.0, max(0.05, float(away_mm.min()) / USPA44.pitch_mm))


def _too_light(result: Result) -> bool:
    """Return whether a press is lighter than any that a model with checks would check, before it has checked one."""
    return result.window is not None and float(result.window[0, 2].max()) < LEAST_COUNTS


def _contact(covered: NDArray[np.float32], odds: NDArray[np.float32]) -> NDArray[np.float32]:
    nothing = np.full(len(odds), np.nan, dtype=np.float32)
    return np.divide(1, 1 + np.exp(-odds), out=nothing, where=covered > 0)


def _apart_mm(one: PadPose, other: PadPose) -> float:
    """Return how far the points of a pad move between two poses, at the root of their mean square."""
    turned_mm = _RADIUS_MM * 2 * sin(radians(one.turn_deg - other.turn_deg) / 2)
    return hypot(one.x_mm - other.x_mm, one.y_mm - other.y_mm, turned_mm)
