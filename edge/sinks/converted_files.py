"""Files that `edge-sr convert` writes: npz with a row for each scan, as docs/formats.md lists them, and CSV."""

import csv
import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import astuple
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, Final, NamedTuple

import numpy as np
from mcap.records import Channel, Metadata, Schema
from numpy.lib import format as npy
from numpy.typing import NDArray

from edge.errors import SinkError
from edge.perception.record_fields import FIELDS, MAPS, Field, Out
from edge.sinks.ros2.map_messages import UNITS, recorded_map
from edge.sinks.ros2.messages import GRID, IMAGE, RESULT
from firmware_bridge.errors import RecordingError
from firmware_bridge.pad_geometry import AXES
from firmware_bridge.poses import PoseTrack, TimedPose
from firmware_bridge.recording.cdr import MessageType
from firmware_bridge.recording.csv_reader import CSV_POSES, EMULATED, csv_header
from firmware_bridge.recording.mcap_records import DamageError, messages
from firmware_bridge.recording.scan_messages import BASELINE_NAME, SCAN_NAME, decode_baseline, decode_scan
from firmware_bridge.recording.tracks import Recording, Track, mounting_text
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import ABSENT
from firmware_bridge.schedule import NS_PER_S
from firmware_bridge.zeroing.baseline import Baseline

KINDS: Final[Mapping[str, tuple[str, Any]]] = {
    **{field.name: (field.kind.array, field.kind.unknown) for field in FIELDS if Out.NPZ in field.out},
    "origin": ("<U8", ""),
}
"""numpy's type of each array, and the value of a row where it is unknown."""
_MAP_NAMES: Final = frozenset(field.name for field in MAPS)
_OF_SCANS: Final = {"time_ns", "sensor", "scan", "device_time_ns", "counts", "has_pattern", "baseline_counts"}
_OF_RECORDS: Final = tuple(
    field for field in FIELDS if Out.NPZ in field.out and field.name not in _MAP_NAMES | _OF_SCANS
)
_ELSEWHERE: Final = {"scan_pose": ("pose",), "centre_of_pressure_mm": ("wrench", "centre_of_pressure_mm")}
"""Places in a record of arrays that have another name there."""


def write_npz(path: Path, recording: Recording) -> None:
    """Write arrays with a row for each scan of an .mcap; what a row lacks is unknown there.

    Raises a RecordingError where a result cannot be read, a SinkError where patterns change their size.
    """
    with ExitStack() as opened:
        columns = _Columns(path.parent, opened)
        for row in _Rows(recording):
            columns.add(row)
        texts = {name: mounting_text(mounting) for name, mounting in recording.mountings.items()}
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            _add(archive, "format", np.asarray("tactile-results"))
            _add(archive, "mountings", np.asarray(json.dumps(texts)))
            columns.add_to(archive)
            for name, array in _pose_arrays(recording.poses).items():
                _add(archive, name, array)


class _Columns:
    """Arrays that grow by a row a scan, each in a file of its own, so that memory stays flat."""

    def __init__(self, folder: Path, opened: ExitStack) -> None:
        self._folder, self._opened = folder, opened
        self._rows = 0
        self._columns: dict[str, tuple[IO[bytes], np.dtype[Any], tuple[int, ...], bytes]] = {}

    def add(self, row: Mapping[str, Any]) -> None:
        for name in [name for name in row if name not in self._columns]:
            kind, unknown = KINDS[name]
            shape, dtype = np.shape(row[name]), np.dtype(kind)
            file = self._opened.enter_context(TemporaryFile(dir=self._folder))  # noqa: SIM115 - closed with the others
            blank = np.full(shape, ("" if dtype.kind == "U" else 0) if unknown is None else unknown, dtype)
            self._columns[name] = file, dtype, shape, blank.tobytes()
            for _ in range(self._rows):
                file.write(blank.tobytes())
        for name, (file, dtype, shape, unknown) in self._columns.items():
            value = row.get(name)
            if value is None:
                file.write(unknown)
                continue
            array = np.asarray(value, dtype)
            if array.shape != shape:
                raise SinkError(f"{name} of {shape} and of {array.shape} in one recording: cut it in parts")
            file.write(array.tobytes())
        self._rows += 1

    def add_to(self, archive: zipfile.ZipFile) -> None:
        for name in sorted(self._columns, key=lambda name: name != "origin"):  # first: what loses its end has it
            file, dtype, shape, _ = self._columns[name]
            file.flush()
            _add(archive, name, np.memmap(file, dtype, "r", shape=(self._rows, *shape)))


def _add(archive: zipfile.ZipFile, name: str, array: NDArray[Any]) -> None:
    with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
        npy.write_array(entry, array)


def _pose_arrays(poses: Sequence[TimedPose]) -> dict[str, NDArray[Any]]:
    if not poses:
        return {}
    return {
        "pose_time_ns": np.array([pose.time_ns for pose in poses]),
        "pose": np.array([astuple(pose.pose) for pose in poses], np.float64),
        "pose_sensor": np.array([pose.sensor or "" for pose in poses]),
        "pose_holds": np.array([pose.holds for pose in poses]),
    }


class _Topic(NamedTuple):
    sensor: str
    name: str
    kind: MessageType


class _Rows:
    """Rows of a recording, each the values of a scan by the names of KINDS, in the order of its messages."""

    def __init__(self, recording: Recording) -> None:
        self._path, self._geometry = recording.path, recording.tracks[0].geometry
        self._origin = recording.origin or "replay"
        self._baselines: dict[str, Baseline] = {}
        self._taps = 1
        self._of = ""
        self._row: dict[str, Any] | None = None

    def __iter__(self) -> Iterator[dict[str, Any]]:
        try:
            with self._path.open("rb") as file:
                for message in messages(file, self._topic_of):
                    if isinstance(message, Metadata):
                        if message.name == "contract":
                            self._taps = int(message.metadata.get("taps", "1"))
                        continue
                    if message[0].kind.name == SCAN_NAME and self._row is not None:
                        yield self._row
                    self._read(*message)
        except DamageError:
            pass  # a note of `load_recording` states it
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise RecordingError(f"{self._path}: a result that cannot be read: {str(error)[:120]}") from error
        if self._row is not None:
            yield self._row

    def _topic_of(self, channel: Channel, schema: Schema | None) -> _Topic | None:
        sensor, _, name = channel.topic.rpartition("/")
        if schema is not None and schema.name == IMAGE.name and name in _MAP_NAMES:
            raise RecordingError(
                f"{self._path}: its maps are images, as of earlier releases: convert it with one, or make its results "
                "again by edge-sr replay"
            )
        if schema is None or schema.name not in (SCAN_NAME, BASELINE_NAME, RESULT.name, GRID.name):
            return None
        return _Topic(sensor, name, MessageType.of(schema.name, schema.data.decode()))

    def _read(self, topic: _Topic, log_ns: int, data: bytes) -> None:
        if topic.kind.name == SCAN_NAME:
            self._of, self._row = topic.sensor, self._begun(data, log_ns)
        elif topic.kind.name == BASELINE_NAME:
            baseline = decode_baseline(data, self._geometry)
            self._baselines[baseline.sensor] = baseline
        elif topic.sensor != self._of or self._row is None:
            return
        elif topic.kind.name == RESULT.name:
            record = json.loads(topic.kind.decode(data)["record"])
            fields = (field for field in _OF_RECORDS if field.name != "poses" or record.get("poses") is not None)
            self._row |= {field.name: _value(field, record, self._taps) for field in fields}
        elif topic.name in _MAP_NAMES:
            self._row |= {topic.name: recorded_map(data) / np.float32(UNITS[topic.name].factor), "has_pattern": True}

    def _begun(self, data: bytes, log_ns: int) -> dict[str, Any]:
        scan = decode_scan(data, self._geometry)
        row: dict[str, Any] = {
            "time_ns": scan.time_ns,
            "sensor": scan.sensor,
            "scan": scan.number,
            "device_time_ns": scan.device_time_ns,
            "counts": scan.counts,
            "source": self._origin,
            "origin": self._origin,
            "has_pattern": False,
        }
        baseline = self._baselines.get(scan.sensor)
        if baseline is not None:
            row["baseline"], row["baseline_counts"] = baseline.id, baseline.counts
            row["baseline_age_s"] = log_ns / NS_PER_S - baseline.created_unix_s
        return row


def _value(field: Field, record: Mapping[str, Any], taps: int) -> Any:
    """Return a field of a record, as an array holds it."""
    value: Any = record
    for key in _ELSEWHERE.get(field.name, (field.name,)):
        value = None if value is None else value.get(key)
    if field.name == "poses":
        poses = np.full((taps, 5), np.nan, np.float32)
        poses[: len(value)] = value[:taps]
        return poses
    if field.parts:
        numbers = [np.nan if number is None else number for number in _flat(value)]
        return (numbers + [np.nan] * len(field.parts))[: len(field.parts)]
    if value is None:
        return field.kind.unknown
    return sum(1 << int(taxel) for taxel in value) if field.name == "dead" else value


def _flat(value: Any) -> list[float | None]:
    """Return the numbers of a value, in their order."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [number for part in value for number in _flat(part)]
    return [value]


def write_csv(path: Path, recording: Recording, track: Track) -> None:
    """Write the scans of a sensor that have all readings, since a CSV has no cell for an absent one.

    The taxels are in the order of the id map, by the sensor's mounting.
    """
    taxels = track.geometry.taxel_count
    times_ns = {each.sensor: each.time_ns for each in recording.tracks if each.time_ns is not None}
    first_ns = min(int(times[0]) for times in times_ns.values())
    mounting = recording.mountings.get(track.sensor, Mounting(taxel_count=taxels))
    counts = track.counts.reshape(-1, len(AXES), taxels)[:, :, np.argsort(mounting.order)]
    own = [pose for pose in recording.poses if pose.sensor == track.sensor]
    poses = own or [pose for pose in recording.poses if pose.sensor is None]
    course, taken = PoseTrack(), 0
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        mark = (EMULATED,) if recording.origin == "emulated" else ()
        writer.writerow(("time_s", *csv_header(taxels), *(CSV_POSES if poses else ()), *mark))
        for row in np.flatnonzero((counts != ABSENT).all(axis=(1, 2))):
            time_ns = int(times_ns[track.sensor][row])
            while taken < len(poses) and (poses[taken].used_from_ns or poses[taken].time_ns) <= time_ns:
                course.add(poses[taken].time_ns, poses[taken].pose, holds=poses[taken].holds)
                taken += 1
            pose = course.at(time_ns)
            place = ("", "", "") if pose is None else (pose.x_mm, pose.y_mm, pose.turn_deg)
            readings = counts[row].T.ravel().tolist()
            seconds = f"{(time_ns - first_ns) / 1e9:.6f}"
            writer.writerow((seconds, *readings, *(place if poses else ()), *("1" for _ in mark)))
