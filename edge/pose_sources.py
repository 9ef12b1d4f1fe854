"""Poses of the pad from ROS 2, with no ROS installed, into the queue of poses of `edge/pipeline/pose_queue.py`.

docs/poses.md draws how a stamped pose of a tool frame becomes a pad's in an object's plane.
"""

import os
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from math import acos, atan2, degrees, hypot, isfinite, sqrt
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.errors import UsageError
from edge.pipeline.pose_queue import PoseError, PoseQueue
from edge.sinks.registry import needs_cyclone_dds
from edge.sinks.ros2.messages import TYPES, base_topic
from firmware_bridge.errors import CdrError
from firmware_bridge.poses import PLACE_ERROR_MM, TURN_ERROR_DEG, PadPose, TimedPose
from firmware_bridge.recording.cdr import MessageType
from firmware_bridge.scans.device_clock import DeviceClock


def check_poses(text: str) -> tuple[str | None, str]:
    """Return sensor and topic of the source of poses that `text` names, or raise a UsageError."""
    match = re.fullmatch(r"(?:([A-Za-z0-9_/-]{1,64})=)?ros2:(.+)", text, re.DOTALL)
    if match is None:
        raise UsageError(f"no source of poses {text!r}: expected ros2:TOPIC, or SENSOR=ros2:TOPIC")
    return match[1], base_topic(match[2])


def open_poses(text: str, queue: PoseQueue) -> "PoseSource":
    """Open the source of poses that `text` names, as for `check_poses`; they go to the queue."""
    sensor, topic = check_poses(text)
    with needs_cyclone_dds(text):
        return PoseSource(topic, queue, sensor)


_KEPT: Final = 128  # messages of a topic that wait until they are read
MOST_TILT_DEG: Final = 10.0
"""Largest angle between the pad and the plane: beyond it the plane's x and y are no longer those of the pad."""
EARLY_NS: Final = 2_000_000
"""Longest time before its stamp at which a pose seems to arrive, in [ns]: the error of clocks that are synchronised."""
LATE_NS: Final = 250_000_000
"""Longest time after its stamp at which the fastest pose arrives, in [ns]: later, no scan could use it."""


def pad_pose(
    place: Mapping[str, float], quaternion: Mapping[str, float], covariance: Sequence[float] | NDArray[Any] = ()
) -> PadPose:
    """Return the pose of the pad, of a pose or transform of its tool frame in the frame of the plane, in [m].

    The covariance is (36,) of x, y, z in [m] and of turns about them in [rad], as in PoseWithCovariance; where it is
    empty, zero or negative, the usual errors hold. Raises a PoseError for numbers that are not finite, a quaternion
    that is no rotation, a tilted pad, or a place out of range.
    """
    x, y, z, w = (quaternion[name] for name in "xyzw")
    length = hypot(x, y, z, w)
    place_m = np.array([place[name] for name in "xyz"])
    if not (isfinite(length) and np.isfinite(place_m).all()):
        raise PoseError("finite", "its place or its quaternion is not finite, expected numbers")
    if abs(length - 1) > 0.01:
        raise PoseError("quaternion", f"its quaternion has length {length:.3g}, expected 1")
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) / length  # the cross product with the axis
    rotation = np.eye(3) + 2 * (w / length * across + across @ across)
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
    x_mm, y_mm, _ = (1e3 * place_m).tolist()
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


class PoseSource:
    """Subscriber in a thread of its own, whose poses go to the queue as they come."""

    def __init__(self, topic: str, queue: PoseQueue, sensor: str | None = None) -> None:
        """Subscribe to a topic, whichever type of pose is published there, now or later; for a sensor, or for all."""
        from cyclonedds.core import GuardCondition, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
        from cyclonedds.util import duration

        from edge.sinks.ros2.dds_domain import join, reader, taken

        self._queue, self._sensor = queue, sensor
        self._clock = StampClock(lambda line: queue.warn("clock", line))
        self._domain, self._participant = join(os.environ)
        self._end = GuardCondition(self._participant)
        self._waiting = WaitSet(self._participant)
        self._waiting.attach(self._end)
        names = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped")
        kinds = [TYPES[f"geometry_msgs/{name}"] for name in names]
        self._readers = [(reader(self._participant, topic, kind, _KEPT, reliable=False), kind) for kind in kinds]
        state = SampleState.NotRead | ViewState.Any | InstanceState.Any
        self._conditions = [ReadCondition(topic_reader, state) for topic_reader, _ in self._readers]
        for condition in self._conditions:
            self._waiting.attach(condition)
        self._ended, self._taken, self._second = False, taken, duration(seconds=1)
        self._thread = threading.Thread(target=self._follow, name="ros2-poses", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, and leave the domain."""
        self._ended = True
        self._end.set(True)
        self._thread.join()
        # Each is deleted with its last reference: readers before the participant, the participant before its domain.
        del self._conditions, self._readers, self._waiting, self._end, self._participant, self._domain

    def _follow(self) -> None:
        while not self._ended:
            self._waiting.wait(self._second)
            for waiting, kind in self._readers:
                for data in self._taken(waiting, _KEPT):
                    self._take(data, kind, time.monotonic_ns())

    def _take(self, data: bytes, kind: MessageType, arrival_ns: int) -> None:
        try:
            message = kind.decode(data)
            pose = pad_pose(*_parts(message))
        except PoseError as error:
            self._queue.refuse(error)
        except CdrError as error:
            self._queue.refuse(PoseError("cdr", str(error)))
        else:
            stamp = message["header"]["stamp"]
            time_ns = self._clock.monotonic_ns(stamp["sec"] * 1_000_000_000 + stamp["nanosec"], arrival_ns)
            self._queue.put(TimedPose(pose, time_ns, self._sensor))


def _parts(message: Mapping[str, Any]) -> tuple[Any, Any, Any]:
    """Return place, quaternion and covariance of a message of any of the types; the last is empty where it has none."""
    if (transform := message.get("transform")) is not None:
        return transform["translation"], transform["rotation"], ()
    pose = message["pose"]
    covariance = pose.get("covariance", ())
    pose = pose.get("pose", pose)
    return pose["position"], pose["orientation"], covariance
