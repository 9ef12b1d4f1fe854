"""Sequences of taps to learn from and to be judged on: poses, splits, and windows with nuisances.

A sequence is K taps on one surface by one sensor at one place, each turned ANGLE_STEP_DEG from the last; the newest
tap is the target. Training poses are drawn at random; the frozen test and validation sets sit at two positions
around which training draws no pose.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.frozen import FrozenSet
from firmware_bridge.geometry import SensorGeometry
from train.depth import Pose
from train.simulation import MAX_INDENTATION_MM, SimulatedSensor, UnitTaps
from train.skin import Nuisances, draw_gains, read_counts
from train.surfaces import SURFACES

ANGLE_STEP_DEG: Final = 5.0
MAX_TAPS: Final = 4
FRAMES: Final = 16
"""Frames of a tap in the test set, from FIRST_SHARE of its set force to all of it."""
FIRST_SHARE: Final = 0.3
TEST_FORCE_N: Final = 5.0
SET_FORCE_N: Final = (1.5, 8.0)
"""Bounds of the set forces of training taps."""
TEST_ANGLES_DEG: Final = (0.0, 30.0, 60.0, 90.0)
POSITION_STEP_MM: Final = 2.5
TEST_POSITION: Final = 0
VALIDATION_POSITION: Final = 1
_HELD_OUT_RADIUS_MM: Final = 1.0
_REACH_MM: Final = 3.5
_BATCH: Final = 96
_SET_FORCE_SPREAD: Final = (0.85, 1.15)
"""A robot does not end every tap at the same force."""


def position_mm(index: int) -> tuple[float, float]:
    """One of the nine positions, a 3 x 3 grid, x and y in [mm]."""
    return ((index % 3 - 1) * POSITION_STEP_MM, (1 - index // 3) * POSITION_STEP_MM)


@dataclass(frozen=True, slots=True)
class Sequences:
    """Solved sequences of taps, newest tap first.

    Attributes:
        surface: (n,) index into SURFACES.
        readings: (n, MAX_TAPS, 3, rows, cols) counts per mm of indentation.
        force_n_per_mm: (n, MAX_TAPS), in [N/mm].
        patterns: (n, H, W) of the newest tap, mm per mm.
    """

    surface: NDArray[np.int64]
    readings: NDArray[np.float32]
    force_n_per_mm: NDArray[np.float32]
    patterns: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.surface)

    def pick(self, index: NDArray[np.int64]) -> "Sequences":
        """The sequences of the given indices."""
        return Sequences(self.surface[index], self.readings[index], self.force_n_per_mm[index], self.patterns[index])

    def end_mm(self, force_n: NDArray[np.floating]) -> NDArray[np.float32]:
        """Indentation (n, MAX_TAPS) at which taps of set forces (n, MAX_TAPS) end, in [mm]."""
        flat = UnitTaps(self.readings, self.force_n_per_mm, self.patterns)
        return flat.indentation_mm(force_n)


def solve_sequences(
    sensor: SimulatedSensor,
    surfaces: list[str],
    newest: list[Pose],
    progress: Callable[[int], object] = lambda count: None,
) -> Sequences:
    """Tap each surface MAX_TAPS times, ending at the pose given; earlier taps are turned back step by step."""
    poses = [
        Pose(pose.x_mm, pose.y_mm, pose.angle_deg - back * ANGLE_STEP_DEG)
        for pose in newest
        for back in range(MAX_TAPS)
    ]
    names = [name for name in surfaces for _ in range(MAX_TAPS)]
    parts: list[UnitTaps] = []
    edges = [*range(0, len(poses), _BATCH), len(poses)]
    for start, stop in pairwise(edges):
        parts.append(sensor.tap(names[start:stop], poses[start:stop]))
        progress(stop - start)
    count = len(newest)
    readings = np.concatenate([part.readings for part in parts])
    force = np.concatenate([part.force_n_per_mm for part in parts])
    patterns = np.concatenate([part.patterns[::MAX_TAPS] for part in parts])
    return Sequences(
        np.array([SURFACES.index(name) for name in surfaces]),
        readings.reshape(count, MAX_TAPS, *readings.shape[1:]),
        force.reshape(count, MAX_TAPS),
        patterns,
    )


def random_poses(rng: np.random.Generator, count: int) -> tuple[list[str], list[Pose]]:
    """Surfaces in turn, places and angles at random, none near the held-out positions."""
    held_out = np.array([position_mm(TEST_POSITION), position_mm(VALIDATION_POSITION)])
    poses: list[Pose] = []
    while len(poses) < count:
        x_mm, y_mm = rng.uniform(-_REACH_MM, _REACH_MM, 2)
        angle_deg = rng.uniform(0, 360)
        if np.hypot(*(held_out - (x_mm, y_mm)).T).min() > _HELD_OUT_RADIUS_MM:
            poses.append(Pose(float(x_mm), float(y_mm), float(angle_deg)))
    return [SURFACES[i % len(SURFACES)] for i in range(count)], poses


def held_out_poses(position: int) -> tuple[list[str], list[Pose]]:
    """Every surface at the four test angles of one held-out position."""
    x_mm, y_mm = position_mm(position)
    pairs = [(name, Pose(x_mm, y_mm, angle)) for name in SURFACES for angle in TEST_ANGLES_DEG]
    return [name for name, _ in pairs], [pose for _, pose in pairs]


def freeze(sensor: SimulatedSensor, position: int, nuisances: Nuisances, seed: int) -> FrozenSet:
    """The frames of one held-out position; each sequence is tapped by another sensor (gains)."""
    rng = np.random.default_rng([seed, position])
    surfaces, poses = held_out_poses(position)
    solved = solve_sequences(sensor, surfaces, poses)
    count = len(solved)
    end_mm = solved.end_mm(np.full((count, MAX_TAPS), TEST_FORCE_N))
    gains = draw_gains(rng, nuisances, sensor.geometry, count, MAX_TAPS)
    newest_mm = end_mm[:, :1] * np.linspace(FIRST_SHARE, 1.0, FRAMES)
    newest = read_counts(rng, solved.readings[:, :1] * gains[:, :1] * newest_mm[..., None, None, None], nuisances)
    earlier = read_counts(rng, solved.readings[:, 1:] * gains[:, 1:] * end_mm[:, 1:, None, None, None], nuisances)
    return FrozenSet(
        newest=newest.reshape(-1, *sensor.geometry.scan_shape).astype(np.int16),
        earlier=earlier.astype(np.int16),
        tap=np.repeat(np.arange(count), FRAMES).astype(np.int16),
        indentation_mm=newest_mm.ravel().astype(np.float32),
        force_n=(newest_mm * solved.force_n_per_mm[:, :1]).ravel().astype(np.float32),
        unit_patterns=solved.patterns.astype(np.float16),
        surface=np.array(surfaces),
        angle_deg=np.array([pose.angle_deg for pose in poses], dtype=np.float32),
        full_scale_mm=MAX_INDENTATION_MM,
    )


def training_batches(
    solved: Sequences,
    rng: np.random.Generator,
    nuisances: Nuisances,
    geometry: SensorGeometry,
    batch: int,
    force_n: tuple[float, float],
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """One epoch of windows (batch, MAX_TAPS, 3, rows, cols) in zeroed counts and patterns (batch, H, W) in [mm].

    Set forces are drawn per tap between the bounds of `force_n`, the newest tap is anywhere between first touch and
    its end, and every window is read by another sensor.
    """
    order = rng.permutation(len(solved))
    for start in range(0, len(order) - batch + 1, batch):
        part = solved.pick(order[start : start + batch])
        force = rng.uniform(*force_n, (batch, 1)) * rng.uniform(*_SET_FORCE_SPREAD, (batch, MAX_TAPS))
        depth_mm = part.end_mm(force)
        depth_mm[:, 0] *= rng.uniform(FIRST_SHARE, 1.0, batch)
        gains = draw_gains(rng, nuisances, geometry, batch, MAX_TAPS)
        windows = read_counts(rng, part.readings * gains * depth_mm[..., None, None, None], nuisances)
        yield quarter_turns(windows, part.patterns * depth_mm[:, 0, None, None], int(rng.integers(4)))


def quarter_turns(
    windows: NDArray[np.float32], patterns: NDArray[np.float32], quarters: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The same contacts felt by a pad turned clockwise: maps turn, and the shear (x, y) turns with them."""
    turned, maps = windows, np.rot90(patterns, quarters, axes=(-2, -1))
    for _ in range(quarters):
        x, y, z = np.moveaxis(np.rot90(turned, 1, axes=(-2, -1)), -3, 0)
        turned = np.stack([y, -x, z], axis=-3)
    return turned, maps
