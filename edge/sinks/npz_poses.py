"""Poses of a recording in npz: rows in a file of their own during the run, arrays at its end."""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.lib import format as npy

from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.recording.pose_columns import POSE_FIELDS
from firmware_bridge.scans.scan import LONGEST_SENSOR_NAME

ROWS: Final = "poses"
_ROW: Final = np.dtype(
    [
        ("pose_time_ns", "<i8"),
        ("pose", "<f8", (len(POSE_FIELDS),)),
        ("pose_sensor", f"<U{LONGEST_SENSOR_NAME}"),
        ("pose_holds", "?"),
        ("pose_used_from_ns", "<i8"),
    ]
)


def pose_rows(poses: Sequence[TimedPose]) -> bytes:
    """Return the rows of poses."""
    rows = [
        (
            one.time_ns,
            tuple(getattr(one.pose, name) for name in POSE_FIELDS),
            one.sensor or "",
            one.holds,
            -1 if one.used_from_ns is None else one.used_from_ns,
        )
        for one in poses
    ]
    return np.array(rows, _ROW).tobytes()


def add_pose_arrays(archive: zipfile.ZipFile, path: Path) -> None:
    """Add the arrays of the rows in a file, if there are any; a last row that a crash left incomplete is left out.

    Raises:
        OSError: it cannot be read, or the archive cannot be written.
    """
    count = path.stat().st_size // _ROW.itemsize if path.exists() else 0
    if not count:
        return
    rows = np.memmap(path, _ROW, mode="r", shape=count)
    for name in _ROW.names or ():
        with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
            npy.write_array(entry, rows[name])
