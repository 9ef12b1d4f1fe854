"""Poses of the taps on a surface: the paper's schedule, and poses drawn at random.

The paper taps each surface at nine positions, turned nine ways: record = position * 9 + rotation. A target is a tap
whose pattern is reconstructed; the taps before it are made at the same place, each turned back by one more angle
step. Targets are split by position, and every K has the same ones: 504 to train on, 72 to validate, 72 to test.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from train.surfaces.depth_image import Pose
from train.surfaces.named_surfaces import SURFACES

ANGLE_STEP_DEG: Final = 5.0
MAX_TAPS: Final = 7
POSITIONS: Final = 9
TARGET_ANGLES_DEG: Final = (0.0, 30.0, 60.0, 90.0)
POSITION_STEP_MM: Final = 2.5
TEST_POSITION: Final = 0
VALIDATION_POSITION: Final = 1
HELD_OUT_RADIUS_MM: Final = 1.0
"""Distance that random poses keep from the two held-out positions, in [mm].

Only C, F, L, P, T and U are new there in every sense: the other surfaces are symmetric, and look as they do at another
position to a pad turned by 90, 120 or 180 degrees. It has no visible effect, see docs/decisions.md.
"""
REACH_MM: Final = 3.5
"""Largest distance of random poses from the surface's centre along x and along y, in [mm]."""

Split = Literal["train", "validation", "test"]


@dataclass(frozen=True, slots=True)
class Targets:
    """Taps whose patterns are reconstructed.

    Attributes:
        surfaces: n names.
        poses: n poses.
    """

    surfaces: list[str]
    poses: list[Pose]

    def __len__(self) -> int:
        return len(self.surfaces)


def position_mm(index: int) -> tuple[float, float]:
    """Return x and y in [mm] of one of the nine positions of the 3 x 3 grid."""
    return ((index % 3 - 1) * POSITION_STEP_MM, (1 - index // 3) * POSITION_STEP_MM)


def positions_of(split: Split) -> tuple[int, ...]:
    """Return the positions of a split: 0 to test, 1 to validate, the other seven to train on."""
    held_out = {"test": TEST_POSITION, "validation": VALIDATION_POSITION}
    if split in held_out:
        return (held_out[split],)
    return tuple(index for index in range(POSITIONS) if index not in held_out.values())


def paper_targets(positions: Sequence[int], surfaces: Sequence[str] = SURFACES) -> Targets:
    """Return every surface at the four target angles of each position; surfaces change slowest, angles fastest."""
    taps = [
        (name, Pose(*position_mm(position), angle_deg))
        for name in surfaces
        for position in positions
        for angle_deg in TARGET_ANGLES_DEG
    ]
    return Targets([name for name, _ in taps], [pose for _, pose in taps])


def random_targets(rng: np.random.Generator, count: int, surfaces: Sequence[str] = SURFACES) -> Targets:
    """Draw places and angles away from the held-out positions, with surfaces in turn."""
    held_out_mm = np.array([position_mm(TEST_POSITION), position_mm(VALIDATION_POSITION)])
    poses: list[Pose] = []
    while len(poses) < count:
        x_mm, y_mm = rng.uniform(-REACH_MM, REACH_MM, 2)
        angle_deg = rng.uniform(0, 360)
        if np.hypot(*(held_out_mm - (x_mm, y_mm)).T).min() > HELD_OUT_RADIUS_MM:
            poses.append(Pose(float(x_mm), float(y_mm), float(angle_deg)))
    return Targets([surfaces[i % len(surfaces)] for i in range(count)], poses)


def turned_back(targets: Targets, taps: int, angle_step_deg: float = ANGLE_STEP_DEG) -> NDArray[np.float64]:
    """Return poses (n, taps, 3) of the taps that end in each target, newest first: x, y in [mm], angle in [deg].

    Raises:
        ValueError: taps or angle_step_deg out of bounds.
    """
    if not 1 <= taps <= MAX_TAPS:
        raise ValueError(f"{taps} taps in a sequence: expected 1 to {MAX_TAPS}")
    if not 0 <= angle_step_deg <= 180:
        raise ValueError(f"angle step of {angle_step_deg} deg: expected 0 to 180")
    newest = np.array([(pose.x_mm, pose.y_mm, pose.angle_deg) for pose in targets.poses]).reshape(-1, 1, 3)
    back = np.zeros((1, taps, 3))
    back[..., 2] = angle_step_deg * np.arange(taps)[None]
    return newest - back


def over_surface(newest: Pose, x_mm: float, y_mm: float, turn_deg: float) -> Pose:
    """Return the pose over the surface of a pad at a place and a turn in the newest tap's axes.

    The pad faces the surface, so its y points the other way, and it turns the other way as well.
    """
    angle = np.radians(newest.angle_deg)
    cosine, sine = float(np.cos(angle)), float(np.sin(angle))
    right_mm, up_mm = cosine * x_mm + sine * y_mm, sine * x_mm - cosine * y_mm
    return Pose(newest.x_mm + right_mm, newest.y_mm + up_mm, newest.angle_deg - turn_deg)


def as_poses(array: NDArray[np.floating]) -> list[Pose]:
    """Return the poses of an array (..., 3), in order."""
    return [Pose(*(float(value) for value in row)) for row in array.reshape(-1, 3)]
