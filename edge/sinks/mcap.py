"""Scans, patterns and events in one MCAP file, which Foxglove and `ros2 bag play` open and `replay:` plays again.

The public writer makes the records. What it makes is put on the disk in a thread of its own, a whole chunk or nothing:
no caller waits, a full disk leaves a file that can be played, and a killed process one that lacks the last second.
"""

import json
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Final

from mcap.writer import Writer

from edge import __version__
from edge.errors import SinkError
from edge.inference.contract import Contract
from edge.perception.event import Event
from edge.perception.record_fields import maps_of
from edge.perception.result import Result, mask_bits
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink
from edge.sinks.json_records import CountersInTurn, record
from edge.sinks.ros2 import messages as ros
from edge.sinks.ros2.map_messages import UNITS, grid
from firmware_bridge.links.base import SourceKind
from firmware_bridge.poses import TimedPose
from firmware_bridge.recording.cdr import MessageType, stamp
from firmware_bridge.recording.scan_messages import (
    POSE,
    SENSOR,
    baseline_type,
    encode_baseline,
    encode_pose,
    encode_scan,
    scan_type,
)
from firmware_bridge.recording.tracks import mounting_text
from firmware_bridge.schedule import NS_PER_S
from firmware_bridge.zeroing.baseline import Baseline

CHUNK_S: Final = 1.0
"""Longest stretch that a crash costs, in [s]; the index of chunks, 3 MB an hour and sensor, stays in memory."""
MOST_CHUNK_BYTES: Final = 1 << 22
MOST_WAITING_BYTES: Final = 1 << 24
"""Most bytes that wait, before compression: five seconds of two sensors' patterns while the disk is busy elsewhere."""


class _Disk:
    """New file that the public writer fills in a thread of its own: a whole chunk reaches the disk, or nothing of it.

    Every method but `abandon` raises an OSError where it, or an earlier record, cannot be written.
    """

    def __init__(self, path: Path, contract: dict[str, str]) -> None:
        self.scans = self.added_scans = 0  # on the disk so far, and all of them
        self._path = path
        self._messages = self._open_bytes = self._waiting_bytes = self._size_bytes = 0
        self._due_s: float | None = None
        self._made = bytearray()
        self._failed = False
        self._handed_over: deque[tuple[Future[None], int]] = deque()
        self._file = path.open("xb", buffering=0)
        self.writer = Writer(self, chunk_size=2 * MOST_CHUNK_BYTES)  # type: ignore[arg-type]  # write, tell, flush
        start = partial(self.writer.start, "ros2", f"tactile-edge-sr {__version__}")
        self._jobs: list[Callable[[], object]] = [start, partial(self.writer.add_metadata, "contract", contract)]
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="mcap-writer")
        try:
            self._hand_over()
        except BaseException:  # Ctrl-C, too: nothing else would end a thread that has just been started
            self.abandon()
            raise

    def add(self, job: Callable[[], object], size_bytes: int = 0) -> None:
        """Add a call of the writer; one of a message has a size, and is passed on within CHUNK_S by `look`."""
        self._jobs.append(job)
        if size_bytes:
            self._messages += 1
            self._open_bytes += size_bytes
            if self._due_s is None:
                self._due_s = time.monotonic() + CHUNK_S
            if self._open_bytes >= MOST_CHUNK_BYTES:
                self._hand_over()

    def full(self) -> bool:
        """Return True if so much waits for the disk that nothing should be added."""
        self._look_back()
        return self._waiting_bytes + self._open_bytes >= MOST_WAITING_BYTES

    def look(self) -> None:
        """Close the chunk if it is due."""
        self._look_back()
        if self._due_s is not None and time.monotonic() >= self._due_s:
            self._hand_over()

    def drain(self) -> None:
        """Wait until only the open chunk is not on the disk yet."""
        while self._handed_over:
            self._handed_over[0][0].exception()
            self._look_back()

    def close(self) -> None:
        """Write the rest, and the summary that lets a reader seek in the file; closed, and readable, if that fails."""
        try:
            self._hand_over()
            self._jobs.append(self.writer.finish)
            self._hand_over()
            self.drain()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is; one without a message, or of which no scan could be written, is deleted."""
        self._executor.shutdown()
        self._file.close()
        if not self.scans and (self._failed or not self._messages):
            self._path.unlink(missing_ok=True)

    def write(self, data: bytes) -> int:
        """Take bytes of the public writer; they are put on the disk as a whole chunk."""
        self._made += data
        return len(data)

    def tell(self) -> int:
        """Return the place of the next byte of the public writer."""
        return self._size_bytes + len(self._made)

    def flush(self) -> None:
        """Do nothing: `_run` puts the bytes on the disk."""

    def _hand_over(self) -> None:
        """Pass what was added to the writing thread, which works in order and writes nothing more after a failure."""
        self._look_back()
        jobs, waiting_bytes = self._jobs, self._open_bytes
        self._jobs, self._open_bytes, self._due_s = [], 0, None
        self._handed_over.append((self._executor.submit(self._run, jobs, self.added_scans), waiting_bytes))
        self._waiting_bytes += waiting_bytes

    def _look_back(self) -> None:
        while self._handed_over and self._handed_over[0][0].done():
            writing, waiting_bytes = self._handed_over.popleft()
            self._waiting_bytes -= waiting_bytes
            writing.result()

    def _run(self, jobs: list[Callable[[], object]], scans: int) -> None:
        if self._failed:
            return
        for job in jobs:
            job()
        if self.writer.finish not in jobs:
            self.writer.flush()
        try:
            with memoryview(self._made) as left:
                done = 0
                while done < len(left):
                    done += self._file.write(left[done:])
        except OSError:  # a disk that fills takes a part and refuses the rest
            self._failed = True
            os.ftruncate(self._file.fileno(), self._size_bytes)
            raise
        self._size_bytes += len(self._made)
        self._made.clear()
        self.scans = scans


class McapSink(Sink):
    """Writer of records into a new file; their wall times follow the clock at the start, however it is set later.

    In a robot's run a slow disk must delay nothing: after some seconds records are left out, and counted. A recording
    waits for it.
    """

    def __init__(self, path: Path, contract: Contract, source: Source) -> None:
        """Begin the file, or raise a SinkError; the contract is that of the model that the run begins with."""
        sensors, offset_ns = source.sensor_file, source.unix_offset_ns
        self._path, self._geometry, self._frames = path, sensors.geometry, dict(sensors.frames)
        self._origin: SourceKind | None = source.origin
        self._waits = source.kind == "replay"
        self._turns = CountersInTurn()
        self.unwritten = 0
        self._failed = False
        self._offset_ns = time.time_ns() - time.monotonic_ns() if offset_ns is None else offset_ns
        taxels = sensors.geometry.taxel_count
        self._scan, self._baseline = scan_type(taxels), baseline_type(taxels)
        self._facts = {
            "geometry": {key: json.dumps(value) for key, value in asdict(sensors.geometry).items()},
            "units": {name: unit.name for name, unit in UNITS.items()},
        }
        # Without them axes would point elsewhere when the file is played again.
        self._mountings = {name: {"mounting": mounting_text(mounting)} for name, mounting in sensors.mountings.items()}
        self._baselines: dict[str, Baseline | None] = {}
        self._repeat_ns: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}  # as the public writer numbers them
        self._sequences: Counter[int] = Counter()
        try:
            self._disk = _Disk(path, {key: json.dumps(value) for key, value in asdict(contract).items()})
        except FileExistsError as error:
            raise SinkError(f"{path} exists: give another name, or delete it first") from error
        except OSError as error:
            raise SinkError(f"cannot record into {path}: {error.strerror or error}") from error

    @property
    def scans(self) -> int:
        """Number of scans on the disk so far, of all sensors."""
        return self._disk.scans

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Add the messages of one scan."""
        self._try(self._act_if_room, self._add_result, result, counters)

    def pose(self, poses: Sequence[TimedPose]) -> None:
        """Add poses."""
        self._try(self._act_if_room, self._add_poses, poses)

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Add an event."""
        self._try(self._act_if_room, self._add_events, (event,))

    def wait(self) -> None:
        """Pass on the open chunk when it is due, while no scan comes."""
        self._try(self._disk.look)

    def close(self) -> None:
        """Finish the file; one without a message is deleted."""
        if self._failed:
            self._disk.abandon()
        else:
            self._try(self._disk.close)

    def _add_result(self, result: Result, counters: Mapping[str, int]) -> None:
        scan = result.scan
        sensor, unix_ns, frame = scan.sensor, scan.time_ns + self._offset_ns, ros.frame_of(result)
        on_bus_unix_ns = scan.on_bus_ns + self._offset_ns
        fields = record(result, self._turns.of(result, counters))
        self._add_meaning(result, unix_ns, frame)
        masks = mask_bits(scan.fresh), mask_bits(scan.renewed)
        # Scans name where they came from themselves, however often they were played: a tool may copy them alone.
        own = f"emulated/{sensor}" if self._kind(result) == "emulated" else frame
        self._disk.added_scans += 1
        self._add(sensor, "scan", self._scan, unix_ns, encode_scan(scan, own, on_bus_unix_ns, *masks))
        self._add(sensor, "result", ros.RESULT, unix_ns, ros.result_message(result, fields, on_bus_unix_ns))
        for name, values in maps_of(result).items():
            self._add(sensor, name, ros.GRID, unix_ns, grid(name, values, frame, on_bus_unix_ns, self._geometry))
        force = ros.wrench(result, self._geometry, on_bus_unix_ns)
        if force is not None:
            self._add(sensor, "wrench", ros.WRENCH_STAMPED, unix_ns, force)
        self._add_events(result.events)

    def _kind(self, result: Result) -> SourceKind:
        return self._origin or result.source

    def _add_meaning(self, result: Result, unix_ns: int, frame: str) -> None:
        """Add what a scan means, and a new baseline: once a second, so that a part of a file has them, too."""
        sensor, baseline = result.scan.sensor, result.baseline
        repeat = unix_ns >= self._repeat_ns.get(sensor, 0)
        if repeat:
            self._repeat_ns[sensor] = unix_ns + NS_PER_S
            facts = self._facts | {"source": {"kind": self._kind(result)}}
            if sensor in self._mountings:
                facts["mounting"] = self._mountings[sensor]
            header = {"stamp": stamp(unix_ns), "frame_id": frame}
            data = SENSOR.encode({"header": header, "sensor": sensor, "facts": json.dumps(facts)})
            self._add(sensor, "sensor", SENSOR, unix_ns, data)
        if baseline is not None and (repeat or self._baselines.get(sensor) is not baseline):
            data = encode_baseline(baseline, frame, result.baseline_age_s, unix_ns)
            self._add(sensor, "baseline", self._baseline, unix_ns, data)
            self._baselines[sensor] = baseline
        if sensor in self._frames:
            placed = ros.transforms({frame: self._frames.pop(sensor)}, unix_ns)
            self._add("", "/tf_static", ros.TF_MESSAGE, unix_ns, placed)

    def _add_poses(self, poses: Sequence[TimedPose]) -> None:
        for pose in poses:
            unix_ns = pose.time_ns + self._offset_ns
            self._add("", "/poses", POSE, unix_ns, encode_pose(pose, unix_ns))

    def _add_events(self, events: Sequence[Event]) -> None:
        for event in events:
            unix_ns = event.time_ns + self._offset_ns
            self._add("", "/events", ros.LOG, unix_ns, ros.log_message(event, unix_ns))
        self._disk.look()  # after the last message, so that a due chunk does not end in mid-scan

    def _add(self, sensor: str, name: str, kind: MessageType, unix_ns: int, data: bytes) -> None:
        """Add a message to a topic of a sensor, or to the topic `name` itself where `sensor` is empty."""
        writer = self._disk.writer
        channel = self._channels.get((sensor, name))
        if channel is None:
            if kind.name not in self._schemas:
                self._schemas[kind.name] = len(self._schemas) + 1
                definition = kind.definition.encode()
                self._disk.add(partial(writer.register_schema, kind.name, "ros2msg", definition))
            topic = f"/{ros.sensor_path(sensor)}/{name}" if sensor else name
            about = {"sensor": sensor} | ({"unit": UNITS[name].name} if name in UNITS else {})
            channel = self._channels[sensor, name] = len(self._channels) + 1
            self._disk.add(partial(writer.register_channel, topic, "cdr", self._schemas[kind.name], about))
        sequence = self._sequences[channel] & 0xFFFFFFFF
        self._sequences[channel] += 1
        self._disk.add(partial(writer.add_message, channel, unix_ns, data, unix_ns, sequence), len(data))

    def _act_if_room(self, act: Callable[..., None], *given: object) -> None:
        """Do something if there is room for one more record; else count it as left out."""
        if self._disk.full():
            if not self._waits:
                self.unwritten += 1
                return
            self._disk.drain()
        act(*given)

    def _try(self, act: Callable[..., None], *given: object) -> None:
        try:
            act(*given)
        except OSError as error:
            self._failed = True
            stopped = f"recording into {self._path} stopped: {error.strerror or error}"
            held = f"its {self.scans} scans can be played" if self.scans else "no scan of it was written: it is deleted"
            raise SinkError(f"{stopped}; {held}") from error
