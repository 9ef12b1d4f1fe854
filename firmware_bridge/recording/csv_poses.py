"""Poses in the columns of a CSV: a pose of the pad at each row, or none."""

import math
from array import array
from collections.abc import Sequence
from typing import Final

import numpy as np

from firmware_bridge.poses.pad_pose import PLACE_ERROR_MM, TURN_ERROR_DEG
from firmware_bridge.recording.pose_columns import POSE_FIELDS, PoseColumns

CSV_POSES: Final = ("pose_x_mm", "pose_y_mm", "pose_turn_deg")


class CsvPoses:
    """Poses of rows, as they are read."""

    def __init__(self) -> None:
        """Begin without a row."""
        self._rows = array("q")
        self._values = array("d")

    def add(self, row: int, cells: Sequence[str]) -> str | None:
        """Take the pose of a row, none where all of its cells are empty; return the first cell that is no number."""
        if not any(cell.strip() for cell in cells):
            return None
        values: list[float] = []
        for cell in cells:
            try:
                values.append(float(cell))
            except ValueError:
                return cell
            if not math.isfinite(values[-1]):
                return cell
        if values:
            self._rows.append(row)
            self._values.extend((*values, 0.0)[:3])
            self._values.extend((PLACE_ERROR_MM, TURN_ERROR_DEG))
        return None

    def poses(self) -> PoseColumns | None:
        """Return the poses of all rows; None without any.

        Raises:
            ValueError: a value is out of range.
        """
        count = len(self._rows)
        if not count:
            return None
        rows = np.frombuffer(self._rows, np.int64)
        values = np.frombuffer(self._values, np.float64).reshape(-1, len(POSE_FIELDS))
        return PoseColumns(rows, values, ("",), np.zeros(count, np.int32), np.zeros(count, bool), rows, by_row=True)
