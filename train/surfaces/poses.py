"""Poses of the taps on a surface: the paper's schedule, poses drawn at random, and schedules of further taps.

A schedule says where the pad was in earlier taps, in the newest one's axes, newest tap first: x, y in [mm] and a turn
in [deg], as in `firmware_bridge.poses`. A target is a tap whose pattern is reconstructed; those before it are at the
same place, each turned back by one more angle step.
"""

from collections.abc import Callable, Mapping
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from edge.perception.taps import HALF_PITCH_MM
from train.surfaces.depth_image import Pose

Split = Literal["validation", "test"]
# Place of each split's targets: the first two of the paper's positions, a grid of 3 x 3 around the centre.
PLACES_MM: Final[Mapping[Split, tuple[float, float]]] = {"test": (-2.5, 2.5), "validation": (0.0, 2.5)}
ANGLE_STEP_DEG: Final = 5.0
MAX_TAPS: Final = 7
TARGET_ANGLES_DEG: Final = (0.0, 30.0, 60.0, 90.0)
HELD_OUT_RADIUS_MM: Final = 1.0  # distance that random poses keep from the two held-out positions
SURFACE_REACH_MM: Final = 3.5  # largest distance of random poses from the surface's centre along x and along y, in [mm]

REACH_MM: Final = 6.0  # largest distance of an earlier tap: two thirds of both pads overlap at least, side by side
NEAR_MM: Final = 3.0
NEAR_DEG: Final = 45.0  # bounds of most random poses

Schedule = Callable[[np.random.Generator, int], NDArray[np.float64]]  # from a number of taps, K, to their poses (K, 3)


def random_poses(rng: np.random.Generator, count: int) -> list[Pose]:
    """Draw places and angles away from the held-out positions."""
    held_out_mm = np.array([*PLACES_MM.values()])
    poses: list[Pose] = []
    while len(poses) < count:
        x_mm, y_mm = rng.uniform(-SURFACE_REACH_MM, SURFACE_REACH_MM, 2)
        angle_deg = rng.uniform(0, 360)
        if np.hypot(*(held_out_mm - (x_mm, y_mm)).T).min() > HELD_OUT_RADIUS_MM:
            poses.append(Pose(float(x_mm), float(y_mm), float(angle_deg)))
    return poses


def over_surface(newest: Pose, x_mm: float, y_mm: float, turn_deg: float) -> Pose:
    """Return the pose over the surface of a pad at a place and a turn in the newest tap's axes.

    The pad faces the surface, so its y points the other way, and it turns the other way as well.
    """
    angle = np.radians(newest.angle_deg)
    cosine, sine = float(np.cos(angle)), float(np.sin(angle))
    right_mm, up_mm = cosine * x_mm + sine * y_mm, sine * x_mm - cosine * y_mm
    return Pose(newest.x_mm + right_mm, newest.y_mm + up_mm, newest.angle_deg - turn_deg)


def turns(rng: np.random.Generator, taps: int) -> NDArray[np.float64]:
    """Return the paper's schedule: the pad turns by a step from tap to tap, at one place."""
    poses = np.zeros((taps, 3))
    poses[:, 2] = ANGLE_STEP_DEG * np.arange(taps)
    return poses


def half_pitch(rng: np.random.Generator, taps: int) -> NDArray[np.float64]:
    """Return taps shifted by half a pitch: three make the grid twice as fine, the next ones lie on the other sides."""
    first = [tuple(place) for place in np.array([(1, 0), (0, 1), (1, 1)]) * rng.choice([-1, 1], 2)]
    rest = [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if (x, y) not in [(0, 0), *first]]
    poses = np.zeros((taps, 3))
    poses[1:, :2] = np.concatenate([rng.permutation(first), rng.permutation(rest)])[: taps - 1] * HALF_PITCH_MM
    return poses


def near(rng: np.random.Generator, taps: int) -> NDArray[np.float64]:
    """Return poses drawn evenly within NEAR_MM and NEAR_DEG of the newest tap."""
    return _within(rng, taps, NEAR_MM, NEAR_DEG)


def far(rng: np.random.Generator, taps: int) -> NDArray[np.float64]:
    """Return poses drawn evenly within the reach, turned by any angle."""
    return _within(rng, taps, REACH_MM, 180.0)


def slide(rng: np.random.Generator, taps: int) -> NDArray[np.float64]:
    """Return moments of a slide: even steps in one direction, with a slow turn."""
    low, high = np.log((0.3, 3.0))
    step_mm = min(float(np.exp(rng.uniform(low, high))), REACH_MM / max(taps - 1, 1))
    way, turn_deg = rng.uniform(0, 2 * np.pi), rng.uniform(-3.0, 3.0)
    step = np.array([step_mm * np.cos(way), step_mm * np.sin(way), turn_deg])
    return np.arange(taps, dtype=np.float64)[:, None] * step


def mixed(rng: np.random.Generator, taps: int) -> NDArray[np.float64]:
    """Return a schedule of any kind, as in training."""
    kinds = (turns, half_pitch, near, far, slide)
    return kinds[int(rng.choice(len(kinds), p=(0.2, 0.25, 0.3, 0.1, 0.15)))](rng, taps)


def schedule_of(name: str) -> Schedule:
    """Return a schedule by its name, or ValueError; `turns:30` turns by 30 degrees from tap to tap."""
    if name.startswith("turns:"):
        step = float(name.partition(":")[2]) / ANGLE_STEP_DEG
        if not 0 <= step * ANGLE_STEP_DEG <= 180:
            raise ValueError(f"{name}: expected a turn of 0 to 180 degrees")
        return lambda rng, taps: turns(rng, taps) * step
    if name not in SCHEDULES:
        raise ValueError(f"no schedule {name!r}: expected one of {', '.join(SCHEDULES)}, or turns:DEGREES")
    return SCHEDULES[name]


def _within(rng: np.random.Generator, taps: int, reach_mm: float, turn_deg: float) -> NDArray[np.float64]:
    away_mm, way = reach_mm * np.sqrt(rng.random(taps)), rng.uniform(0, 2 * np.pi, taps)
    poses = np.stack([away_mm * np.cos(way), away_mm * np.sin(way), rng.uniform(-turn_deg, turn_deg, taps)], axis=1)
    poses[0] = 0
    return poses


SCHEDULES: Final[Mapping[str, Schedule]] = {
    kind.__name__.replace("_", "-"): kind for kind in (turns, half_pitch, near, far, slide, mixed)
}
