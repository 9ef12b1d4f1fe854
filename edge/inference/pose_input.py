"""Poses of a window's taps as model input: one row for each tap, in the axes of the newest tap's pad."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.poses import PLACE_ERROR_MM, TURN_ERROR_DEG, PadPose

POSE_KEYS: Final = ("dx_mm", "dy_mm", "turn_deg", "error_mm", "error_deg")  # of a row; the newest tap has zeros
POSE_WIDTH: Final = len(POSE_KEYS)


def pose_rows(poses: Sequence[PadPose]) -> NDArray[np.float32]:
    """Return the poses (taps, 5) of taps as model input; the first is the newest."""
    rows = np.zeros((len(poses), POSE_WIDTH), dtype=np.float32)
    for row, pose in zip(rows[1:], poses[1:], strict=True):
        seen = pose.seen_from(poses[0])
        row[:] = (seen.x_mm, seen.y_mm, seen.turn_deg, seen.error_mm, seen.error_deg)
    return rows


def scheduled_rows(taps: int, angle_step_deg: float) -> NDArray[np.float32]:
    """Return the poses (taps, 5) of taps by the paper's schedule: tap k before the newest is turned by k steps."""
    rows = np.zeros((taps, POSE_WIDTH), dtype=np.float32)
    turn_deg = angle_step_deg * np.arange(1, taps)
    rows[1:, 2] = (turn_deg + 180) % 360 - 180
    rows[1:, 3:] = PLACE_ERROR_MM, TURN_ERROR_DEG
    return rows
