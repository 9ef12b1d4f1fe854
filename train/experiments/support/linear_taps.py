"""Linear map of taps at fixed places: what several taps are worth without geometry or a learned shape."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.classical_methods import fit_linear_map
from firmware_bridge.pad_geometry import USPA44
from train.data.generation_config import SEED
from train.data.press_batches import read_presses
from train.data.presses import PressSet
from train.errors import DatasetError
from train.physics.gripped import SCALE
from train.physics.sensor_noise import Nuisances
from train.surfaces.poses import ANGLE_STEP_DEG
from train.surfaces.tap_schedules import HALF_PITCH_MM

TAPS: Final = (1, 4)
SCHEDULES: Final = ("half-pitch", "turns")
"""Schedules whose taps lie at the same places each time."""
_SAME: Final = 0.01
"""Difference from a schedule, in half pitches and [deg], below which a true pose is of it."""
_SQUARE: Final = np.array([[1, 0], [0, 1], [1, 1]])
"""Places of three earlier taps in half pitches, once the window is mirrored so that they lie to the right and below."""


@dataclass(frozen=True, slots=True)
class LinearTaps:
    """Map from the readings of one tap or of four, in the order of their places, to the newest one's pattern.

    Attributes:
        matrices: by number of taps, (48 taps, pixels), to patterns in [mm].
    """

    matrices: dict[int, NDArray[np.float32]]

    def __call__(self, windows: NDArray[np.floating], poses: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return patterns (n, H, W) in [mm] of windows (n, K, 3, rows, cols) in zeroed counts with poses (n, K, 5)."""
        ordered, mirrored = _ordered(windows, poses)
        side = USPA44.rows * SCALE
        found = (ordered.reshape(len(ordered), -1) @ self.matrices[windows.shape[1]]).reshape(-1, side, side)
        return _mirrored(found.astype(np.float32), mirrored)


def fit_linear_taps(presses: PressSet, schedule: str) -> LinearTaps:
    """Fit the map on the sequences of one of SCHEDULES, each read once by a sensor of its own.

    Raises:
        DatasetError: no sequence follows the schedule.
    """
    presses = presses.with_taps(max(TAPS))
    there = presses.counts.any(axis=(2, 3, 4)).sum(axis=1) == presses.taps
    presses = presses.pick(np.flatnonzero(there & _follow(presses.poses, schedule)))
    if not len(presses):
        raise DatasetError(f"no sequences of {max(TAPS)} taps {schedule}: make more with 'make_presses --taps'")
    readings = read_presses(presses, Nuisances(), SEED)
    ordered, mirrored = _ordered(readings, presses.poses)
    patterns = _mirrored(presses.patterns.astype(np.float32), mirrored).reshape(len(presses), -1)
    return LinearTaps({taps: fit_linear_map(ordered[:, :taps].reshape(len(ordered), -1), patterns) for taps in TAPS})


def _follow(poses: NDArray[np.floating], schedule: str) -> NDArray[np.bool_]:
    """Return which poses (n, K, 3) are those of a schedule."""
    shifts, turns_deg = poses[:, 1:, :2] / HALF_PITCH_MM, poses[:, 1:, 2]
    if schedule == "half-pitch":
        places = np.abs(np.take_along_axis(shifts, _order(shifts)[..., None], 1)) - _SQUARE
    else:
        places, turns_deg = shifts, turns_deg - ANGLE_STEP_DEG * np.arange(1, poses.shape[1])
    off = np.concatenate([places, turns_deg[..., None]], axis=2)
    return np.abs(off).max(axis=(1, 2)) < _SAME


def _order(shifts: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the order (n, K - 1) of earlier taps: to the side, up or down, both."""
    x, y = np.moveaxis(np.abs(shifts), 2, 0)
    return np.argsort(np.rint(x) + 2 * np.rint(y), axis=1, kind="stable")


def _ordered(
    windows: NDArray[np.floating], poses: NDArray[np.floating]
) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Return windows in the order of their taps' places, and which were mirrored along x and y, (n, 2)."""
    shifts = poses[:, 1:, :2] / HALF_PITCH_MM
    mirrored = shifts.sum(axis=1) < -1  # three taps of a square add up to two half pitches each way
    order = np.concatenate([np.zeros((len(windows), 1), dtype=np.int64), 1 + _order(shifts)], axis=1)
    windows = np.take_along_axis(windows, order[:, :, None, None, None], axis=1)
    signs = np.concatenate([np.where(mirrored, -1, 1), np.ones((len(windows), 1))], axis=1)
    return _mirrored(windows, mirrored) * signs[:, None, :, None, None], mirrored


def _mirrored(maps: NDArray, mirrored: NDArray[np.bool_]) -> NDArray:
    """Return maps (n, ..., H, W) of which some are mirrored along x and y, (n, 2)."""
    which = mirrored.reshape(len(maps), 2, *[1] * (maps.ndim - 1))
    maps = np.where(which[:, 0], maps[..., ::-1], maps)
    return np.where(which[:, 1], maps[..., ::-1, :], maps)
