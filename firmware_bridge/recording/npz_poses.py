"""Poses in the arrays of an npz: pose_time_ns and pose, and as wanted pose_sensor, pose_holds and pose_used_from_ns."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.errors import RecordingError
from firmware_bridge.recording.pose_columns import POSE_FIELDS, PoseColumns
from firmware_bridge.recording.tracks import MOST_SENSORS

NPZ_POSES: Final = ("pose_time_ns", "pose", "pose_sensor", "pose_holds", "pose_used_from_ns")
_KINDS: Final[dict[str, str]] = dict(zip(NPZ_POSES, ("iu", "fiu", "U", "b", "iu"), strict=True))


def npz_poses(path: Path, arrays: Mapping[str, NDArray[Any]]) -> PoseColumns | None:
    """Return the poses in these arrays; None without.

    Raises:
        RecordingError: an array has another shape, or values that are impossible.
    """
    found = {name: arrays[name] for name in NPZ_POSES if name in arrays}
    if not found:
        return None
    for name in NPZ_POSES[:2]:
        if name not in found:
            raise RecordingError(f"{path}, array '{name}': missing, expected together with '{next(iter(found))}'")
    count = found["pose_time_ns"].size
    for name, array in found.items():
        shape = (count, len(POSE_FIELDS)) if name == "pose" else (count,)
        if array.dtype.kind not in _KINDS[name] or array.shape != shape:
            got = f"{array.dtype} of shape {array.shape}"
            raise RecordingError(f"{path}, array '{name}': {got}, expected {_wanted(name)} of shape {shape}")
    if not count:
        return None
    names, sensor = np.unique(found.get("pose_sensor", np.zeros(count, "U1")), return_inverse=True)
    if len(names) > MOST_SENSORS:
        raise RecordingError(f"{path}, array 'pose_sensor': {len(names)} sensors, expected at most {MOST_SENSORS}")
    try:
        return PoseColumns(
            _whole(found["pose_time_ns"]),
            found["pose"].astype(np.float64),
            tuple(names.tolist()),
            sensor.astype(np.int32),
            found.get("pose_holds", np.zeros(count, bool)),
            _whole(found.get("pose_used_from_ns", np.full(count, -1))),
        )
    except ValueError as error:
        raise RecordingError(f"{path}, array 'pose' or another of the poses: {error}") from error


def _whole(array: NDArray[Any]) -> NDArray[np.int64]:
    """Return whole numbers as int64; those beyond it stay beyond all limits."""
    return np.minimum(array, np.iinfo(np.int64).max).astype(np.int64)


def _wanted(name: str) -> str:
    return {"U": "text", "b": "truth values", "iu": "whole numbers", "fiu": "numbers"}[_KINDS[name]]
