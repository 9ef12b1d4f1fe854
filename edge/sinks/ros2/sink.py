"""ROS 2 messages over DDS, as a ROS node would publish them, with no ROS installed."""

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
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
from edge.pipeline.commands import Commands
from edge.pipeline.sink import Sink
from edge.sinks.json_encoding import event_record
from edge.sinks.ros2 import cdr_messages as messages
from edge.sinks.ros2.cdr_messages import diagnostics_message, frame_of
from edge.sinks.ros2.command_topics import CommandTopics
from edge.sinks.ros2.dds_domain import join
from edge.sinks.ros2.dds_types import TYPE_HASHES, dds_type
from edge.sinks.ros2.diagnostics import Diagnosis, Level, diagnose
from edge.sinks.ros2.map_messages import image, in_si, points, taxels
from edge.sinks.ros2.ros_types import (
    DIAGNOSTIC_ARRAY,
    FLOAT64,
    IMAGE,
    INT8,
    POINT_CLOUD,
    POINT_STAMPED,
    STRING,
    TF_MESSAGE,
    WRENCH_STAMPED,
)
from edge.sinks.ros2.topic_names import base_topic, sensor_topic
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.recording.cdr import MessageType
from firmware_bridge.sensor_file.pad_frame import PadFrame

DIAGNOSTICS_S: Final = 1.0
_DIAGNOSTICS_TOPIC: Final = "diagnostics"
"""Topic that ROS's tools subscribe to, independent of a robot's name."""
_FRAMES_TOPIC: Final = "tf_static"
_EVENTS_KEPT: Final = 100
_OUTAGES: Final = ("lost", "silent")
_Writer = DataWriter[Any]
NUMBERS: Final[Mapping[str, Callable[[Result], float | None]]] = {
    "force_counts": lambda result: result.force_counts,
    "force_z_n": lambda result: result.force_n if result.wrench is None else result.wrench.force_n[2],
    "area_m2": lambda result: None if result.area_mm2 is None else result.area_mm2 / 1e6,
    "uncertainty_m": lambda result: None if result.interval_mm is None else result.interval_mm / 1e3,
    "shear_ratio": lambda result: None if result.wrench is None else result.wrench.shear_ratio,
}
"""Numbers that have a topic of their own, NaN where they are not available."""


@dataclass(slots=True)
class _Sensor:
    """Writers of one sensor, and what they published last.

    Attributes:
        shown: maps whose last message still holds, by topic, with their shapes.
        forced: the last wrench was of a pattern.
        trouble: what the link has reported and not withdrawn, by the kind of event.
    """

    frame: str
    last: Result
    writers: dict[str, _Writer] = field(default_factory=dict)
    shown: dict[str, tuple[int, ...]] = field(default_factory=dict)
    forced: bool = False
    trouble: dict[str, str] = field(default_factory=dict)


class Ros2Sink(Sink):
    """Publisher of patterns, taxels, forces, numbers, diagnostics and events.

    Writers are reliable, because the subscriptions that ROS makes by default accept nothing less, but they never wait:
    each topic keeps only its newest message for a slow reader.
    """

    def __init__(
        self,
        topic: str,
        environment: Mapping[str, str] = os.environ,
        *,
        geometry: SensorGeometry = USPA44,
        frames: Mapping[str, PadFrame] | None = None,
        commands: Commands | None = None,
        unix_offset_ns: int | None = None,
        source: str | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        unix_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """Join the domain.

        Args:
            topic: first part of all topics except those of the diagnostics and the frames.
            environment: ROS_DOMAIN_ID and others are read from it.
            geometry: of the sensors.
            frames: places of the pads on the robot, by sensor name.
            commands: takes what others ask for on TOPIC/zero and TOPIC/reset; None for no such topics.
            unix_offset_ns: added to the time of a scan gives [ns] since 1970; None where scans are of now.
            source: kind of the source, published with every event.
            clock_ns: the clock of the scans that are of now, in [ns].
            unix_ns: wall time, in [ns]; read once, because the clock may be set during the run.

        Raises:
            UsageError: the topic, or the environment, is not valid in ROS.
            SinkError: the domain cannot be joined.
        """
        self._base = base_topic(topic)
        self._geometry, self._frames = geometry, frames or {}
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
        self._placed = self._writer(_FRAMES_TOPIC, TF_MESSAGE, latched=True) if self._frames else None
        self._asked = None if commands is None else CommandTopics(self._participant, self._base, commands)

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Publish one result: taxels and numbers, its pattern if it has one, and its wrench if that is available.

        Raises:
            SinkError: the result cannot be published.
        """
        scan = result.scan
        sensor = self._sensors.get(scan.sensor)
        if sensor is None:
            sensor = self._sensors[scan.sensor] = _Sensor(frame_of(result), result)
            self._place_pads()
        sensor.last, self._counters = result, counters
        for kind in _OUTAGES:
            sensor.trouble.pop(kind, None)
        unix_ns = scan.on_bus_ns + self._unix_offset_ns
        self._publish_to(sensor, "taxels", IMAGE, lambda: image(taxels(scan), sensor.frame, unix_ns))
        if result.pattern is not None:
            self._show(sensor, result, unix_ns)
        elif result.state != "dropped":  # a newer scan has already published a pattern
            self._withdraw(sensor, unix_ns, 0.0 if result.contact is False else np.nan)
        wrench = messages.wrench(result, self._geometry, unix_ns)
        if wrench is not None:
            self._publish_to(sensor, "wrench", WRENCH_STAMPED, lambda: wrench)
            sensor.forced = result.wrench is not None
        if result.state != "dropped":
            self._publish_numbers(sensor, result, result.state)
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
                self._withdraw_all(sensor, event.time_ns, event.kind)
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
            self._withdraw_all(sensor, self._now_ns(), "ended")
        self._diagnose(ended=True)
        self._sensors.clear()
        if self._asked is not None:
            self._asked.close()
        # Each is deleted with its last reference: writers before the participant, the participant before its domain.
        del self._diagnostics, self._events, self._placed, self._participant, self._domain

    def _writer(self, topic: str, kind: MessageType, depth: int = 1, *, latched: bool = False) -> _Writer:
        qos = Qos(
            Policy.Reliability.Reliable(max_blocking_time=0),
            Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(depth),
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.Userdata(f"typehash=RIHS01_{TYPE_HASHES[kind.name]};".encode()),
        )
        try:
            return DataWriter(self._participant, Topic(self._participant, f"rt/{topic}", dds_type(kind)), qos)
        except DDSException as error:
            raise SinkError(f"cannot publish on /{topic}: {error}") from error

    def _writer_of(self, sensor: _Sensor, what: str, kind: MessageType) -> _Writer:
        writer = sensor.writers.get(what)
        if writer is None:
            writer = self._writer(sensor_topic(self._base, sensor.last.scan.sensor, what), kind)
            sensor.writers[what] = writer
        return writer

    def _publish_to(self, sensor: _Sensor, what: str, kind: MessageType, make: Callable[[], bytes]) -> None:
        """Publish what `make` returns, if anybody subscribes: that costs far more than to ask."""
        writer = self._writer_of(sensor, what, kind)
        if self._is_read(writer):
            self._publish(writer, make())

    def _is_read(self, writer: _Writer) -> bool:
        return bool(writer.get_matched_subscriptions())

    def _publish(self, writer: _Writer, message: bytes) -> None:
        try:
            writer.write(writer.data_type(message))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise SinkError(f"cannot publish on {writer.topic.name.removeprefix('rt')}: {error}") from error
            self.unwritten += 1

    def _show(self, sensor: _Sensor, result: Result, unix_ns: int) -> None:
        frame = sensor.frame
        for name, values in (("pattern", result.pattern), ("deviation", result.deviation)):
            if values is not None:
                self._publish_to(sensor, name, IMAGE, partial(_map_message, name, values, frame, unix_ns))
                sensor.shown[name] = values.shape
        centroid_mm = result.centroid_mm
        if centroid_mm is not None:
            self._publish_to(sensor, "centroid", POINT_STAMPED, lambda: messages.point(centroid_mm, frame, unix_ns))
        self._publish_to(sensor, "points", POINT_CLOUD, lambda: points(result, self._geometry, frame, unix_ns))

    def _withdraw(self, sensor: _Sensor, unix_ns: int, pattern_value: float) -> None:
        """Publish once, where there were maps, that they no longer hold: zeros, or NaN where nothing is known.

        A wrench becomes zero as the pattern does. Controllers refuse NaN, so an unknown one is not published.
        """
        if sensor.forced and pattern_value == 0:
            zero = (0.0, 0.0, 0.0)
            message = partial(messages.wrench_message, zero, zero, sensor.frame, unix_ns)
            self._publish_to(sensor, "wrench", WRENCH_STAMPED, message)
        sensor.forced = False
        if not sensor.shown:
            return
        for name, shape in sensor.shown.items():
            values = np.full(shape, pattern_value if name == "pattern" else np.nan, dtype=np.float32)
            self._publish_to(sensor, name, IMAGE, partial(image, values, sensor.frame, unix_ns))
        sensor.shown.clear()
        empty = partial(points, replace(sensor.last, pattern=None), self._geometry, sensor.frame, unix_ns)
        self._publish_to(sensor, "points", POINT_CLOUD, empty)

    def _withdraw_all(self, sensor: _Sensor, time_ns: int, why: str) -> None:
        self._withdraw(sensor, time_ns + self._unix_offset_ns, np.nan)
        self._publish_numbers(sensor, None, why)

    def _publish_numbers(self, sensor: _Sensor, result: Result | None, state: str) -> None:
        """Publish what is known of a result; of None, that nothing is known."""
        for name, value_of in NUMBERS.items():
            number = None if result is None else value_of(result)
            self._publish_to(sensor, name, FLOAT64, partial(messages.number, number))
        trusted = None if result is None else result.trusted
        self._publish_to(sensor, "trusted", INT8, lambda: messages.yes_or_no(trusted))
        self._publish_to(sensor, "state", STRING, lambda: messages.text(state))

    def _place_pads(self) -> None:
        """Publish where the pads are that have been seen so far; late subscribers get it as well."""
        frames = {sensor.frame: self._frames[name] for name, sensor in self._sensors.items() if name in self._frames}
        if self._placed is not None and frames:
            self._publish(self._placed, messages.transforms(frames, self._now_ns() + self._unix_offset_ns))

    def _tell(self, event: Event) -> None:
        text = orjson.dumps(event_record(event, self._counters, self._source)).decode()
        self._publish(self._events, messages.text(text))

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


def _map_message(name: str, values: NDArray[np.float32], frame: str, unix_ns: int) -> bytes:
    return image(in_si(name, values), frame, unix_ns)
