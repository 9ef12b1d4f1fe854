"""ROS 2 messages over DDS, as a ROS node would publish them, with no ROS installed."""

import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import orjson
from cyclonedds.core import DDSException
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic
from numpy.typing import NDArray

from edge.errors import SinkError
from edge.perception.event import Event
from edge.perception.result import Result
from edge.pipeline.sink import Sink
from edge.sinks.json_encoding import event_record
from edge.sinks.ros2.cdr_messages import (
    DIAGNOSTIC_ARRAY,
    IMAGE,
    STRING,
    WRENCH_STAMPED,
    Vector,
    diagnostics_message,
    force_and_torque,
    frame_of,
    image,
    wrench_message,
)
from edge.sinks.ros2.dds_domain import join
from edge.sinks.ros2.dds_types import TYPE_HASHES, dds_type
from edge.sinks.ros2.diagnostics import Diagnosis, Level, diagnose
from edge.sinks.ros2.topic_names import base_topic, sensor_topic
from firmware_bridge.recording.cdr import MessageType

DIAGNOSTICS_S: Final = 1.0
_DIAGNOSTICS_TOPIC: Final = "diagnostics"
"""Topic that ROS's tools subscribe to, independent of a robot's name."""
_EVENTS_KEPT: Final = 100
_UNKNOWN: Final = math.nan
_VECTOR_UNKNOWN: Final = (_UNKNOWN, _UNKNOWN, _UNKNOWN)
_OUTAGES: Final = ("lost", "silent")
_Writer = DataWriter[Any]


@dataclass(slots=True)
class _Sensor:
    """Writers of one sensor, and what they published last.

    Attributes:
        shown: writers whose last message was a map that still holds, and its shape.
        force_shown: the last wrench was a force that still holds.
        trouble: what the link has reported and not withdrawn, by the kind of event.
    """

    pattern: _Writer
    deviation: _Writer
    frame: str
    last: Result
    shown: dict[_Writer, tuple[int, ...]] = field(default_factory=dict)
    wrench: _Writer | None = None
    force_shown: bool = False
    trouble: dict[str, str] = field(default_factory=dict)


class Ros2Sink(Sink):
    """Publisher of patterns, forces, diagnostics and events.

    Writers are reliable, because the subscriptions that ROS makes by default accept nothing less, but they never wait:
    each topic keeps only its newest message for a slow reader.
    """

    def __init__(
        self,
        topic: str,
        environment: Mapping[str, str] = os.environ,
        *,
        unix_offset_ns: int | None = None,
        source: str | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        unix_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """Join the domain.

        Args:
            topic: first part of all topics except that of the diagnostics.
            environment: ROS_DOMAIN_ID and others are read from it.
            unix_offset_ns: added to the time of a scan gives [ns] since 1970; None where scans are of now.
            source: kind of the source, published with every event.
            clock_ns: the clock of the scans that are of now, in [ns].
            unix_ns: wall time, in [ns]; read once, because the clock may be set during the run.

        Raises:
            UsageError: the topic, or the environment, is not valid in ROS.
            SinkError: the domain cannot be joined.
        """
        self._base = base_topic(topic)
        self._clock_ns = clock_ns
        self._source = source
        self._of_now = unix_offset_ns is None
        self._unix_offset_ns = unix_ns() - clock_ns() if unix_offset_ns is None else unix_offset_ns
        self.unwritten = 0
        self._sensors: dict[str, _Sensor] = {}
        self._counters: Mapping[str, int] = {}
        self._counters_before: Mapping[str, int] = {}
        self._diagnosed_ns = clock_ns()
        self._domain, self._participant = join(environment)
        self._diagnostics = self._writer(_DIAGNOSTICS_TOPIC, DIAGNOSTIC_ARRAY)
        self._events = self._writer(f"{self._base}/events", STRING, _EVENTS_KEPT)

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Publish one result: its pattern if it has one, and its force if that is available in newtons.

        Raises:
            SinkError: the result cannot be published.
        """
        sensor = self._sensors.get(result.scan.sensor)
        if sensor is None:
            sensor = self._sensors[result.scan.sensor] = self._begin(result)
        sensor.last, self._counters = result, counters
        for kind in _OUTAGES:
            sensor.trouble.pop(kind, None)
        time_ns = result.scan.time_ns
        if result.pattern is not None:
            self._show(sensor, sensor.pattern, time_ns, result.pattern)
            if result.deviation is not None:
                self._show(sensor, sensor.deviation, time_ns, result.deviation)
        elif result.state != "dropped":  # a newer scan has already published a pattern
            self._withdraw(sensor, time_ns, 0.0 if result.contact is False else _UNKNOWN)
        force = force_and_torque(result)
        if force is not None:
            self._publish_wrench(sensor, time_ns, *force)
        elif result.state != "dropped":
            self._withdraw_force(sensor, time_ns)
        for event in result.events:
            self._tell(event)
        self._diagnose_if_due()

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Publish an event; values that an outage makes unknown are published as NaN."""
        self._counters = counters
        for name, sensor in self._sensors.items():
            if event.sensor not in (None, name) or not name.startswith(event.sensors):
                continue
            if event.kind in _OUTAGES:
                self._withdraw_all(sensor, event.time_ns)
            if event.kind in (*_OUTAGES, "trouble"):
                sensor.trouble[event.kind] = event.text
            elif event.kind == "well":
                sensor.trouble.pop("trouble", None)
        self._tell(event)
        self._diagnose_if_due()

    def wait(self) -> None:
        """Publish the diagnostics while no scan comes."""
        self._diagnose_if_due()

    def close(self) -> None:
        """Publish that the run has ended, and leave the domain."""
        for sensor in self._sensors.values():
            self._withdraw_all(sensor, self._now_ns())
        self._diagnose(ended=True)
        self._sensors.clear()
        # Each is deleted with its last reference: writers before the participant, the participant before its domain.
        del self._diagnostics, self._events, self._participant, self._domain

    def _begin(self, result: Result) -> _Sensor:
        name = result.scan.sensor
        return _Sensor(
            pattern=self._writer(sensor_topic(self._base, name, "pattern"), IMAGE),
            deviation=self._writer(sensor_topic(self._base, name, "deviation"), IMAGE),
            frame=frame_of(result),
            last=result,
        )

    def _writer(self, topic: str, kind: MessageType, depth: int = 1) -> _Writer:
        qos = Qos(
            Policy.Reliability.Reliable(max_blocking_time=0),
            Policy.Durability.Volatile,
            Policy.History.KeepLast(depth),
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.Userdata(f"typehash=RIHS01_{TYPE_HASHES[kind.name]};".encode()),
        )
        try:
            return DataWriter(self._participant, Topic(self._participant, f"rt/{topic}", dds_type(kind)), qos)
        except DDSException as error:
            raise SinkError(f"cannot publish on /{topic}: {error}") from error

    def _publish(self, writer: _Writer, message: bytes) -> None:
        try:
            writer.write(writer.data_type(message))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise SinkError(f"cannot publish on {writer.topic.name.removeprefix('rt')}: {error}") from error
            self.unwritten += 1

    def _show(self, sensor: _Sensor, writer: _Writer, time_ns: int, values: NDArray[np.float32]) -> None:
        self._publish(writer, image(values, sensor.frame, time_ns + self._unix_offset_ns))
        sensor.shown[writer] = values.shape

    def _withdraw(self, sensor: _Sensor, time_ns: int, pattern_value: float) -> None:
        """Publish once, where there were maps, that they no longer hold."""
        for writer, shape in sensor.shown.items():
            value = pattern_value if writer is sensor.pattern else _UNKNOWN
            values = np.full(shape, value, dtype=np.float32)
            self._publish(writer, image(values, sensor.frame, time_ns + self._unix_offset_ns))
        sensor.shown.clear()

    def _withdraw_force(self, sensor: _Sensor, time_ns: int) -> None:
        """Publish once, where there was a force, that it no longer holds."""
        if sensor.force_shown:
            self._publish_wrench(sensor, time_ns, _VECTOR_UNKNOWN, _VECTOR_UNKNOWN)
            sensor.force_shown = False

    def _withdraw_all(self, sensor: _Sensor, time_ns: int) -> None:
        self._withdraw(sensor, time_ns, _UNKNOWN)
        self._withdraw_force(sensor, time_ns)

    def _publish_wrench(self, sensor: _Sensor, time_ns: int, force_n: Vector, torque_n_m: Vector) -> None:
        if sensor.wrench is None:
            topic = sensor_topic(self._base, sensor.last.scan.sensor, "wrench")
            sensor.wrench = self._writer(topic, WRENCH_STAMPED)
        unix_ns = time_ns + self._unix_offset_ns
        self._publish(sensor.wrench, wrench_message(force_n, torque_n_m, sensor.frame, unix_ns))
        sensor.force_shown = True

    def _tell(self, event: Event) -> None:
        text = orjson.dumps(event_record(event, self._counters, self._source)).decode()
        self._publish(self._events, STRING.encode({"data": text}))

    def _diagnose_if_due(self) -> None:
        if self._clock_ns() - self._diagnosed_ns >= DIAGNOSTICS_S * 1e9:
            self._diagnose()

    def _diagnose(self, *, ended: bool = False) -> None:
        self._diagnosed_ns, now_ns = self._clock_ns(), self._now_ns()
        statuses = []
        for name, sensor in self._sensors.items():
            trouble = "; ".join(sensor.trouble.values()) or None
            silence_s = (now_ns - sensor.last.scan.time_ns) / 1e9 if self._of_now else None
            diagnosis = diagnose(sensor.last, self._counters, self._counters_before, silence_s, trouble)
            diagnosis = Diagnosis(Level.STALE, "ended", diagnosis.values) if ended else diagnosis
            statuses.append((f"{self._base}: {name}", name, diagnosis))
        self._counters_before = self._counters
        self._publish(self._diagnostics, diagnostics_message(statuses, now_ns + self._unix_offset_ns))

    def _now_ns(self) -> int:
        """Return the time on the scans' clock; where that is of another time, the time of the newest scan."""
        if self._of_now:
            return self._clock_ns()
        return max((sensor.last.scan.time_ns for sensor in self._sensors.values()), default=0)
