"""Grips of a flat face larger than the pad, as `edge-sr doctor` asks for them: from light to strong, then dragged."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import AXES
from train.data.generation_config import one_thread
from train.physics.gripped import GrippedPad
from train.physics.sensor_noise import Nuisances, read_windows

GRIPS: Final = 3
LEVELS: Final = 8
"""Moments of a grip while it becomes stronger."""
DRAGS: Final = 6
"""Moments of each of the two drags, along x and along y."""
SCANS: Final = LEVELS + 2 * DRAGS
_Z_COUNTS: Final = (150.0, 1000.0)
"""Mean z of the lightest moment and of the strongest, 2 and 14 N on a middle pad; each grip's differ by a fifth."""
_SPREAD: Final = 0.2
_TILT: Final = np.tan(np.radians(0.25))
"""Standard deviation of the face's slope along x and y: a hand lets the face lie down on the pad."""
_ROCK: Final = 0.3
"""Largest change of the slope during a grip, over the slope at its beginning."""
_DRAG_COUNTS: Final = 250.0
"""Mean change of x or y at the end of a drag; each drag's differs by a fifth."""
_FRICTION: Final = (0.4, 1.0)
_TRIAL_MM: Final = (0.2, 0.03)
"""Indentation and slide of a trial, from which those of the grips are scaled."""


@one_thread()
def flat_grips(gripped: GrippedPad, rng: np.random.Generator, grips: int = GRIPS) -> NDArray[np.float32]:
    """Return zeroed, clean counts (grips, SCANS, 3, rows, cols) of a pad.

    Each grip grows over LEVELS moments; then the face is dragged along x, either way, and along y. Its place under the
    pad does not matter, since it is flat and larger.
    """
    size, cell_mm = gripped.size, gripped.cell_mm
    across = (np.arange(size) - (size - 1) / 2) * cell_mm
    uneven = gripped.uneven_cells_mm()
    depth_mm, slide_mm = _TRIAL_MM
    level = np.zeros((1, size, size))
    trial = gripped.read_faces(level, np.array([depth_mm]), np.array([[slide_mm, 0.0]]), np.ones(1))[0]
    x, z = (abs(float(trial[AXES.index(axis)].mean())) for axis in "xz")
    growth = np.linspace(0, 1, LEVELS)
    share = np.concatenate([growth, np.ones(2 * DRAGS)])
    cells, depth, slide = [], [], []
    for _ in range(grips):
        low, high = np.multiply(_Z_COUNTS, 1 + _SPREAD * rng.uniform(-1, 1, 2)) * depth_mm / z
        far = rng.choice([-1.0, 1.0], 2) * (1 + _SPREAD * rng.uniform(-1, 1, 2)) * _DRAG_COUNTS * slide_mm / x
        start = rng.normal(0, _TILT, 2).clip(-2 * _TILT, 2 * _TILT)
        rock = start * _ROCK * rng.uniform(-1, 1, 2)
        moved = np.zeros((SCANS, 2))
        for axis in (0, 1):
            drag = slice(LEVELS + axis * DRAGS, LEVELS + (axis + 1) * DRAGS)
            moved[drag, axis] = far[axis] * np.linspace(0, 1, DRAGS)
        for one, by in zip(share, moved, strict=True):
            slope = start + rock * one
            face = slope[0] * across[None, :] + slope[1] * across[:, None] + uneven
            cells.append(face - face.min())
            depth.append(low + (high - low) * one + (face.mean() - face.min()))
            slide.append(by)
    friction = np.repeat(rng.uniform(*_FRICTION, grips), SCANS)
    counts = gripped.read_faces(np.array(cells), np.array(depth), np.array(slide), friction)
    return counts.reshape(grips, SCANS, *counts.shape[1:])


def read_grips(clean: NDArray[np.float32], gains: NDArray[np.floating], seed: list[int]) -> NDArray[np.float32]:
    """Return the grips as one sensor with these gains (3, rows, cols) reads them, all other nuisances drawn."""
    flat = (clean * gains).astype(np.float32).reshape(1, -1, 1, *clean.shape[2:])
    read = read_windows(flat, 1.0, Nuisances().without("gain_spread"), seed, tap_s=1.0)[0]
    return read.reshape(clean.shape)


def even_gains(gripped: GrippedPad, perfect: GrippedPad) -> NDArray[np.float64]:
    """Return what the seats and moments of a pad's magnets do to z under an even load, (rows, cols)."""
    even = np.full((1, 1, gripped.size, gripped.size), 0.02, dtype=np.float32)
    z = AXES.index("z")
    return gripped.skin.frames(even)[0, 0, z].astype(np.float64) / perfect.skin.frames(even)[0, 0, z]
