"""Recordings in MCAP files, as the sink mcap: writes them, also if it was killed; patterns are computed again."""

import json
import os
import re
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, NoReturn

import numpy as np
from mcap.records import Channel, Metadata, Schema

from firmware_bridge.errors import CdrError, RecordingError
from firmware_bridge.pad_geometry import AXES, MOST_TAXELS, PADS, USPA44, SensorGeometry, pad_of
from firmware_bridge.poses import TimedPose
from firmware_bridge.recording.cdr import LAST_STAMP_NS, MessageType
from firmware_bridge.recording.mcap_records import CutOffError, DamageError, messages, short
from firmware_bridge.recording.scan_messages import (
    BASELINE_NAME,
    POSE,
    SCAN_NAME,
    SENSOR,
    RecordedScan,
    baseline_type,
    decode_baseline,
    decode_pose,
    decode_scan,
    scan_type,
)
from firmware_bridge.recording.tracks import (
    MOST_POSES,
    MOST_SENSORS,
    Recording,
    Track,
    origin_of,
    read_mounting,
)
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import VendorReading, is_sensor_name
from firmware_bridge.schedule import NS_PER_S
from firmware_bridge.zeroing.baseline import Baseline

MOST_KEPT_BYTES: Final = 1 << 31  # most bytes of the scans in memory: a day of one sensor at 100 Hz


@dataclass
class _Sensor:
    """Facts of one sensor, and its scans in columns: objects would take ten times the memory."""

    baseline: Baseline | None = None  # the one at its first scan
    latest: Baseline | None = None
    mounting: Mounting | None = None
    facts: str | None = None
    counts: bytearray = field(default_factory=bytearray)
    numbers: "array[int]" = field(default_factory=lambda: array("q"))
    times_ns: "array[int]" = field(default_factory=lambda: array("q"))
    device_times_ns: "array[int]" = field(default_factory=lambda: array("q"))
    renewed: "array[int]" = field(default_factory=lambda: array("Q"))
    vendor: dict[int, VendorReading] = field(default_factory=dict)

    def track(self, sensor: str, pad: SensorGeometry) -> Track:
        scans = len(self.times_ns)
        masks = np.frombuffer(self.renewed, "<u8").view(np.uint8).reshape(scans, 8)
        renewed = np.unpackbits(masks, axis=1, count=pad.taxel_count, bitorder="little").astype(bool)
        return Track(
            sensor,
            np.frombuffer(self.counts, np.int32).reshape(scans, *pad.scan_shape),
            np.frombuffer(self.times_ns, np.int64),
            np.frombuffer(self.numbers, np.int64),
            np.frombuffer(self.device_times_ns, np.int64),
            renewed.reshape(scans, pad.rows, pad.cols),
            tuple(map(self.vendor.get, range(scans))) if self.vendor else None,
            pad,
        )


def load_mcap(path: Path) -> Recording:
    """Read an MCAP file; one without an end up to its last whole record."""
    reading = _Reading(path)
    with path.open("rb") as file:
        try:
            for record in messages(file, reading.topic_of):
                if isinstance(record, Metadata):
                    reading.take_metadata(record.name, record.metadata)
                else:
                    reading.take_message(*record)
        except CutOffError as end:
            reading.notes.insert(0, f"{path} breaks off ({end}): its recording was killed, or the disk was full")
        except DamageError as damage:
            left_bytes = os.fstat(file.fileno()).st_size - file.tell()
            reading.notes.insert(0, f"{path} is damaged ({damage}): {left_bytes:,} bytes after that are not read")
    return reading.recording()


class _Reading:
    """Content of the records so far, with notes for the user."""

    def __init__(self, path: Path) -> None:
        self.notes: list[str] = []
        self._path = path
        self._sensors: dict[str, _Sensor] = {}  # those with scans in the order of the first ones
        self._geometry = USPA44  # for files that name no geometry
        self._named = False  # whether a message names it
        self._sized = False  # whether a message's definition holds its number of taxels
        self._offset_ns: int | None = None
        self._kept_bytes = 0
        self._poses: list[TimedPose] = []
        self._origin: Literal["device", "emulated"] | None = None

    def topic_of(self, channel: Channel, schema: Schema | None) -> tuple[str, MessageType] | None:
        """Return the name of a topic and the type of its messages; None for one that is not of edge-sr."""
        kind = None if schema is None or channel.message_encoding != "cdr" else self._kind_of(schema)
        return kind and (channel.topic[:60], kind)

    def recording(self) -> Recording:
        """Return what was read; a RecordingError without scans."""
        scanned = {name: entry for name, entry in self._sensors.items() if entry.times_ns}
        if not scanned:
            self._refuse("; ".join(["no scans that edge-sr recorded", *self.notes]))
        bare = sorted(name for name, entry in scanned.items() if entry.facts is None and entry.mounting is None)
        if bare:
            self.notes.append(
                f"{self._path}: the mounting of sensor {', '.join(bare)} is not in the file, as after a tool that "
                "copies a part of it: its axes are those of the id map, unless --sensor FILE gives others"
            )
        return Recording(
            self._path,
            tuple(entry.track(name, self._geometry) for name, entry in scanned.items()),
            None,
            {name: entry.baseline for name, entry in scanned.items() if entry.baseline is not None},
            {name: entry.mounting for name, entry in scanned.items() if entry.mounting is not None},
            self._offset_ns,
            tuple(self.notes),
            self._origin,
            self._poses,
        )

    def _sensor(self, name: str) -> _Sensor:
        if name not in self._sensors:
            if not is_sensor_name(name):
                self._refuse(f"sensor {name[:20]!r}, expected the name of one")
            if len(self._sensors) == MOST_SENSORS:
                self._refuse(f"more than {MOST_SENSORS} sensors")
            self._sensors[name] = _Sensor()
        return self._sensors[name]

    def _kind_of(self, schema: Schema) -> MessageType | None:
        sized = re.search(rb"\[([0-9]{1,4})\] counts ", schema.data)
        if schema.name in (SCAN_NAME, BASELINE_NAME) and sized is not None and not self._named:
            self._geometry = _pad_with(int(sized[1]) // len(AXES))
        taxels = self._geometry.taxel_count
        wanted = {kind.name: kind for kind in (scan_type(taxels), baseline_type(taxels), POSE, SENSOR)}.get(schema.name)
        if wanted is not None and (schema.encoding, schema.data) != ("ros2msg", wanted.definition.encode()):
            self._refuse(f"its {wanted.name} is of another release of edge-sr than this one")
        self._sized = self._sized or schema.name in (SCAN_NAME, BASELINE_NAME)
        return wanted

    def take_metadata(self, name: str, fields: Mapping[str, str]) -> None:
        """Take the mounting of a sensor and the kind of source, which the first release recorded as metadata alone."""
        if name == "mounting":
            sensor = fields.get("sensor", "")
            self._take_mounting(sensor, self._sensor(sensor), fields.get("mounting", ""))
        elif name == "source":
            self._take_source(fields)

    def _take_source(self, fields: Mapping[str, str]) -> None:
        self._origin = origin_of({fields.get("kind", ""), self._origin or ""} - {""})

    def _take_geometry(self, fields: Mapping[str, str]) -> None:
        try:
            geometry = SensorGeometry(**{key: json.loads(text) for key, text in fields.items()})
            sizes = (geometry.rows, geometry.cols)
            if not all(type(size) is int and size > 0 for size in sizes) or not is_sensor_name(geometry.name):
                raise ValueError("no grid of taxels")
            if self._sized and geometry.taxel_count != self._geometry.taxel_count:
                raise ValueError(f"{geometry.taxel_count} taxels, and {self._geometry.taxel_count} in its messages")
            if geometry.taxel_count > MOST_TAXELS:
                raise ValueError(f"{geometry.taxel_count} taxels, expected at most {MOST_TAXELS}")
        except (ValueError, TypeError, AttributeError, RecursionError, OverflowError) as error:
            self._refuse(f"no geometry of its sensors: {short(error)}")
        self._geometry, self._named = geometry, True

    def _take_mounting(self, sensor: str, entry: _Sensor, text: str) -> None:
        try:
            mounting = read_mounting(text, self._geometry.taxel_count)
        except ValueError as error:
            self._refuse(f"no mounting of sensor {sensor[:20]!r}: {short(error)}")
        if entry.mounting not in (None, mounting):
            self._refuse(f"two mountings of sensor {sensor[:20]!r}, expected one: cut it in parts")
        entry.mounting = mounting

    def _take_facts(self, data: bytes) -> None:
        fields = SENSOR.decode(data)
        sensor, text = fields["sensor"], fields["facts"]
        entry = self._sensor(sensor)
        if entry.facts == text:
            return
        try:
            facts = {
                name: {str(key): str(value) for key, value in values.items()}
                for name, values in json.loads(text).items()
            }
            if "source" in facts:
                self._take_source(facts["source"])
            if "geometry" in facts:
                self._take_geometry(facts["geometry"])
            if "mounting" in facts:
                self._take_mounting(sensor, entry, facts["mounting"].get("mounting", ""))
        except RecordingError:
            raise
        except (ValueError, AttributeError, RecursionError) as error:
            raise CdrError(f"facts of sensor {sensor[:20]!r} that cannot be read: {short(error)}") from error
        entry.facts = text

    def take_message(self, topic: tuple[str, MessageType], log_ns: int, data: bytes) -> None:
        """Process a message of a topic, logged at a time in [ns] since 1970."""
        name, kind = topic
        try:
            if kind is POSE:
                self._take_pose(decode_pose(data))
            elif kind is SENSOR:
                self._take_facts(data)
            elif kind.name == SCAN_NAME:
                self._take_scan(decode_scan(data, self._geometry), log_ns)
            else:
                self._take_baseline(decode_baseline(data, self._geometry))
        except CdrError as error:
            raise RecordingError(f"{self._path}, topic {name!r}: {error}") from error

    def _take_scan(self, scan: RecordedScan, log_ns: int) -> None:
        if scan.frame == f"emulated/{scan.sensor}":
            self._origin = "emulated"
        entry = self._sensor(scan.sensor)
        if not entry.times_ns:
            self._sensors[scan.sensor] = self._sensors.pop(scan.sensor)
        if self._offset_ns is None:
            self._offset_ns = log_ns - scan.time_ns
        unix_ns = scan.time_ns + self._offset_ns
        if not 0 <= unix_ns < LAST_STAMP_NS:  # such a scan could be played, but not recorded again
            got = f"a scan of sensor {scan.sensor!r} at {unix_ns:,} ns since 1970"
            self._refuse(f"{got}, expected 0..{LAST_STAMP_NS:,}")
        if entry.times_ns and scan.time_ns < entry.times_ns[-1]:
            self._refuse(f"times of sensor {scan.sensor!r} that go back, expected none")
        self._kept_bytes += 240 if scan.vendor is None else 1440
        if self._kept_bytes > MOST_KEPT_BYTES:
            self._refuse(f"more scans than {MOST_KEPT_BYTES:,} bytes hold: cut it in parts")
        if scan.vendor is not None:
            entry.vendor[len(entry.times_ns)] = scan.vendor
        entry.counts += scan.counts.tobytes()
        entry.numbers.append(scan.number)
        entry.times_ns.append(scan.time_ns)
        entry.device_times_ns.append(scan.device_time_ns)
        entry.renewed.append(scan.renewed)

    def _take_pose(self, timed: TimedPose) -> None:
        self._poses.append(timed)
        if timed.sensor is not None:
            self._sensor(timed.sensor)
        if len(self._poses) > MOST_POSES:
            self._refuse(f"more than {MOST_POSES:,} poses: cut it in parts")

    def _take_baseline(self, baseline: Baseline) -> None:
        entry = self._sensor(baseline.sensor)
        before, entry.latest = entry.latest, baseline
        # A part of a file may have it after a sensor's first scan, which was made with it: it is repeated.
        first_ns = entry.times_ns[0] + (self._offset_ns or 0) if entry.times_ns else 0
        if not entry.times_ns or (before is None and baseline.created_unix_s < first_ns / NS_PER_S):
            entry.baseline = baseline
        elif before is not None and before.id != baseline.id and len(self.notes) < MOST_SENSORS:
            self.notes.append(
                f"{self._path}: sensor {baseline.sensor} was zeroed again while it was recorded ({before.id}, then "
                f"{baseline.id}); played again it keeps to the baseline of its beginning"
            )

    def _refuse(self, why: str) -> NoReturn:
        raise RecordingError(f"{self._path}: {why}")


def _pad_with(taxels: int) -> SensorGeometry:
    """Return the pad with so many taxels, for a file that names none yet."""
    if not 0 < taxels <= MOST_TAXELS:
        return USPA44
    return next((pad for pad in PADS if pad.taxel_count == taxels), None) or pad_of(1, taxels)
