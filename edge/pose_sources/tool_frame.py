"""Pose of a pad in the plane of an object, from the pose of a tool frame in a frame of ROS. No I/O.

The tool frame has its origin at the middle of the pad's face: x to the right of a pattern, y up, z out of the pad, to
the object. The z of the other frame stands on the object's plane, towards the pad or away from it. docs/poses.md draws
both.
"""

from collections.abc import Mapping, Sequence
from math import acos, atan2, degrees, hypot, isfinite, sqrt
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.pipeline.pose_queue import PoseError
from firmware_bridge.poses.pad_pose import PLACE_ERROR_MM, TURN_ERROR_DEG, PadPose

MOST_TILT_DEG: Final = 10.0
"""Largest angle between the pad and the plane: beyond it the plane's x and y are no longer those of the pad."""
_UNIT_ERROR: Final = 0.01
_MM: Final = 1e3


class Placed(NamedTuple):
    """Place of a frame in another, in [m], and its rotation, a matrix."""

    place_m: NDArray[np.float64]
    rotation: NDArray[np.float64]


def placed(place: Mapping[str, float], quaternion: Mapping[str, float]) -> Placed:
    """Return the place and the rotation in a pose, or a transform, of ROS.

    Raises:
        PoseError: a number is not finite, or the quaternion is not a rotation.
    """
    x, y, z, w = (quaternion[name] for name in "xyzw")
    length = hypot(x, y, z, w)
    place_m = np.array([place[name] for name in "xyz"])
    if not (isfinite(length) and np.isfinite(place_m).all()):
        raise PoseError("finite", "its place or its quaternion is not finite, expected numbers")
    if abs(length - 1) > _UNIT_ERROR:
        raise PoseError("quaternion", f"its quaternion has length {length:.3g}, expected 1")
    x, y, z, w = x / length, y / length, z / length, w / length
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return Placed(place_m, rotation)


def pad_pose(tool: Placed, covariance: Sequence[float] | NDArray[Any] = ()) -> PadPose:
    """Return the pose of the pad.

    Args:
        tool: tool frame in the frame of the plane.
        covariance: (36,) of x, y, z in [m] and of turns about them in [rad], as in PoseWithCovariance; where it is
            empty, zero or negative, the usual errors hold.

    Raises:
        PoseError: the pad is tilted out of the plane, or the place is out of range.
    """
    rotation = tool.rotation
    tilt_deg = degrees(acos(min(abs(float(rotation[2, 2])), 1.0)))
    if tilt_deg > MOST_TILT_DEG:
        raise PoseError(
            "tilt",
            f"the pad is tilted by {tilt_deg:.0f} degrees out of the plane, expected at most {MOST_TILT_DEG:g}: is it "
            "the right frame, with z out of the pad?",
        )
    # Our z points into the pad, against the tool's, and so does that of the plane. Where z of the frame points from the
    # pad into the object, the plane's axes are the frame's turned by half a turn about x, so that y changes its sign.
    side = 1.0 if rotation[2, 2] < 0 else -1.0
    error_mm, error_deg = _errors(covariance)
    try:
        return PadPose(
            _MM * float(tool.place_m[0]),
            side * _MM * float(tool.place_m[1]),
            degrees(atan2(side * float(rotation[1, 0]), float(rotation[0, 0]))),
            error_mm,
            error_deg,
        )
    except ValueError as error:
        raise PoseError("range", str(error)) from error


def _errors(covariance: Sequence[float] | NDArray[Any]) -> tuple[float, float]:
    if len(covariance) == 0:
        return PLACE_ERROR_MM, TURN_ERROR_DEG
    place_m2, turn_rad2 = max(float(covariance[0]), float(covariance[7])), float(covariance[35])
    return (
        _MM * sqrt(place_m2) if place_m2 > 0 else PLACE_ERROR_MM,
        degrees(sqrt(turn_rad2)) if turn_rad2 > 0 else TURN_ERROR_DEG,
    )
