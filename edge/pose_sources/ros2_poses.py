"""Poses from ROS 2 over DDS, as a ROS node would subscribe to them, with no ROS installed."""

import os
import threading
import time
from collections.abc import Mapping
from typing import Any, Final

from cyclonedds.core import GuardCondition, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.util import duration

from edge.pipeline.pose_queue import PoseError, PoseQueue
from edge.pose_sources.stamped_poses import StampClock, pad_pose, placed
from edge.sinks.ros2.cdr_messages import POSE_STAMPED, POSE_WITH_COVARIANCE_STAMPED, TRANSFORM_STAMPED
from edge.sinks.ros2.dds_domain import join, reader, taken
from firmware_bridge.errors import CdrError
from firmware_bridge.poses import TimedPose
from firmware_bridge.recording.cdr import MessageType

_KEPT: Final = 128  # messages of a topic that wait until they are read


class Ros2Poses:
    """Subscriber in a thread of its own, whose poses go to the queue as they come."""

    def __init__(self, topic: str, queue: PoseQueue, sensor: str | None = None) -> None:
        """Subscribe to a topic, whichever type of pose is published there, now or later; for a sensor, or for all."""
        self._queue, self._sensor = queue, sensor
        self._clock = StampClock(lambda line: queue.warn("clock", line))
        self._domain, self._participant = join(os.environ)
        self._end = GuardCondition(self._participant)
        self._waiting = WaitSet(self._participant)
        self._waiting.attach(self._end)
        kinds = (POSE_STAMPED, POSE_WITH_COVARIANCE_STAMPED, TRANSFORM_STAMPED)
        self._readers = [(reader(self._participant, topic, kind, _KEPT, reliable=False), kind) for kind in kinds]
        state = SampleState.NotRead | ViewState.Any | InstanceState.Any
        self._conditions = [ReadCondition(one, state) for one, _ in self._readers]
        for condition in self._conditions:
            self._waiting.attach(condition)
        self._ended = False
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
            self._waiting.wait(duration(seconds=1))
            for waiting, kind in self._readers:
                for data in taken(waiting, _KEPT):
                    self._take(data, kind, time.monotonic_ns())

    def _take(self, data: bytes, kind: MessageType, arrival_ns: int) -> None:
        try:
            message = kind.decode(data)
            pose = pad_pose(*_placed(message))
        except PoseError as error:
            self._queue.refuse(error)
        except CdrError as error:
            self._queue.refuse(PoseError("cdr", str(error)))
        else:
            stamp = message["header"]["stamp"]
            time_ns = self._clock.monotonic_ns(stamp["sec"] * 1_000_000_000 + stamp["nanosec"], arrival_ns)
            self._queue.put(TimedPose(pose, time_ns, self._sensor))


def _placed(message: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return the place in a message of any of the types, and its covariance, which is empty without one."""
    if (transform := message.get("transform")) is not None:
        return placed(transform["translation"], transform["rotation"]), ()
    pose = message["pose"]
    covariance = pose.get("covariance", ())
    pose = pose.get("pose", pose)
    return placed(pose["position"], pose["orientation"]), covariance
