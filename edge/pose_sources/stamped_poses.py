"""Pose of a pad in the plane of an object, and its time, from a stamped pose of ROS, as docs/poses.md draws it."""

import time
from collections.abc import Callable, Mapping, Sequence
from math import acos, atan2, degrees, hypot, isfinite, sqrt
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.pipeline.pose_queue import PoseError
from firmware_bridge.poses import PLACE_ERROR_MM, TURN_ERROR_DEG, PadPose
from firmware_bridge.scans.device_clock import DeviceClock

MOST_TILT_DEG: Final = 10.0
"""Largest angle between the pad and the plane: beyond it the plane's x and y are no longer those of the pad."""
EARLY_NS: Final = 2_000_000
"""Longest time before its stamp at which a pose seems to arrive, in [ns]: the error of clocks that are synchronised."""
LATE_NS: Final = 250_000_000
"""Longest time after its stamp at which the fastest pose arrives, in [ns]: later, no scan could use it."""
_UNIT_ERROR: Final = 0.01


class Placed(NamedTuple):
    """Place of a frame in another, in [m], and its rotation, a matrix."""

    place_m: NDArray[np.float64]
    rotation: NDArray[np.float64]


def placed(place: Mapping[str, float], quaternion: Mapping[str, float]) -> Placed:
    """Return a pose, or a transform, of ROS; a PoseError where it is not finite, or its quaternion is no rotation."""
    x, y, z, w = (quaternion[name] for name in "xyzw")
    length = hypot(x, y, z, w)
    place_m = np.array([place[name] for name in "xyz"])
    if not (isfinite(length) and np.isfinite(place_m).all()):
        raise PoseError("finite", "its place or its quaternion is not finite, expected numbers")
    if abs(length - 1) > _UNIT_ERROR:
        raise PoseError("quaternion", f"its quaternion has length {length:.3g}, expected 1")
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) / length  # the cross product with the axis
    return Placed(place_m, np.eye(3) + 2 * (w / length * across + across @ across))


def pad_pose(tool: Placed, covariance: Sequence[float] | NDArray[Any] = ()) -> PadPose:
    """Return the pose of the pad, of its tool frame in the frame of the plane.

    The covariance is (36,) of x, y, z in [m] and of turns about them in [rad], as in PoseWithCovariance; where it is
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
    x_mm, y_mm, _ = (1e3 * tool.place_m).tolist()
    turn_deg = degrees(atan2(side * float(rotation[1, 0]), float(rotation[0, 0])))
    place_m2, turn_rad2 = (max(covariance[0], covariance[7]), covariance[35]) if len(covariance) else (0.0, 0.0)
    error_mm = 1e3 * sqrt(place_m2) if place_m2 > 0 else PLACE_ERROR_MM
    error_deg = degrees(sqrt(turn_rad2)) if turn_rad2 > 0 else TURN_ERROR_DEG
    try:
        return PadPose(x_mm, side * y_mm, turn_deg, error_mm, error_deg)
    except ValueError as error:
        raise PoseError("range", str(error)) from error


class StampClock:
    """Map from stamps of one source of poses to monotonic time, by this machine's wall clock.

    Clocks that do not agree, of which `warn` takes one line, show it: even the fastest pose of the last seconds seems
    to arrive before its time, or long after. Then the smallest delay counts as none.
    """

    def __init__(
        self,
        warn: Callable[[str], object],
        unix_offset_ns: Callable[[], int] = lambda: time.time_ns() - time.monotonic_ns(),
    ) -> None:
        self._warn, self._unix_offset_ns = warn, unix_offset_ns
        self._clock = DeviceClock(1, None)

    def monotonic_ns(self, stamp_ns: int, arrival_ns: int) -> int:
        """Return the monotonic time of a stamp in [ns], never after its arrival; without a stamp, 0, its arrival."""
        if not stamp_ns:
            return arrival_ns
        by_arrivals_ns = self._clock.host_ns(stamp_ns, arrival_ns)
        by_wall_ns = stamp_ns - self._unix_offset_ns()
        delay_ns = by_arrivals_ns - by_wall_ns  # the smallest of the last seconds
        if -EARLY_NS <= delay_ns <= LATE_NS:
            return min(by_wall_ns, arrival_ns)
        side = "behind" if delay_ns > 0 else "ahead of"
        self._warn(
            f"the time stamps of poses are {abs(delay_ns) / 1e9:.3g} s {side} this machine's clock, so they are placed "
            "by their arrival: keep both clocks together (chrony, PTP)"
        )
        return by_arrivals_ns
