"""Slides of a pad over a raised flat figure larger than itself: readings, poses and the pad's true place."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses.pad_pose import PLACE_ERROR_MM, TURN_ERROR_DEG, PadPose
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import Pad, draw_pad
from train.physics.sensor_noise import Nuisances, Seed, apply_nuisances
from train.surfaces.named_surfaces import FIGURE_HEIGHT_MM

SPEED_MM_S: Final = 20.0
SCAN_HZ: Final = 100.0
FIGURE_MM: Final = 50.0
LANES_MM: Final = (-18.0, -6.0, 6.0, 18.0)
"""Places of the lanes across the slide, in [mm]: each pixel is seen by one or two of them."""
HALF_LENGTH_MM: Final = 30.0
_RASTER_MM: Final = 0.05
_DRAG_MM: Final = 0.3
"""Movement of the object against the pad's face that friction carries while it slides, in [mm]."""
_FRICTION: Final = (0.2, 0.8)
_INDENTATION_MM: Final = (0.15, 0.4)
_AT_ONCE: Final = 50


@dataclass(frozen=True, slots=True)
class Slide:
    """Lanes of one slide over a figure.

    Attributes:
        counts: (n, 3, rows, cols), as read; zero-mean noise where the pad touches nothing.
        lane: (n,), number of the lane of each scan.
        poses: (n,), as stated by a robot.
        places: (n, 3), true x, y in [mm] and turn in [deg].
        pad: that slid.
        outline: of the figure in the map's plane, x to the right and y down, in [mm].
    """

    counts: NDArray[np.float32]
    lane: NDArray[np.int64]
    poses: list[PadPose]
    places: NDArray[np.float64]
    pad: Pad
    outline: BaseGeometry


def scaled(outline: BaseGeometry, stroke_mm: float | None = None, size_mm: float = FIGURE_MM) -> BaseGeometry:
    """Scale a figure to a longest side, centred with y down, and if asked thin its strokes to a mean width."""
    down = _fitted(affinity.scale(outline, 1, -1, origin=(0, 0)), size_mm)
    if stroke_mm is None or _stroke_mm(down) <= stroke_mm:
        return down
    least_mm, most_mm = 0.0, shapely.length(shapely.maximum_inscribed_circle([down]))[0]
    for _ in range(20):  # by bisection, since what is eroded is scaled up again
        middle_mm = (least_mm + most_mm) / 2
        thin = down.buffer(-middle_mm, join_style="mitre")
        if thin.is_empty or _stroke_mm(_fitted(thin, size_mm)) < stroke_mm:
            most_mm = middle_mm
        else:
            least_mm = middle_mm
    return _fitted(down.buffer(-least_mm, join_style="mitre"), size_mm)


def _fitted(outline: BaseGeometry, size_mm: float) -> BaseGeometry:
    left, low, right, high = outline.bounds
    x_mm, y_mm, factor = (left + right) / 2, (low + high) / 2, size_mm / max(right - left, high - low)
    return affinity.translate(affinity.scale(outline, factor, factor, origin=(x_mm, y_mm)), -x_mm, -y_mm)


def _stroke_mm(outline: BaseGeometry) -> float:
    """Return the mean width of strokes, of which each has two long sides."""
    return 2 * outline.area / outline.length


def slide(
    outline: BaseGeometry,
    seed: int,
    *,
    spread: float = 1.0,
    lanes_mm: Sequence[float] = LANES_MM,
    nuisances: Nuisances | None = None,
    sensor: Seed | None = None,
) -> Slide:
    """Slide a drawn pad over a figure, in lanes along x there and back, with the nuisances of real sensors.

    A robot's error of pose is drawn once for each lane: that of a mounting by hand does not average out.

    Args:
        outline: of the figure, as `scaled` returns it.
        seed: of the pad and of its way.
        spread: of the pad's constants; 0 for the nominal pad.
        lanes_mm: places of the lanes across the slide, in [mm].
        nuisances: of the sensor; by default all of a real one.
        sensor: seed of the nuisances; by default drawn from `seed`.
    """
    rng = np.random.default_rng([seed, 18])
    pad = draw_pad(rng, spread) if spread else Pad()
    gripped = GrippedPad(pad)
    raster = _Raster(outline)
    length = round(2 * HALF_LENGTH_MM / SPEED_MM_S * SCAN_HZ)
    along = np.linspace(-HALF_LENGTH_MM, HALF_LENGTH_MM, length)
    friction = rng.uniform(*_FRICTION)
    counts, lanes, places, poses = [], [], [], []
    for number, y_mm in enumerate(lanes_mm):
        way = 1 if number % 2 == 0 else -1
        turn_deg = float(rng.uniform(-10, 10))
        place = np.stack([way * along, np.full(length, y_mm), np.full(length, turn_deg)], axis=1)
        wave = np.sin(2 * np.pi * (np.arange(length) / length * rng.uniform(1, 3) + rng.random()))
        deep_mm = np.mean(_INDENTATION_MM) + wave * np.ptp(_INDENTATION_MM) / 2
        clean = _pressed(gripped, raster, place, deep_mm, way, friction)
        counts.append(clean)
        lanes.append(np.full(length, number))
        places.append(place)
        off_mm, off_deg = rng.normal(0, PLACE_ERROR_MM, 2), rng.normal(0, TURN_ERROR_DEG)
        poses += [PadPose(x + off_mm[0], y + off_mm[1], turn + off_deg) for x, y, turn in place]
    clean = np.stack(counts)[None]
    turns = np.array([[place[0, 2] for place in places]])
    drawn = [seed, 19] if sensor is None else sensor
    read = apply_nuisances(clean, nuisances or Nuisances(), drawn, tap_s=length / SCAN_HZ, angle_deg=-turns)
    flat = read.reshape(-1, *USPA44.scan_shape)
    return Slide(flat, np.concatenate(lanes), poses, np.concatenate(places), pad, outline)


class _Raster:
    """Heights of a figure, looked up at any place; the pad is not to reach the plate under it."""

    def __init__(self, outline: BaseGeometry) -> None:
        half = HALF_LENGTH_MM + USPA44.width_mm
        centres = np.arange(-half, half, _RASTER_MM) + _RASTER_MM / 2
        self._half, self._count = half, len(centres)
        shapely.prepare(outline)
        inside = np.stack([shapely.contains_xy(outline, centres, np.full(len(centres), y)) for y in centres])
        self._heights_mm = np.where(inside, 0, -FIGURE_HEIGHT_MM).astype(np.float32)

    def under(self, place: NDArray[np.float64], x_mm: NDArray, y_mm: NDArray) -> NDArray[np.float32]:
        turn = np.radians(place[2])
        right = place[0] + np.cos(turn) * x_mm - np.sin(turn) * y_mm
        down = place[1] + np.sin(turn) * x_mm + np.cos(turn) * y_mm
        col, row = (
            np.clip(((at + self._half) / _RASTER_MM).astype(np.int64), 0, self._count - 1) for at in (right, down)
        )
        return self._heights_mm[row, col]


def _pressed(
    gripped: GrippedPad, raster: _Raster, place: NDArray[np.float64], deep_mm: NDArray, way: int, friction: float
) -> NDArray[np.float32]:
    x_mm, y_mm = np.broadcast_arrays(*gripped.places_mm)
    counts = np.zeros((len(place), *USPA44.scan_shape), dtype=np.float32)
    for start in range(0, len(place), _AT_ONCE):
        heights = np.stack([raster.under(one, x_mm, y_mm) for one in place[start : start + _AT_ONCE]])
        meets = np.flatnonzero((heights > -FIGURE_HEIGHT_MM / 2).any(axis=(1, 2)))
        if not len(meets):
            continue
        turn = np.radians(place[start + meets, 2])
        # The object drags the face against the pad's way, in the pad's axes.
        drag = -way * _DRAG_MM * np.stack([np.cos(turn), -np.sin(turn)], axis=1)
        still, even = np.zeros(len(meets)), np.full(len(meets), friction)
        done = gripped.press(heights[meets], deep_mm[start + meets], drag, still, even)
        counts[start + meets] = done.counts
    return counts
