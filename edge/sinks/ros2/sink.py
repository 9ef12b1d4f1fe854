"""ROS 2 messages over DDS, as a ROS node would publish them, with no ROS installed."""

import math
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

from edge.errors import SinkError
from edge.inference.contract import Contract
from edge.perception.event import Event
from edge.perception.patches import patches
from edge.perception.result import Result
from edge.pipeline.commands import Command, Commands, runtime_command
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink
from edge.sinks.json_records import event_record
from edge.sinks.ros2 import messages as ros
from edge.sinks.ros2.dds_domain import join, reader, taken, writer
from edge.sinks.ros2.diagnostics import OUTAGES, Diagnostics
from edge.sinks.ros2.map_messages import contacts, image, in_si, points, taxels
from firmware_bridge.errors import CdrError
from firmware_bridge.recording.cdr import MessageType

_COMMANDS_KEPT: Final = 16
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
    """Writers of one sensor, by what they publish, and what was published last."""

    frame: str
    last: Result
    writers: dict[str, DataWriter[Any]] = field(default_factory=dict)
    shown: dict[str, tuple[int, ...]] = field(default_factory=dict)  # shapes of maps whose last message still holds
    forced: bool = False  # the last wrench was of a pattern


class Ros2Sink(Sink):
    """Publisher of patterns, taxels, forces, numbers, diagnostics and events; with the run's commands a subscriber too.

    Commands are texts on TOPIC/zero and TOPIC/reset, as any node or `ros2 topic pub` writes them. Topics serve nodes of
    every middleware; a service's calls are understood by those of one vendor alone.
    """

    def __init__(
        self,
        topic: str,
        contract: Contract,
        source: Source,
        commands: Commands | None = None,
        *,
        environment: Mapping[str, str] = os.environ,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Join the domain of the environment; `topic` is the first part of all topics but diagnostics and frames.

        `clock_ns` is the clock of scans of now; wall time is read once, because the clock may be set during the run.
        """
        self._base, self._source, self._clock_ns = ros.base_topic(topic), source.kind, clock_ns
        self._contract = contract
        self._geometry, self._frames = source.sensor_file.geometry, source.sensor_file.frames
        offset_ns = source.unix_offset_ns
        self._of_now = offset_ns is None
        self.unix_offset_ns = time.time_ns() - clock_ns() if offset_ns is None else offset_ns
        self.unwritten = 0
        self._sensors: dict[str, _Sensor] = {}
        self._domain, self._participant = join(environment)
        self._events = writer(self._participant, f"{self._base}/events", ros.STRING, depth=100)
        self._diagnosed_ns, self._diagnostics = clock_ns(), Diagnostics(self._base)
        self._states = writer(self._participant, "diagnostics", ros.DIAGNOSTIC_ARRAY)  # the topic of ROS's own tools
        self._placed = writer(self._participant, "tf_static", ros.TF_MESSAGE, latched=True) if self._frames else None
        self._asked = None if commands is None else self._subscribed(commands)

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Publish one result: taxels and numbers, its pattern if it has one, and its wrench if that is available."""
        scan = result.scan
        sensor = self._sensors.get(scan.sensor)
        if sensor is None:
            sensor = self._sensors[scan.sensor] = _Sensor(ros.frame_of(result), result)
            self._place_pads()
        sensor.last = result
        unix_ns = scan.on_bus_ns + self.unix_offset_ns
        self._publish_to(sensor, "taxels", ros.IMAGE, lambda: image(taxels(scan), sensor.frame, unix_ns))
        if result.pattern is not None:
            self._show(sensor, result, unix_ns)
        elif result.state != "dropped":  # a newer scan has already published a pattern
            self._clear(sensor, unix_ns, 0.0 if result.contact is False else np.nan)
        force = ros.wrench(result, self._geometry, unix_ns)
        if force is not None:
            self._publish_to(sensor, "wrench", ros.WRENCH_STAMPED, lambda: force)
            sensor.forced = result.wrench is not None
        if result.state != "dropped":
            self._publish_numbers(sensor, result, result.state)
        for event in result.events:
            self._tell(event, counters)
        self._diagnostics.follow(result, counters)
        self.wait()

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Publish an event; values that an outage makes unknown are published as NaN."""
        for name, sensor in self._sensors.items():
            if event.kind in OUTAGES and event.sensor in (None, name) and name.startswith(event.sensors):
                self._clear_of_all(sensor, event.time_ns, event.kind)
        self._tell(event, counters)
        self._diagnostics.tell(event, counters)
        self.wait()

    def wait(self) -> None:
        """Publish the diagnostics once a second, also while no scan comes."""
        if self._clock_ns() - self._diagnosed_ns >= 1e9:
            self._diagnose()

    def close(self) -> None:
        """Publish that the run has ended, and leave the domain."""
        for sensor in self._sensors.values():
            self._clear_of_all(sensor, self._now_ns(), "ended")
        self._diagnose(ended=True)
        self._sensors.clear()
        if self._asked is not None:
            self._asked.clear()
        # Each is deleted with its last reference: writers before the participant, the participant before its domain.
        del self._states, self._events, self._placed, self._participant, self._domain

    def _subscribed(self, commands: Commands) -> dict[str, Any]:
        """Return the readers of commands by name; the loop reads them before each scan, for they have no thread."""
        topics = {name: f"{self._base}/{name}" for name in ("zero", "reset")}
        readers = {
            name: reader(self._participant, topic, ros.STRING, _COMMANDS_KEPT, reliable=True)
            for name, topic in topics.items()
        }

        def read() -> None:
            for name, waiting in readers.items():
                for message in taken(waiting, _COMMANDS_KEPT):
                    command = _command(name, message)
                    if command is None or commands.full:
                        commands.refuse(f"a message on the topic {name} is refused: expected a sensor's name, or none")
                    else:
                        commands.put(command)

        commands.ask(read)
        return readers

    def _publish_to(self, sensor: _Sensor, what: str, kind: MessageType, make: Callable[[], bytes]) -> None:
        """Publish what `make` returns, if anybody subscribes: that costs far more than to ask."""
        to = sensor.writers.get(what)
        if to is None:
            topic = f"{self._base}/{ros.sensor_path(sensor.last.scan.sensor)}/{what}"
            to = sensor.writers[what] = writer(self._participant, topic, kind)
        if self.is_read(to):
            self.publish(to, make())

    def is_read(self, writer: DataWriter[Any]) -> bool:
        """Return whether anybody subscribes to a topic."""
        return bool(writer.get_matched_subscriptions())

    def publish(self, writer: DataWriter[Any], message: bytes) -> None:
        """Send an encoded message to a topic."""
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
                self._publish_to(sensor, name, ros.IMAGE, partial(image, in_si(name, values), frame, unix_ns))
                sensor.shown[name] = values.shape
        if result.centroid_mm is not None:
            x, y = (place / 1e3 for place in result.centroid_mm)
            message = {"header": ros.header(frame, unix_ns), "point": {"x": x, "y": y, "z": 0.0}}
            self._publish_to(sensor, "centroid", ros.POINT_STAMPED, lambda: ros.POINT_STAMPED.encode(message))
        self._publish_to(sensor, "points", ros.POINT_CLOUD, lambda: points(result, self._geometry, frame, unix_ns))
        find_patches = partial(patches, result, self._contract)  # as long as the pattern takes: only for a subscriber
        self._publish_to(sensor, "contacts", ros.POINT_CLOUD, lambda: contacts(find_patches(), frame, unix_ns))

    def _clear(self, sensor: _Sensor, unix_ns: int, pattern_value: float) -> None:
        """Publish once, where there were maps, that they no longer hold: zeros, or NaN where nothing is known.

        A wrench becomes zero as the pattern does. Controllers refuse NaN, so an unknown one is not published.
        """
        if sensor.forced and pattern_value == 0:
            zero = (0.0, 0.0, 0.0)
            none = partial(ros.wrench_message, zero, zero, sensor.frame, unix_ns)
            self._publish_to(sensor, "wrench", ros.WRENCH_STAMPED, none)
        sensor.forced = False
        if not sensor.shown:
            return
        for name, shape in sensor.shown.items():
            values = np.full(shape, pattern_value if name == "pattern" else np.nan, dtype=np.float32)
            self._publish_to(sensor, name, ros.IMAGE, partial(image, values, sensor.frame, unix_ns))
        sensor.shown.clear()
        empty = partial(points, replace(sensor.last, pattern=None), self._geometry, sensor.frame, unix_ns)
        self._publish_to(sensor, "points", ros.POINT_CLOUD, empty)
        self._publish_to(sensor, "contacts", ros.POINT_CLOUD, partial(contacts, (), sensor.frame, unix_ns))

    def _clear_of_all(self, sensor: _Sensor, time_ns: int, why: str) -> None:
        self._clear(sensor, time_ns + self.unix_offset_ns, np.nan)
        self._publish_numbers(sensor, None, why)

    def _publish_numbers(self, sensor: _Sensor, result: Result | None, state: str) -> None:
        """Publish what is known of a result; of None, that nothing is known."""

        def publish(name: str, kind: MessageType, data: object) -> None:
            self._publish_to(sensor, name, kind, lambda: kind.encode({"data": data}))

        for name, value_of in NUMBERS.items():
            number = None if result is None else value_of(result)
            publish(name, ros.TYPES["std_msgs/Float64"], math.nan if number is None else number)
        trusted = None if result is None else result.trusted
        publish("trusted", ros.TYPES["std_msgs/Int8"], -1 if trusted is None else int(trusted))
        publish("state", ros.STRING, state)

    def _place_pads(self) -> None:
        """Publish where the pads are that have been seen so far; late subscribers get it as well."""
        places = self._frames
        frames = {sensor.frame: places[name] for name, sensor in self._sensors.items() if name in places}
        if self._placed is not None and frames:
            self.publish(self._placed, ros.transforms(frames, self._now_ns() + self.unix_offset_ns))

    def _tell(self, event: Event, counters: Mapping[str, int]) -> None:
        text = orjson.dumps(event_record(event, counters, self._source)).decode()
        self.publish(self._events, ros.STRING.encode({"data": text}))

    def _diagnose(self, *, ended: bool = False) -> None:
        self._diagnosed_ns, now_ns = self._clock_ns(), self._now_ns()
        made = self._diagnostics.message(now_ns + self.unix_offset_ns, now_ns if self._of_now else None, ended=ended)
        self.publish(self._states, made)

    def _now_ns(self) -> int:
        """Return the time on the scans' clock; where that is of another time, the time of the newest scan."""
        if self._of_now:
            return self._clock_ns()
        return max((sensor.last.scan.time_ns for sensor in self._sensors.values()), default=0)


def _command(name: str, message: bytes) -> Command | None:
    """Return the command in a message: an empty text is for all sensors, else it names the sensor to zero."""
    try:
        sensor = ros.STRING.decode(message)["data"]
    except CdrError:
        return None
    return runtime_command({"cmd": name} | ({"sensor": sensor} if sensor else {}))
