"""Recordings in MCAP files, as the sink mcap: writes them; also if the sink was killed while it wrote.

A file is not trusted: records are read one by one, each up to a limit, and a chunk is unpacked up to its stated size.
Only scans and baselines are kept; patterns are skipped, since they are computed again.
"""

import json
import os
import struct
import zlib
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final, Literal, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from firmware_bridge.errors import CdrError, RecordingError
from firmware_bridge.pad_geometry import MOST_TAXELS, USPA44, SensorGeometry
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.recording.cdr import LAST_STAMP_NS, MessageType
from firmware_bridge.recording.pose_columns import PoseRows
from firmware_bridge.recording.pose_messages import POSE, decode_pose
from firmware_bridge.recording.scan_messages import SCAN_NAME, baseline_type, decode_baseline, decode_scan, scan_type
from firmware_bridge.recording.tracks import (
    GEOMETRY_METADATA,
    MOST_SENSORS,
    MOUNTING_METADATA,
    SOURCE_METADATA,
    Recording,
    Track,
    origin_of,
)
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import VendorReading, is_sensor_name
from firmware_bridge.zeroing.baseline import Baseline

MOST_RECORD_BYTES: Final = 1 << 25
"""Most bytes of one record, and of a chunk when unpacked: writers make chunks of one to a few megabytes."""
MOST_WINDOW_BYTES: Final = 1 << 25
"""Largest window of zstd, in bytes."""
MOST_KEPT_BYTES: Final = 1 << 31
"""Most bytes of the scans in memory: a day of one sensor at 100 Hz."""
_SCAN_BYTES: Final = 240
_VENDOR_BYTES: Final = 1200
_POSE_BYTES: Final = 64
MOST_SHOWN_TOPICS: Final = 10
LONGEST_SHOWN: Final = 60
_RECORD: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")
_BROKEN: Final = (
    *(struct.error, McapError, zstandard.ZstdError, ValueError, OverflowError, MemoryError),
    *(EOFError, RuntimeError),  # of lz4
)


class _DamageError(Exception):
    """A record cannot be read, so the rest of the file is not read either."""


class _CutOffError(_DamageError):
    """The file ends too early."""


class _Topic(NamedTuple):
    name: str
    kind: MessageType | None


@dataclass
class _Lane:
    """Scans of one sensor in their order, in columns: objects would take ten times the memory."""

    counts: bytearray = field(default_factory=bytearray)
    numbers: "array[int]" = field(default_factory=lambda: array("q"))
    times_ns: "array[int]" = field(default_factory=lambda: array("q"))
    device_times_ns: "array[int]" = field(default_factory=lambda: array("q"))
    renewed: "array[int]" = field(default_factory=lambda: array("Q"))
    vendor: dict[int, VendorReading] = field(default_factory=dict)


def load_mcap(path: Path) -> Recording:
    """Read an MCAP file; one without an end up to its last whole record, which `notes` then report.

    Raises:
        RecordingError: it is no MCAP file, or holds no scans that edge-sr recorded.
        OSError: the file cannot be read.
    """
    reading = _Reading(path)
    with path.open("rb") as file:
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise RecordingError(f"{path}: not an MCAP file: it does not begin as one")
        try:
            for opcode, data in _records(file):
                reading.take(opcode, data)
        except _CutOffError as end:
            reading.broken_off(str(end))
        except _DamageError as damage:
            reading.damaged(str(damage), os.fstat(file.fileno()).st_size - file.tell())
    return reading.recording()


class _Reading:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._schemas: dict[int, MessageType | None] = {}
        self._topics: dict[int, _Topic] = {}
        self._lanes: dict[str, _Lane] = {}
        self._baselines: dict[str, Baseline] = {}
        self._latest: dict[str, Baseline] = {}
        self._mountings: dict[str, Mounting] = {}
        self._geometry = USPA44  # for files that name no geometry
        self._offset_ns: int | None = None
        self._kept_bytes = 0
        self._poses = PoseRows()
        self._notes: list[str] = []
        self._origin: Literal["device", "emulated"] | None = None

    def take(self, opcode: int, data: memoryview) -> None:
        """Process one record, from a chunk or between chunks."""
        if opcode == Opcode.MESSAGE:
            self._take_message(data)
            return
        stream = ReadDataStream(BytesIO(data))
        try:
            if opcode == Opcode.SCHEMA:
                self._take_schema(Schema.read(stream))
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(stream)
                kind = self._schemas.get(channel.schema_id) if channel.message_encoding == "cdr" else None
                self._topics[channel.id] = _Topic(channel.topic[:LONGEST_SHOWN], kind)
            elif opcode == Opcode.METADATA:
                self._take_metadata(Metadata.read(stream))
        except _BROKEN as error:
            if isinstance(error, RecordingError):
                raise
            raise _DamageError(f"a record that cannot be read ({_short(error)})") from error

    def _take_schema(self, schema: Schema) -> None:
        taxels = self._geometry.taxel_count
        known = {kind.name: kind for kind in (scan_type(taxels), baseline_type(taxels), POSE)}.get(schema.name)
        if known is not None and (schema.encoding, schema.data) != ("ros2msg", known.definition.encode()):
            raise RecordingError(f"{self._path}: its {known.name} is of another release of edge-sr than this one")
        self._schemas[schema.id] = known

    def _take_metadata(self, metadata: Metadata) -> None:
        if metadata.name == SOURCE_METADATA:
            self._origin = origin_of({metadata.metadata.get("kind", ""), self._origin or ""} - {""})
        if metadata.name == GEOMETRY_METADATA:
            self._take_geometry(metadata.metadata)
        if metadata.name != MOUNTING_METADATA:
            return
        sensor = metadata.metadata.get("sensor", "")
        try:
            fields = json.loads(metadata.metadata["mounting"])
            order, signs, gains = (tuple(fields[key]) for key in ("order", "signs", "gains"))
            if not all(type(value) is int for value in (*order, *signs)) or type(fields["swap_xy"]) is not bool:
                raise ValueError("not whole numbers")
            mounting = Mounting(order, fields["swap_xy"], signs, tuple(map(float, gains)), self._geometry.taxel_count)
        except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
            raise RecordingError(f"{self._path}: no mounting of sensor {sensor[:20]!r}: {_short(error)}") from error
        if not is_sensor_name(sensor) or len(self._mountings) >= MOST_SENSORS:
            raise RecordingError(f"{self._path}: a mounting of sensor {sensor[:20]!r}, expected those of its sensors")
        self._mountings[sensor] = mounting

    def _take_geometry(self, fields: Mapping[str, str]) -> None:
        try:
            geometry = SensorGeometry(**{key: json.loads(text) for key, text in fields.items()})
            sizes = (geometry.rows, geometry.cols)
            if not all(type(size) is int and size > 0 for size in sizes) or not is_sensor_name(geometry.name):
                raise ValueError("no grid of taxels")
            if self._schemas and geometry.taxel_count != self._geometry.taxel_count:
                raise ValueError("it stands after the first message's definition")
            if geometry.taxel_count > MOST_TAXELS:
                raise ValueError(f"{geometry.taxel_count} taxels, expected at most {MOST_TAXELS}")
        except (ValueError, TypeError, AttributeError, RecursionError, OverflowError) as error:
            raise RecordingError(f"{self._path}: no geometry of its sensors: {_short(error)}") from error
        self._geometry = geometry

    def _take_message(self, data: memoryview) -> None:
        try:
            channel, _, log_ns, _ = _MESSAGE.unpack_from(data)
        except struct.error as error:
            raise _DamageError("a message that is cut off") from error
        topic = self._topics.get(channel)
        if topic is None or topic.kind is None:
            return
        try:
            if topic.kind.name == SCAN_NAME:
                self._take_scan(data[_MESSAGE.size :], log_ns)
            elif topic.kind is POSE:
                self._take_pose(decode_pose(data[_MESSAGE.size :]))
            else:
                self._take_baseline(decode_baseline(data[_MESSAGE.size :], self._geometry))
        except CdrError as error:
            raise RecordingError(f"{self._path}, topic {topic.name!r}: {error}") from error

    def _take_scan(self, data: memoryview, log_ns: int) -> None:
        scan = decode_scan(data, self._geometry)
        lane = self._lanes.get(scan.sensor)
        if lane is None:
            if len(self._lanes) == MOST_SENSORS:
                raise RecordingError(f"{self._path}: more than {MOST_SENSORS} sensors")
            lane = self._lanes[scan.sensor] = _Lane()
        if self._offset_ns is None:
            self._offset_ns = log_ns - scan.time_ns
        unix_ns = scan.time_ns + self._offset_ns
        if not 0 <= unix_ns < LAST_STAMP_NS:  # such a scan could be played, but not recorded again
            raise RecordingError(
                f"{self._path}: a scan of sensor {scan.sensor!r} at {unix_ns:,} ns since 1970, expected "
                f"0..{LAST_STAMP_NS:,}"
            )
        if lane.times_ns and scan.time_ns < lane.times_ns[-1]:
            raise RecordingError(f"{self._path}: times of sensor {scan.sensor!r} that go back, expected none")
        self._kept_bytes += _SCAN_BYTES if scan.vendor is None else _SCAN_BYTES + _VENDOR_BYTES
        if self._kept_bytes > MOST_KEPT_BYTES:
            raise RecordingError(f"{self._path}: more scans than {MOST_KEPT_BYTES:,} bytes hold: cut it in parts")
        if scan.vendor is not None:
            lane.vendor[len(lane.times_ns)] = _own(scan.vendor)
        lane.counts += scan.counts.tobytes()
        lane.numbers.append(scan.number)
        lane.times_ns.append(scan.time_ns)
        lane.device_times_ns.append(scan.device_time_ns)
        lane.renewed.append(scan.renewed)

    def _take_pose(self, timed: TimedPose) -> None:
        self._kept_bytes += _POSE_BYTES
        if self._kept_bytes > MOST_KEPT_BYTES:
            raise RecordingError(f"{self._path}: more poses than {MOST_KEPT_BYTES:,} bytes hold: cut it in parts")
        self._poses.add(timed)
        if self._poses.sensors > MOST_SENSORS + 1:
            raise RecordingError(f"{self._path}: poses of more than {MOST_SENSORS} sensors")

    def _take_baseline(self, baseline: Baseline) -> None:
        sensor = baseline.sensor
        before = self._latest.get(sensor)
        if before is None and len(self._latest) == MOST_SENSORS:
            raise RecordingError(f"{self._path}: baselines of more than {MOST_SENSORS} sensors")
        if sensor not in self._lanes:
            self._baselines[sensor] = baseline
        elif before is not None and before.id != baseline.id and len(self._notes) < MOST_SENSORS:
            self._notes.append(
                f"{self._path}: sensor {sensor} was zeroed again while it was recorded ({before.id}, then "
                f"{baseline.id}); played again it keeps to the baseline of its beginning"
            )
        self._latest[sensor] = baseline

    def broken_off(self, why: str) -> None:
        """Keep the records so far and note that the file ends early."""
        self._notes.insert(0, f"{self._path} breaks off ({why}): its recording was killed, or the disk was full")

    def damaged(self, why: str, left_bytes: int) -> None:
        """Keep the records before the damage and note it."""
        self._notes.insert(0, f"{self._path} is damaged ({why}): {left_bytes:,} bytes after that are not read")

    def recording(self) -> Recording:
        if not self._lanes:
            raise RecordingError(f"{self._path}: no scans that edge-sr recorded{self._instead()}")
        tracks = tuple(_track(sensor, lane, self._geometry) for sensor, lane in self._lanes.items())
        mountings = {name: one for name, one in self._mountings.items() if name in self._lanes}
        baselines = {name: one for name, one in self._baselines.items() if name in self._lanes}
        return Recording(
            self._path,
            tracks,
            None,
            baselines,
            mountings,
            self._offset_ns,
            tuple(self._notes),
            self._origin,
            self._poses.columns(),
        )

    def _instead(self) -> str:
        if self._notes:
            return f"; {self._notes[0]}"
        names = [topic.name for topic in self._topics.values()]
        if not names:
            return ", and no topics"
        more = f", and {len(names) - MOST_SHOWN_TOPICS} more" if len(names) > MOST_SHOWN_TOPICS else ""
        return f"; its topics are {', '.join(map(repr, names[:MOST_SHOWN_TOPICS]))}{more}"


def _records(file: BinaryIO) -> Iterator[tuple[int, memoryview]]:
    """Yield each record up to the end of the data, those in chunks one by one; lengths are checked by its size."""
    size_bytes = os.fstat(file.fileno()).st_size
    while True:
        at = file.tell()
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            raise _CutOffError(f"without an end, at byte {at}")
        opcode, length = _RECORD.unpack(head)
        if length > size_bytes - at - _RECORD.size:
            raise _CutOffError(f"within a record, at byte {at}")
        if opcode == Opcode.DATA_END:
            return
        if opcode not in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
            file.seek(length, os.SEEK_CUR)
            continue
        if length > MOST_RECORD_BYTES:
            raise _DamageError(f"at byte {at}, a record of {length:,} bytes, expected at most {MOST_RECORD_BYTES:,}")
        data = memoryview(file.read(length))
        if opcode != Opcode.CHUNK:
            yield opcode, data
            continue
        try:
            unpacked = _unpacked(Chunk.read(ReadDataStream(BytesIO(data))))
        except _BROKEN as error:
            raise _DamageError(f"at byte {at}, a chunk that cannot be unpacked: {_short(error)}") from error
        yield from _records_of(unpacked, at)


def _records_of(chunk: bytes, at: int) -> Iterator[tuple[int, memoryview]]:
    view, position = memoryview(chunk), 0
    while position < len(chunk):
        if len(chunk) - position < _RECORD.size:
            raise _DamageError(f"at byte {at}, a chunk that is cut off")
        opcode, length = _RECORD.unpack_from(chunk, position)
        position += _RECORD.size
        if length > len(chunk) - position:
            raise _DamageError(f"at byte {at}, a chunk that is cut off")
        yield opcode, view[position : position + length]
        position += length


def _unpacked(chunk: Chunk) -> bytes:
    size_bytes = chunk.uncompressed_size
    if size_bytes > MOST_RECORD_BYTES:
        raise ValueError(f"{size_bytes:,} bytes, expected at most {MOST_RECORD_BYTES:,}")
    if chunk.compression == "zstd":
        unpacker = zstandard.ZstdDecompressor(max_window_size=MOST_WINDOW_BYTES)
        data = unpacker.stream_reader(chunk.data).read(size_bytes + 1)
    elif chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size_bytes + 1)
    elif not chunk.compression:
        data = chunk.data
    else:
        raise ValueError(f"compressed by {chunk.compression[:20]!r}, expected zstd, lz4 or nothing")
    if len(data) != size_bytes:
        raise ValueError(f"it does not hold the {size_bytes:,} bytes that it states")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("its check sum is wrong")
    return data


def _track(sensor: str, lane: _Lane, geometry: SensorGeometry) -> Track:
    scans = len(lane.times_ns)
    masks = np.frombuffer(lane.renewed, "<u8").astype("<u8").view(np.uint8).reshape(scans, 8)
    renewed = np.unpackbits(masks, axis=1, count=geometry.taxel_count, bitorder="little").astype(bool)
    return Track(
        sensor,
        np.frombuffer(lane.counts, np.int32).reshape(scans, *geometry.scan_shape),
        np.frombuffer(lane.times_ns, np.int64),
        np.frombuffer(lane.numbers, np.int64),
        np.frombuffer(lane.device_times_ns, np.int64),
        renewed.reshape(scans, geometry.rows, geometry.cols),
        tuple(map(lane.vendor.get, range(scans))) if lane.vendor else None,
        geometry,
    )


def _own(vendor: VendorReading) -> VendorReading:
    """Return a copy, since a view would keep the whole chunk in memory."""
    arrays = (vendor.newtons, vendor.temperature_k, vendor.ups_hz)
    return VendorReading(*(None if array is None else array.copy() for array in arrays))


def _short(error: BaseException) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__
