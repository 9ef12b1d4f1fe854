"""Schedules of taps: where the pad was in earlier taps, in the newest one's axes.

A pose is x, y in [mm] and a turn in [deg], as in `firmware_bridge.poses.pad_pose`; schedules are newest tap first.
"""

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import USPA44
from train.surfaces.poses import ANGLE_STEP_DEG

HALF_PITCH_MM: Final = USPA44.pitch_mm / 2
REACH_MM: Final = 6.0
"""Largest distance of an earlier tap: two thirds of both pads overlap at least, side by side."""
NEAR_MM: Final = 3.0
NEAR_DEG: Final = 45.0
"""Bounds of most random poses."""
_STEP_MM: Final = (0.3, 3.0)
"""Bounds of the step of a slide from tap to tap."""
_DRIFT_DEG: Final = 3.0
_QUARTER: Final = ((1, 0), (0, 1), (1, 1))

Schedule = Callable[[np.random.Generator, int], NDArray[np.float64]]
"""Function from draws and a number of taps, K, to their poses (K, 3)."""


def turns(rng: np.random.Generator, taps: int) -> NDArray[np.float64]:
    """Return the paper's schedule: the pad turns by a step from tap to tap, at one place."""
    poses = np.zeros((taps, 3))
    poses[:, 2] = ANGLE_STEP_DEG * np.arange(taps)
    return poses


def half_pitch(rng: np.random.Generator, taps: int) -> NDArray[np.float64]:
    """Return taps shifted by half a pitch: three make the grid twice as fine, the next ones lie on the other sides."""
    signs = rng.choice([-1, 1], 2)
    first = np.array(_QUARTER) * signs
    others = np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if (x, y) != (0, 0)])
    rest = np.array([one for one in others if not (one == first).all(axis=1).any()])
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
    low, high = np.log(_STEP_MM)
    step_mm = min(float(np.exp(rng.uniform(low, high))), REACH_MM / max(taps - 1, 1))
    way, turn_deg = rng.uniform(0, 2 * np.pi), rng.uniform(-_DRIFT_DEG, _DRIFT_DEG)
    return np.arange(taps, dtype=np.float64)[:, None] * np.array(
        [step_mm * np.cos(way), step_mm * np.sin(way), turn_deg]
    )


def mixed(rng: np.random.Generator, taps: int) -> NDArray[np.float64]:
    """Return a schedule of any kind, as in training."""
    kinds = (turns, half_pitch, near, far, slide)
    return kinds[int(rng.choice(len(kinds), p=(0.2, 0.25, 0.3, 0.1, 0.15)))](rng, taps)


def schedule_of(name: str) -> Schedule:
    """Return a schedule by its name; `turns:30` turns by 30 degrees from tap to tap.

    Raises:
        ValueError: there is no schedule of that name.
    """
    if name.startswith("turns:"):
        step = float(name.partition(":")[2]) / ANGLE_STEP_DEG
        if not 0 <= step * ANGLE_STEP_DEG <= 180:
            raise ValueError(f"{name}: expected a turn of 0 to 180 degrees")
        return lambda rng, taps: turns(rng, taps) * step
    if name not in SCHEDULES:
        raise ValueError(f"no schedule {name!r}: expected one of {', '.join(SCHEDULES)}, or turns:DEGREES")
    return SCHEDULES[name]


SCHEDULES: Final[Mapping[str, Schedule]] = {
    "turns": turns,
    "half-pitch": half_pitch,
    "near": near,
    "far": far,
    "slide": slide,
    "mixed": mixed,
}
"""Schedules by name."""


def _within(rng: np.random.Generator, taps: int, reach_mm: float, turn_deg: float) -> NDArray[np.float64]:
    away_mm, way = reach_mm * np.sqrt(rng.random(taps)), rng.uniform(0, 2 * np.pi, taps)
    poses = np.stack([away_mm * np.cos(way), away_mm * np.sin(way), rng.uniform(-turn_deg, turn_deg, taps)], axis=1)
    poses[0] = 0
    return poses
