"""Scans of a recording in MCAP, and what they mean: mountings, pad, baselines, poses; without what is made of them."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from edge.errors import SinkError
from edge.perception.result import mask_bits
from edge.sinks.mcap_writer import McapFile
from edge.sinks.ros2.cdr_messages import transforms
from edge.sinks.ros2.map_messages import UNITS
from edge.sinks.ros2.ros_types import TF_MESSAGE
from edge.sinks.ros2.topic_names import sensor_path
from firmware_bridge.links.base import SourceKind
from firmware_bridge.pad_geometry import SensorGeometry
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.recording.cdr import MessageType
from firmware_bridge.recording.scan_messages import (
    POSE,
    SENSOR,
    baseline_type,
    encode_baseline,
    encode_pose,
    encode_scan,
    encode_sensor,
    mounting_text,
    scan_type,
)
from firmware_bridge.recording.tracks import GEOMETRY_METADATA, MOUNTING_METADATA, SOURCE_METADATA
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import NS_PER_S
from firmware_bridge.sensor_file.pad_frame import PadFrame
from firmware_bridge.zeroing.baseline import Baseline

POSES_TOPIC: Final = "/poses"
FRAMES_TOPIC: Final = "/tf_static"
REPEAT_NS: Final = NS_PER_S
"""Time from which on a sensor's facts and baseline are repeated, in [ns]: a part of a file has them, too."""
_PROFILE: Final = "ros2"


class McapScans:
    """Writer of scans and poses into a new file; `add` puts other messages next to them.

    Attributes:
        file: the file, on the disk as a whole up to the last second.
        offset_ns: added to a time of the scans gives [ns] since 1970.
    """

    def __init__(
        self,
        path: Path,
        geometry: SensorGeometry,
        mountings: Mapping[str, Mounting],
        *,
        unix_offset_ns: int,
        frames: Mapping[str, PadFrame] | None = None,
        facts: Mapping[str, Mapping[str, str]] | None = None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin the file.

        Args:
            path: of the file; one that exists is left alone.
            geometry: of the sensors.
            mountings: of the sensors, by name: without them, axes would point elsewhere when the file is played again.
            unix_offset_ns: 0 where the time of recording is unknown.
            frames: places of the pads on the robot, by sensor name.
            facts: further metadata, by name.
            clock_s: monotonic, in [s].

        Raises:
            SinkError: the file exists, or cannot be written.
        """
        self.offset_ns = unix_offset_ns
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._baselines: dict[str, Baseline | None] = {}
        self._frames = dict(frames or {})
        self._facts = {
            GEOMETRY_METADATA: {key: json.dumps(one) for key, one in asdict(geometry).items()},
            "units": {name: unit.name for name, unit in UNITS.items()},
        }
        self._mountings = {name: {"sensor": name, "mounting": mounting_text(one)} for name, one in mountings.items()}
        self._repeat_ns: dict[str, int] = {}
        self._scan, self._baseline = scan_type(geometry.taxel_count), baseline_type(geometry.taxel_count)
        self._source_told = False
        try:
            self.file = McapFile(path, _PROFILE, f"tactile-edge-sr {_version()}", clock_s)
            try:
                for name, fields in (facts or {}).items():
                    self.file.add_metadata(name, fields)
                self.file.add_metadata(GEOMETRY_METADATA, self._facts[GEOMETRY_METADATA])
                for fields in self._mountings.values():
                    self.file.add_metadata(MOUNTING_METADATA, fields)
            except OSError:
                self.file.abandon()
                raise
        except FileExistsError as error:
            raise SinkError(f"{path} exists: give another name, or delete it first") from error
        except OSError as error:
            raise SinkError(f"cannot record into {path}: {error.strerror or error}") from error

    @property
    def scans(self) -> int:
        """Number of scans on the disk so far, of all sensors."""
        numbers = [number for (_, name), number in self._channels.items() if name == "scan"]
        return sum(self.file.written.get(number, 0) for number in numbers)

    def add_scan(
        self, scan: Scan, kind: SourceKind, frame: str, baseline: Baseline | None, baseline_age_s: float | None
    ) -> None:
        """Add one scan; what it means, and a new baseline, come first.

        Args:
            scan: the scan.
            kind: of the source that it comes from.
            frame: frame_id of its message.
            baseline: that is subtracted from it; None without.
            baseline_age_s: None where that is unknown.

        Raises:
            OSError: an earlier record cannot be written.
        """
        sensor, unix_ns = scan.sensor, scan.time_ns + self.offset_ns
        if not self._source_told:
            self.file.add_metadata(SOURCE_METADATA, {"kind": kind})
            self._source_told = True
        repeat = unix_ns >= self._repeat_ns.get(sensor, 0)
        if repeat:
            self._repeat_ns[sensor] = unix_ns + REPEAT_NS
            facts = self._facts | {SOURCE_METADATA: {"kind": kind}}
            if sensor in self._mountings:
                facts[MOUNTING_METADATA] = self._mountings[sensor]
            self.add(sensor, "sensor", SENSOR, unix_ns, encode_sensor(sensor, frame, json.dumps(facts), unix_ns))
        if baseline is not None and (repeat or self._baselines.get(sensor) is not baseline):
            self.add(
                sensor, "baseline", self._baseline, unix_ns, encode_baseline(baseline, frame, baseline_age_s, unix_ns)
            )
            self._baselines[sensor] = baseline
        if sensor in self._frames:
            self.add("", FRAMES_TOPIC, TF_MESSAGE, unix_ns, transforms({frame: self._frames.pop(sensor)}, unix_ns))
        masks = mask_bits(scan.fresh), mask_bits(scan.renewed)
        self.add(sensor, "scan", self._scan, unix_ns, encode_scan(scan, frame, scan.on_bus_ns + self.offset_ns, *masks))

    def add_poses(self, poses: Sequence[TimedPose]) -> None:
        """Add poses.

        Raises:
            OSError: an earlier record cannot be written.
        """
        for one in poses:
            unix_ns = one.time_ns + self.offset_ns
            self.add("", POSES_TOPIC, POSE, unix_ns, encode_pose(one, unix_ns))

    def add(self, sensor: str, name: str, kind: MessageType, unix_ns: int, data: bytes) -> None:
        """Add a message to a topic of a sensor, or to the topic `name` itself where `sensor` is empty.

        Raises:
            OSError: an earlier record cannot be written.
        """
        channel = self._channels.get((sensor, name))
        if channel is None:
            if kind.name not in self._schemas:
                self._schemas[kind.name] = self.file.add_schema(kind.name, "ros2msg", kind.definition)
            topic = f"/{sensor_path(sensor)}/{name}" if sensor else name
            about = {"sensor": sensor} | ({"unit": UNITS[name].name} if name in UNITS else {})
            channel = self.file.add_channel(topic, "cdr", self._schemas[kind.name], about)
            self._channels[sensor, name] = channel
        self.file.add_message(channel, unix_ns, data)


def _version() -> str:
    try:
        return version("tactile-edge-sr")
    except PackageNotFoundError:  # run from a checkout
        return "0"
