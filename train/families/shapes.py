"""Shapes under the pad: faces of solid bodies, round and rough shapes, and everyday solids."""

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Lengths = NDArray[np.float32]  # lengths at places on a grid, in [mm]
Height = Callable[[Lengths, Lengths], Lengths]  # height at x and y in [mm], NOWHERE_MM off the shape
# Height at x and y of the shape that a generator draws; the draws do not depend on the places.
Shape = Callable[[np.random.Generator, Lengths, Lengths], Lengths]

NOWHERE_MM: Final = -1e3  # height where there is no shape, out of any press's reach
SLOPE: Final = float(np.tan(np.radians(3.0)))  # largest tilt of a face against the pad: three degrees


def drawn(rng: np.random.Generator, shape: Shape) -> Height:
    """Draw a shape, and return its heights at any places."""
    before = deepcopy(rng)
    centre = np.zeros((1, 1), dtype=np.float32)
    shape(rng, centre, centre)  # draws what the next shape must not draw again
    return lambda x, y: shape(deepcopy(before), x, y)


@dataclass(frozen=True, slots=True)
class Lie:
    """Position, turn and tilt of a shape under the pad: x to the right of its centre, y down the rows."""

    x_mm: float = 0.0
    y_mm: float = 0.0
    angle_deg: float = 0.0
    slope_x: float = 0.0  # rise along the pad's x, in [mm/mm]
    slope_y: float = 0.0

    def seen(self, height: Height, x_mm: Lengths, y_mm: Lengths) -> Lengths:
        """Return the heights of the shape, placed like this, at places on the pad."""
        turn = np.radians(self.angle_deg)
        cosine, sine = np.float32(np.cos(turn)), np.float32(np.sin(turn))
        right, down = x_mm - np.float32(self.x_mm), y_mm - np.float32(self.y_mm)
        across, along = cosine * right + sine * down, cosine * down - sine * right
        raised = height(across.astype(np.float32, copy=False), along.astype(np.float32, copy=False))
        if self.slope_x or self.slope_y:
            raised = raised + np.float32(self.slope_x) * x_mm + np.float32(self.slope_y) * y_mm
        return raised.astype(np.float32, copy=False)


def where(inside: NDArray[np.bool_], height: NDArray[np.floating] | float) -> Lengths:
    """Return the height inside a shape, NOWHERE_MM elsewhere."""
    return np.where(inside, height, np.float32(NOWHERE_MM)).astype(np.float32, copy=False)


def raised(inside: NDArray[np.bool_], height_mm: float) -> Lengths:
    """Return a figure raised by `height_mm` from a plate at height 0."""
    return np.where(inside, np.float32(height_mm), np.float32(0))


def bulge(distance: Lengths, radius: float) -> NDArray[np.floating]:
    """Return the height of a circle below its top at a distance from it, level beyond its equator."""
    return np.sqrt(np.maximum(radius**2 - distance**2, 0)) - radius


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def flat(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Return a face larger than the pad."""
    return np.zeros_like(x)


def block(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Draw a rectangle of 3 to 40 mm with rounded corners."""
    wide, long = log_uniform(rng, 3, 40) / 2, log_uniform(rng, 3, 40) / 2
    corner = rng.uniform(0, 0.5) * min(wide, long)
    over_x, over_y = np.maximum(abs(x) - wide + corner, 0), np.maximum(abs(y) - long + corner, 0)
    return where(over_x**2 + over_y**2 <= corner**2 + 1e-9, 0.0)


def edge(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Draw a half plane; half of the edges are rounded."""
    radius = float(rng.choice([0.0, log_uniform(rng, 0.3, 5.0)]))
    over = np.maximum(x + radius, 0)
    return where(over <= radius, bulge(over, radius)) if radius else where(x <= 0, 0.0)


def corner(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Draw a corner of 50 to 150 degrees, convex or cut out."""
    half, cut = np.radians(rng.uniform(50, 150)) / 2, rng.random() < 0.3
    inside = abs(y) * np.cos(half) <= -x * np.sin(half)
    return where(~inside if cut else inside, 0.0)


def slot(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Draw a face with one or two parallel slots of 1 to 8 mm."""
    width, depth = log_uniform(rng, 1, 8), log_uniform(rng, 0.1, 5)
    second = rng.uniform(4, 12) if rng.random() < 0.4 else 1e3
    return raised((abs(x) < width / 2) | (abs(x - second) < width / 2), -depth)


def step(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Draw two faces side by side, one 0.05 to 0.5 mm lower."""
    return raised(x > 0, -log_uniform(rng, 0.05, 0.5))


def dome(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Draw a sphere of 3 to 300 mm radius."""
    radius, away = log_uniform(rng, 3, 300), np.hypot(x, y)
    return where(away < radius, bulge(away, radius))


def cylinder(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Draw a lying cylinder of 2 to 300 mm radius, some with an end."""
    radius, end = log_uniform(rng, 2, 300), rng.uniform(0, 9) if rng.random() < 0.3 else 1e3
    return where((y < end) & (abs(x) < radius), bulge(x, radius))


def cone(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Draw a cone of 2 to 45 degrees slope with a blunt tip."""
    slope, blunt = np.tan(np.radians(log_uniform(rng, 2, 45))), log_uniform(rng, 0.3, 3)
    return (-slope * (np.sqrt(x * x + y * y + blunt**2) - blunt)).astype(np.float32)


def ridge(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Draw a roof of 2 to 45 degrees on either side with a blunt top, some with an end."""
    left, right = (np.tan(np.radians(log_uniform(rng, 2, 45))) for _ in range(2))
    blunt, end = log_uniform(rng, 0.1, 2), rng.uniform(0, 9) if rng.random() < 0.3 else 1e3
    return where(y < end, -np.where(x > 0, right, left) * (np.sqrt(x * x + blunt**2) - blunt))


def wire(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Draw a straight or bent wire of 0.3 to 2 mm radius on a plate."""
    radius, bend = log_uniform(rng, 0.3, 2), rng.uniform(-0.06, 0.06) * (rng.random() < 0.5)
    across = (x - bend * y * y) / np.sqrt(1 + (2 * bend * y) ** 2)
    round_ = np.sqrt(np.maximum(radius**2 - across**2, 0)) + radius
    return np.where(abs(across) < radius, round_, 0).astype(np.float32) - 2 * radius


def saddle(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Draw a saddle or a bowl: two curvatures with independent signs, radii 8 to 300 mm."""
    across, along = log_uniform(rng, 8, 300), log_uniform(rng, 8, 300) * rng.choice([-1, 1])
    return (-x * x / (2 * across) + y * y / (2 * along)).astype(np.float32)


def relief(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Draw a smooth random surface with waves of 4 to 20 mm and 0.05 to 0.6 mm RMS."""
    shortest, rms = log_uniform(rng, 4, 14), log_uniform(rng, 0.05, 0.6)
    waves = 24
    q = 2 * np.pi / rng.uniform(shortest, 2 * shortest, waves)
    turn, phase = rng.uniform(0, 2 * np.pi, (2, waves))
    size = rng.normal(0, rms * np.sqrt(2 / waves), waves)
    total = np.zeros(x.shape, dtype=np.float32)
    # Wave by wave, which takes a fifth of the time of a sum over an axis of waves.
    for q_x, q_y, shift, high in np.stack([q * np.cos(turn), q * np.sin(turn), phase, size], 1).astype(np.float32):
        total += high * np.sin(q_x * x + q_y * y + shift)
    return total


def grating(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Draw bars or waves with a period of 2.5 to 14 mm."""
    period, duty, depth = log_uniform(rng, 2.5, 14), rng.uniform(0.3, 0.7), log_uniform(rng, 0.1, 2)
    phase, wavy = rng.uniform(0, 1), rng.random() < 0.4
    place = x / period + phase
    if wavy:
        return (depth / 2 * np.cos(2 * np.pi * place)).astype(np.float32)
    return raised(place - np.floor(place) >= duty, -depth)


def solid(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    """Draw one of the solids with random dimensions."""
    return SOLIDS[int(rng.integers(len(SOLIDS)))](rng, x, y)


def _coin(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    radius, rim = rng.uniform(6, 13), rng.uniform(0.6, 1.8)
    sunk, bust = rng.uniform(0.05, 0.2), rng.uniform(2, 5)
    away = np.hypot(x, y)
    return where(away < radius, np.where((away > radius - rim) | (np.hypot(x / 0.8, y) < bust), 0, -sunk))


def _washer(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    outer = rng.uniform(3, 10)
    inner = outer * rng.uniform(0.35, 0.65)
    return raised((np.hypot(x, y) < outer) & (np.hypot(x, y) > inner), 1.0)


def _nut(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    flats, hole = rng.uniform(3, 7), rng.uniform(0.4, 0.6)
    away, turn, sector = np.hypot(x, y), np.arctan2(y, x), np.pi / 3
    hexagon = away * np.cos(turn - sector * np.round(turn / sector)) < flats
    return raised(hexagon & (away > hole * flats), 2.0)


def _screw(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    radius, width, crossed = rng.uniform(3, 7), rng.uniform(0.8, 1.6), rng.random() < 0.5
    curve, away = log_uniform(rng, 8, 100), np.hypot(x, y)
    cut = (abs(x) < width / 2) & ((abs(y) < 0.7 * radius) | (not crossed))
    cut |= (abs(y) < width / 2) & (abs(x) < 0.7 * radius) & crossed
    return where((away < radius) & ~cut, -away * away / (2 * curve))


def _button(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    radius, hole, offset = rng.uniform(4, 9), rng.uniform(0.6, 1.1), rng.uniform(1.2, 2.0)
    holes, rim = int(rng.choice([2, 4])), rng.uniform(0.1, 0.4)
    away = np.hypot(x, y)
    pierced = np.hypot(abs(x) - offset, y if holes == 2 else abs(y) - offset) < hole
    return where((away < radius) & ~pierced, np.where(away > 0.75 * radius, 0.0, -rim))


def _key(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    half, length = rng.uniform(2.5, 4.5), 30.0
    teeth = rng.uniform(0.2, 0.9, 9) * half
    groove = rng.uniform(0.5, 1.2)
    tooth = teeth[np.clip((y / 2.5 + 4).astype(int), 0, 8)]
    inside = (x > -half) & (x < tooth) & (abs(y) < length)
    return where(inside, np.where(abs(x + 0.4 * half) < groove / 2, -0.4, 0.0))


def _cap(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    radius, teeth, deep = rng.uniform(8, 16), int(rng.integers(30, 90)), rng.uniform(0.2, 0.6)
    turn = np.arcsin(np.clip(x / radius, -1, 1))
    ribbed = radius * np.cos(turn) - radius + deep / 2 * np.cos(teeth * turn)
    return where((abs(x) < 0.9 * radius) & (abs(y) < 7), ribbed)


def _studs(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    pitch = rng.uniform(4, 9)
    radius = pitch * rng.uniform(0.2, 0.36)
    place_x, place_y = x - pitch * np.round(x / pitch), y - pitch * np.round(y / pitch)
    return raised(np.hypot(place_x, place_y) < radius, 1.6)


def _thread(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    radius, pitch = rng.uniform(3, 12), rng.uniform(0.8, 3)
    lead = y / pitch + np.arcsin(np.clip(x / radius, -1, 1)) / (2 * np.pi)
    groove = 0.6 * pitch * abs(lead - np.floor(lead) - 0.5)
    return where(abs(x) < radius, bulge(x, radius) - groove)


def _gear(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    radius, teeth, hole = rng.uniform(5, 11), int(rng.integers(8, 24)), rng.uniform(0.15, 0.4)
    away = np.hypot(x, y)
    outer = radius * (1 + 0.1 * np.sign(np.cos(teeth * np.arctan2(y, x))))
    return raised((away < outer) & (away > hole * radius), 2.0)


def _pen(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    radius, sides, clip = rng.uniform(3, 6), int(rng.choice([0, 6])), rng.random() < 0.4
    # A pencil lies on one of its flats.
    body = -np.maximum(abs(x) - 0.5 * radius, 0) * np.sqrt(3) if sides else bulge(x, radius)
    return where(abs(x) < radius, np.where((abs(x) < 1.2) & clip & (y > -3), 0.8, body))


def _plug(rng: np.random.Generator, x: Lengths, y: Lengths) -> Lengths:
    offset, wide, long = rng.uniform(2.5, 8), rng.uniform(0.8, 1.8), rng.uniform(2, 7)
    pins = int(rng.choice([2, 3]))
    inside = (abs(abs(x) - offset) < wide) & (abs(y) < long / 2)
    return raised(inside | ((np.hypot(x, y - offset) < wide) & (pins == 3)), 3.0)


SOLIDS: Final[tuple[Shape, ...]] = (
    *(_coin, _washer, _nut, _screw, _button, _key, _cap, _studs, _thread, _gear, _pen, _plug),
)
SHAPES: Final[Mapping[str, Shape]] = {  # families that are heights, by name
    **{shape.__name__: shape for shape in (flat, block, edge, corner, slot, step, dome, cylinder, cone, ridge)},
    **{shape.__name__: shape for shape in (wire, saddle, relief, grating, solid)},
}
