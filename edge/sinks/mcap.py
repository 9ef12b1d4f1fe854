"""Scans, patterns and events in one MCAP file, which Foxglove and `ros2 bag play` open and `replay:` plays again."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from edge.errors import SinkError
from edge.inference.contract import Contract
from edge.perception.event import Event
from edge.perception.result import Result
from edge.perception.result_fields import maps_of
from edge.pipeline.sink import Sink
from edge.sinks.json_encoding import record
from edge.sinks.mcap_writer import McapFile
from edge.sinks.ros2.cdr_messages import (
    RESULT,
    frame_of,
    log_message,
    result_message,
    transforms,
    wrench,
)
from edge.sinks.ros2.map_messages import UNITS, image, in_si
from edge.sinks.ros2.ros_types import IMAGE, LOG, TF_MESSAGE, WRENCH_STAMPED
from edge.sinks.ros2.topic_names import sensor_path
from edge.terminal.forced_end import finishing
from firmware_bridge.links.base import SourceKind
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.recording.cdr import MessageType
from firmware_bridge.recording.mounting_text import mounting_text
from firmware_bridge.recording.pose_messages import POSE, encode_pose
from firmware_bridge.recording.scan_messages import (
    SENSOR,
    baseline_type,
    encode_baseline,
    encode_scan,
    encode_sensor,
    scan_type,
)
from firmware_bridge.recording.tracks import GEOMETRY_METADATA, MOUNTING_METADATA, SOURCE_METADATA
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.schedule import NS_PER_S
from firmware_bridge.sensor_file.pad_frame import PadFrame
from firmware_bridge.zeroing.baseline import Baseline

EVENTS_TOPIC: Final = "/events"
POSES_TOPIC: Final = "/poses"
FRAMES_TOPIC: Final = "/tf_static"
REPEAT_NS: Final = NS_PER_S
"""Time from which on a sensor's facts and baseline are repeated, in [ns]: a part of a file has them, too."""
_PROFILE: Final = "ros2"


class McapSink(Sink):
    """Writer of records into a new file; their wall times follow the clock at the start, however it is set later.

    In a robot's run a slow disk must delay nothing: after some seconds records are left out, and counted.
    """

    def __init__(
        self,
        path: Path,
        contract: Contract,
        *,
        lossless: bool = True,
        mountings: Mapping[str, Mounting] | None = None,
        frames: Mapping[str, PadFrame] | None = None,
        geometry: SensorGeometry = USPA44,
        unix_offset_ns: int | None = None,
        origin: SourceKind | None = None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin the file.

        Args:
            path: of the file; one that exists is left alone.
            contract: of the model that the run begins with.
            lossless: wait for a slow disk, rather than leave records out.
            mountings: of the sensors, by name: without them, axes would point elsewhere when the file is played again.
            frames: places of the pads on the robot, by sensor name.
            geometry: of the sensors.
            unix_offset_ns: added to the time of a scan gives [ns] since 1970; by default as the clocks are now.
            origin: kind of source that the scans come from, where results are of a recording; else that of the results.
            clock_s: monotonic, in [s].

        Raises:
            SinkError: the file exists, or cannot be written.
        """
        self._path = path
        self._offset_ns = time.time_ns() - time.monotonic_ns() if unix_offset_ns is None else unix_offset_ns
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._baselines: dict[str, Baseline | None] = {}
        self._geometry, self._frames = geometry, dict(frames or {})
        self._facts = {
            GEOMETRY_METADATA: {key: json.dumps(one) for key, one in asdict(geometry).items()},
            "units": {name: unit.name for name, unit in UNITS.items()},
        }
        self._mountings = {
            name: {"sensor": name, "mounting": mounting_text(one)} for name, one in (mountings or {}).items()
        }
        self._repeat_ns: dict[str, int] = {}
        self._scan, self._baseline = scan_type(geometry.taxel_count), baseline_type(geometry.taxel_count)
        self._origin = origin
        self._source_told = False
        self._lossless = lossless
        self.unwritten = 0
        self._failed = False
        try:
            self._file = McapFile(path, _PROFILE, f"tactile-edge-sr {_version()}", clock_s)
            try:
                self._file.add_metadata("contract", {key: json.dumps(one) for key, one in asdict(contract).items()})
                self._file.add_metadata(GEOMETRY_METADATA, self._facts[GEOMETRY_METADATA])
                for fields in self._mountings.values():
                    self._file.add_metadata(MOUNTING_METADATA, fields)
            except OSError:
                self._file.abandon()
                raise
        except FileExistsError as error:
            raise SinkError(f"{path} exists: give another name, or delete it first") from error
        except OSError as error:
            raise SinkError(f"cannot record into {path}: {error.strerror or error}") from error

    @property
    def scans(self) -> int:
        """Number of scans on the disk so far, of all sensors."""
        numbers = [number for (_, name), number in self._channels.items() if name == "scan"]
        return sum(self._file.written.get(number, 0) for number in numbers)

    @property
    def size_bytes(self) -> int:
        """Size on the disk so far, in bytes."""
        return self._file.size_bytes

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Add the messages of one scan; what it means, and a new baseline, come first."""
        if not self._has_room():
            return
        scan = result.scan
        sensor, unix_ns, frame = scan.sensor, scan.time_ns + self._offset_ns, frame_of(result)
        on_bus_unix_ns = scan.on_bus_ns + self._offset_ns
        fields = record(result, counters)
        try:
            kind = {"kind": self._origin or result.source}
            if not self._source_told:
                self._file.add_metadata(SOURCE_METADATA, kind)
                self._source_told = True
            repeat = unix_ns >= self._repeat_ns.get(sensor, 0)
            if repeat:
                self._repeat_ns[sensor] = unix_ns + REPEAT_NS
                facts = self._facts | {SOURCE_METADATA: kind}
                if sensor in self._mountings:
                    facts[MOUNTING_METADATA] = self._mountings[sensor]
                self._add(sensor, "sensor", SENSOR, unix_ns, encode_sensor(sensor, frame, json.dumps(facts), unix_ns))
            if result.baseline is not None and (repeat or self._baselines.get(sensor) is not result.baseline):
                data = encode_baseline(result.baseline, frame, result.baseline_age_s, unix_ns)
                self._add(sensor, "baseline", self._baseline, unix_ns, data)
                self._baselines[sensor] = result.baseline
            if sensor in self._frames:
                self._add("", FRAMES_TOPIC, TF_MESSAGE, unix_ns, transforms({frame: self._frames.pop(sensor)}, unix_ns))
            data = encode_scan(scan, frame, on_bus_unix_ns, fields["fresh"], fields["renewed"])
            self._add(sensor, "scan", self._scan, unix_ns, data)
            self._add(sensor, "result", RESULT, unix_ns, result_message(result, fields, on_bus_unix_ns))
            for name, values in maps_of(result).items():
                self._add(sensor, name, IMAGE, unix_ns, image(in_si(name, values), frame, on_bus_unix_ns))
            force = wrench(result, self._geometry, on_bus_unix_ns)
            if force is not None:
                self._add(sensor, "wrench", WRENCH_STAMPED, unix_ns, force)
            for event in result.events:
                self._log(event)
            self._file.look()  # after the last message, so that a due chunk does not end in mid-scan
        except OSError as error:
            raise self._failure(error) from error

    def pose(self, poses: Sequence[TimedPose]) -> None:
        """Add poses."""
        if not self._has_room():
            return
        try:
            for one in poses:
                unix_ns = one.time_ns + self._offset_ns
                self._add("", POSES_TOPIC, POSE, unix_ns, encode_pose(one, unix_ns))
        except OSError as error:
            raise self._failure(error) from error

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Add an event."""
        if not self._has_room():
            return
        try:
            self._log(event)
            self._file.look()
        except OSError as error:
            raise self._failure(error) from error

    def wait(self) -> None:
        """Pass on the open chunk when it is due, while no scan comes."""
        try:
            self._file.look()
        except OSError as error:
            raise self._failure(error) from error

    def close(self) -> None:
        """Finish the file; one without a message is deleted."""
        with finishing(self._path):
            if self._failed:
                self._file.abandon()
                return
            try:
                self._file.close()
            except OSError as error:
                raise self._failure(error) from error
        if not self._file.messages:
            self._path.unlink(missing_ok=True)

    def _has_room(self) -> bool:
        """Return True if there is room for one more record; else count it as left out."""
        try:
            full = self._file.full()
            if full and self._lossless:
                self._file.drain()
                return True
        except OSError as error:
            raise self._failure(error) from error
        self.unwritten += full
        return not full

    def _log(self, event: Event) -> None:
        unix_ns = event.time_ns + self._offset_ns
        self._add("", EVENTS_TOPIC, LOG, unix_ns, log_message(event, unix_ns))

    def _add(self, sensor: str, name: str, kind: MessageType, unix_ns: int, data: bytes) -> None:
        channel = self._channels.get((sensor, name))
        if channel is None:
            if kind.name not in self._schemas:
                self._schemas[kind.name] = self._file.add_schema(kind.name, "ros2msg", kind.definition)
            topic = f"/{sensor_path(sensor)}/{name}" if sensor else name
            about = {"sensor": sensor} | ({"unit": UNITS[name].name} if name in UNITS else {})
            channel = self._file.add_channel(topic, "cdr", self._schemas[kind.name], about)
            self._channels[sensor, name] = channel
        self._file.add_message(channel, unix_ns, data)

    def _failure(self, error: OSError) -> SinkError:
        self._failed = True
        reason = error.strerror or error
        return SinkError(f"recording into {self._path} stopped: {reason}; its {self.scans} scans can be played")


def _version() -> str:
    try:
        return version("tactile-edge-sr")
    except PackageNotFoundError:  # run from a checkout
        return "0"
