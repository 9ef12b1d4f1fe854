"""Scans, patterns and events in one MCAP file, which Foxglove and `ros2 bag play` open and `replay:` plays again."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from edge.errors import SinkError
from edge.inference.contract import Contract
from edge.perception.event import Event
from edge.perception.result import Result
from edge.perception.result_fields import maps_of
from edge.pipeline.sink import Sink
from edge.sinks.json_encoding import CountersInTurn, record
from edge.sinks.mcap_scans import McapScans
from edge.sinks.ros2.cdr_messages import (
    RESULT,
    frame_of,
    log_message,
    result_message,
    wrench,
)
from edge.sinks.ros2.map_messages import image, in_si
from edge.sinks.ros2.ros_types import IMAGE, LOG, WRENCH_STAMPED
from edge.terminal.forced_end import finishing
from firmware_bridge.links.base import SourceKind
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.sensor_file.pad_frame import PadFrame

EVENTS_TOPIC: Final = "/events"


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
        """Begin the file; what is not explained here is as in McapScans.

        Args:
            path: of the file; one that exists is left alone.
            contract: of the model that the run begins with.
            lossless: wait for a slow disk, rather than leave records out.
            mountings: of the sensors, by name.
            frames: places of the pads on the robot, by sensor name.
            geometry: of the sensors.
            unix_offset_ns: added to the time of a scan gives [ns] since 1970; by default as the clocks are now.
            origin: kind of source that the scans come from, where results are of a recording; else that of the results.
            clock_s: monotonic, in [s].

        Raises:
            SinkError: the file exists, or cannot be written.
        """
        self._path = path
        self._geometry = geometry
        self._origin: SourceKind | None = origin
        self._lossless = lossless
        self._turns = CountersInTurn()
        self.unwritten = 0
        self._failed = False
        self._to = McapScans(
            path,
            geometry,
            mountings or {},
            unix_offset_ns=time.time_ns() - time.monotonic_ns() if unix_offset_ns is None else unix_offset_ns,
            frames=frames,
            facts={"contract": {key: json.dumps(one) for key, one in asdict(contract).items()}},
            clock_s=clock_s,
        )
        self._file = self._to.file

    @property
    def scans(self) -> int:
        """Number of scans on the disk so far, of all sensors."""
        return self._to.scans

    @property
    def size_bytes(self) -> int:
        """Size on the disk so far, in bytes."""
        return self._file.size_bytes

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Add the messages of one scan."""
        if not self._has_room():
            return
        scan, to = result.scan, self._to
        sensor, unix_ns, frame = scan.sensor, scan.time_ns + to.offset_ns, frame_of(result)
        on_bus_unix_ns = scan.on_bus_ns + to.offset_ns
        fields = record(result, self._turns.of(result, counters))
        try:
            to.add_scan(scan, self._origin or result.source, frame, result.baseline, result.baseline_age_s)
            to.add(sensor, "result", RESULT, unix_ns, result_message(result, fields, on_bus_unix_ns))
            for name, values in maps_of(result).items():
                to.add(sensor, name, IMAGE, unix_ns, image(in_si(name, values), frame, on_bus_unix_ns))
            force = wrench(result, self._geometry, on_bus_unix_ns)
            if force is not None:
                to.add(sensor, "wrench", WRENCH_STAMPED, unix_ns, force)
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
            self._to.add_poses(poses)
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
        unix_ns = event.time_ns + self._to.offset_ns
        self._to.add("", EVENTS_TOPIC, LOG, unix_ns, log_message(event, unix_ns))

    def _failure(self, error: OSError) -> SinkError:
        self._failed = True
        reason = error.strerror or error
        return SinkError(f"recording into {self._path} stopped: {reason}; its {self.scans} scans can be played")
