"""Poses from ROS 2 over DDS, as a ROS node would subscribe to them, with no ROS installed."""

import os
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from cyclonedds.core import DDSException, GuardCondition, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.internal import InvalidSample
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from edge.errors import SinkError
from edge.pipeline.pose_queue import PoseError, PoseQueue
from edge.pose_sources.stamp_clock import StampClock
from edge.pose_sources.tool_frame import pad_pose, placed
from edge.sinks.ros2.dds_domain import join
from edge.sinks.ros2.dds_types import dds_type
from edge.sinks.ros2.ros_types import POSE_STAMPED, POSE_WITH_COVARIANCE_STAMPED, TRANSFORM_STAMPED
from firmware_bridge.errors import CdrError
from firmware_bridge.poses.pad_pose import PadPose
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.recording.cdr import MessageType

_KEPT: Final = 128
"""Messages of a topic that wait until they are read."""
_WAIT: Final = duration(seconds=1)
_CDR: Final = Policy.DataRepresentation(use_cdrv0_representation=True)
# A best-effort reader takes messages of reliable and of best-effort writers.
_STREAM: Final = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(_KEPT), _CDR)


class _Read(NamedTuple):
    """Pose in a message, and its time in [ns] since 1970."""

    pose: PadPose
    stamp_ns: int


class Ros2Poses:
    """Subscriber in a thread of its own, whose poses go to the queue as they come."""

    def __init__(
        self, topic: str, queue: PoseQueue, sensor: str | None = None, environment: Mapping[str, str] = os.environ
    ) -> None:
        """Subscribe to a topic, whichever type of pose is published there, now or later.

        Args:
            topic: its name, without the first slash.
            queue: of the poses.
            sensor: sensor of the poses, None for all.
            environment: ROS_DOMAIN_ID and others are read from it.

        Raises:
            UsageError: the environment is not valid in ROS.
            SinkError: the domain cannot be joined.
        """
        self._queue, self._sensor = queue, sensor
        self._clock = StampClock(lambda line: queue.warn("clock", line))
        self._domain, self._participant = join(environment)
        self._end = GuardCondition(self._participant)
        self._waiting = WaitSet(self._participant)
        self._waiting.attach(self._end)
        self._readers: list[tuple[DataReader[Any], MessageType]] = []
        self._conditions: list[ReadCondition] = []
        state = SampleState.NotRead | ViewState.Any | InstanceState.Any
        for kind in _READ:
            try:
                reader = DataReader(self._participant, Topic(self._participant, f"rt/{topic}", dds_type(kind)), _STREAM)
            except DDSException as error:
                raise SinkError(f"cannot subscribe to /{topic}: {error}") from error
            self._readers.append((reader, kind))
            self._conditions.append(ReadCondition(reader, state))
            self._waiting.attach(self._conditions[-1])
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
            self._waiting.wait(_WAIT)
            for reader, kind in self._readers:
                for sample in reader.take(N=_KEPT):
                    if not isinstance(sample, InvalidSample):  # else its writer has gone
                        self._take(sample.encoded, kind, time.monotonic_ns())

    def _take(self, data: bytes, kind: MessageType, arrival_ns: int) -> None:
        try:
            read = _READ[kind](kind.decode(data))
        except (CdrError, PoseError) as error:
            refusal = error if isinstance(error, PoseError) else PoseError("cdr", str(error))
            self._queue.refuse(refusal)
            return
        time_ns = self._clock.monotonic_ns(read.stamp_ns, arrival_ns)
        self._queue.put(TimedPose(read.pose, time_ns, self._sensor))


def _stamp_ns(message: Mapping[str, Any]) -> int:
    stamp = message["header"]["stamp"]
    return stamp["sec"] * 1_000_000_000 + stamp["nanosec"]


def _of_pose(message: Mapping[str, Any]) -> _Read:
    pose = message["pose"]
    return _Read(pad_pose(placed(pose["position"], pose["orientation"])), _stamp_ns(message))


def _of_uncertain_pose(message: Mapping[str, Any]) -> _Read:
    pose, covariance = message["pose"]["pose"], message["pose"]["covariance"]
    return _Read(pad_pose(placed(pose["position"], pose["orientation"]), covariance), _stamp_ns(message))


def _of_transform(message: Mapping[str, Any]) -> _Read:
    transform = message["transform"]
    return _Read(pad_pose(placed(transform["translation"], transform["rotation"])), _stamp_ns(message))


_READ: Final[Mapping[MessageType, Callable[[Mapping[str, Any]], _Read]]] = {
    POSE_STAMPED: _of_pose,
    POSE_WITH_COVARIANCE_STAMPED: _of_uncertain_pose,
    TRANSFORM_STAMPED: _of_transform,
}
"""Reader of the pose in a decoded message, by its type."""
