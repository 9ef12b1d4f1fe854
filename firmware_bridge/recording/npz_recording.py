"""Recordings as npz: arrays with a row for each scan, as `edge-sr convert` and earlier releases write them.

Nothing is unpickled, and no memory is allocated by an unchecked header.
"""

import io
import json
import math
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from math import prod
from pathlib import Path
from tempfile import TemporaryFile
from tokenize import TokenError
from typing import Any, BinaryIO, Final, Literal, NoReturn

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from firmware_bridge.errors import NpzError, RecordingError
from firmware_bridge.pad_geometry import AXES, MOST_TAXELS
from firmware_bridge.poses import POSE_FIELDS, PadPose, TimedPose
from firmware_bridge.recording.scan_messages import read_mounting
from firmware_bridge.recording.tracks import (
    A_RATE,
    HIGHEST_COUNT,
    MOST_POSES,
    MOST_SENSORS,
    Recording,
    Track,
    is_rate,
    origin_of,
)
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import ABSENT, LONGEST_SENSOR_NAME, is_sensor_name
from firmware_bridge.schedule import LAST_TIME_NS, NS_PER_S
from firmware_bridge.zeroing.baseline import LAST_UNIX_S, Baseline

LONGEST_READ_BYTES: Final = 1 << 20
"""Most bytes of one read: zipfile reads a table of contents in one piece, whose members could take gigabytes."""
_SURROGATES: Final = (0xD800, 0xDFFF)
_BROKEN: Final = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, ValueError, TypeError, LookupError, OverflowError),
    RuntimeError,  # encrypted, with an unsupported compression, or nested too deep
    *(SyntaxError, TokenError, MemoryError, Warning),  # errors that numpy's reader of the header passes on
)
_HEADERS: Final = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_LOCAL: Final = struct.Struct("<4sHHHIIIIHH")
"""Head of a member: mark, version, flags, compression, time, check sum, sizes, and lengths of name and extra field."""
_CENTRAL: Final = struct.Struct("<4sHHHHIIIIHHHHHII")
"""The same in the directory, with three more fields of nothing, attributes, and the place of the member."""
_END: Final = struct.Struct("<4sHHHHIIH")
_MOST_SALVAGED_BYTES: Final = 1 << 31
_COMPRESSIONS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compressions that numpy writes. zipfile unpacks others without a limit on the output of one piece."""


def read_npz(
    path: Path, names: Iterable[str], most_bytes: int, damaged: Callable[[], object] | None = None
) -> dict[str, NDArray[Any]]:
    """Read the arrays of these names that are in the file; others are not read.

    Args:
        path: path of the file.
        names: names of the arrays.
        most_bytes: largest allowed size of them together.
        damaged: called where the file has lost its end, to read the arrays that are whole; without it that is refused.

    Raises:
        NpzError: not an archive of plain arrays of numbers and text, damaged, or larger.
        OSError: the file cannot be read.
    """
    try:
        with warnings.catch_warnings(), _ShortReads(io.FileIO(path)) as file, ExitStack() as opened:
            warnings.simplefilter("error")  # numpy repairs headers of Python 2 with a warning, also for broken ones
            begins = file.read(4) == b"PK\3\4"
            if damaged is not None and begins and not zipfile.is_zipfile(file):
                copy = opened.enter_context(TemporaryFile())
                _copy_whole(file, copy)
                file = copy
                damaged()
            archive = opened.enter_context(zipfile.ZipFile(file))
            members = {info.filename: info for info in archive.infolist()}
            wanted = {name: members[f"{name}.npy"] for name in names if f"{name}.npy" in members}
            total_bytes = sum(info.file_size for info in wanted.values())
            if total_bytes > most_bytes:
                raise NpzError(f"arrays of {total_bytes:,} bytes, expected at most {most_bytes:,}")
            return {name: _read_member(archive, info) for name, info in wanted.items()}
    except NpzError:
        raise
    except _BROKEN as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise NpzError(f"not a whole .npz archive of plain arrays: {reason[:200]}") from error


def _copy_whole(file: BinaryIO, copy: BinaryIO) -> None:
    """Copy an archive that lost its end, where its directory is, with a directory of its members that are whole."""
    size_bytes, at, directory, count = file.seek(0, io.SEEK_END), 0, bytearray(), 0
    while True:
        file.seek(at)
        head = file.read(_LOCAL.size)
        if len(head) < _LOCAL.size or not head.startswith(b"PK\3\4"):
            break
        _, version, flags, method, time, crc, packed, whole, name_bytes, extra_bytes = _LOCAL.unpack(head)
        name, extra = file.read(name_bytes), file.read(extra_bytes)
        if extra.startswith(b"\1\0\x10\0"):  # sizes of eight bytes, as for a member of unknown length
            whole, packed = struct.unpack_from("<QQ", extra, 4)
        end = file.tell() + packed
        if end > min(size_bytes, _MOST_SALVAGED_BYTES) or flags & 8:
            break
        sizes = (crc, packed, whole, len(name), 0, 0, 0, 0, 0, at)
        directory += _CENTRAL.pack(b"PK\1\2", version, version, flags, method, time, *sizes) + name
        at, count = end, count + 1
    file.seek(0)
    while left := min(at - file.tell(), LONGEST_READ_BYTES):
        copy.write(file.read(left))
    copy.write(directory + _END.pack(b"PK\5\6", 0, 0, count, count, len(directory), at, 0))


class _ShortReads(io.BufferedReader):
    """File that refuses to read more than LONGEST_READ_BYTES in one piece."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > LONGEST_READ_BYTES:
            raise zipfile.BadZipFile(f"a piece of {size:,} bytes, expected at most {LONGEST_READ_BYTES:,}")
        return super().read(size)


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    if info.compress_type not in _COMPRESSIONS:
        raise NpzError(f"{info.filename} is compressed in another way than numpy's: save it again with numpy")
    with archive.open(info) as entry:
        version = npy.read_magic(entry)
        if version not in _HEADERS:
            raise NpzError(f"{info.filename} is of npy version {version}, expected (1, 0) or (2, 0)")
        shape, _, dtype = _HEADERS[version](entry)
        if dtype.hasobject or dtype.kind not in "biufU":
            raise NpzError(f"{info.filename} holds {dtype}, expected plain arrays of numbers or text")
        stated_bytes, held_bytes = prod(shape) * dtype.itemsize, info.file_size - entry.tell()
        if stated_bytes != held_bytes:
            raise NpzError(f"{info.filename} states {stated_bytes} bytes and holds {held_bytes}: it is damaged")
    with archive.open(info) as entry:
        array = npy.read_array(entry, allow_pickle=False)
        if entry.read(1):  # reading to the end also verifies the checksum
            raise NpzError(f"{info.filename} holds more than its array: it is damaged")
    if dtype.kind == "U" and array.size and dtype.itemsize:
        points = np.frombuffer(array.tobytes(), np.dtype("u4").newbyteorder(dtype.byteorder))
        low, high = _SURROGATES
        if points.max() > 0x10FFFF or ((points >= low) & (points <= high)).any():
            raise NpzError(f"{info.filename} holds text that is not Unicode")
    return array


NPZ_FORMAT: Final = "tactile-recording"
NPZ_VERSION: Final = 1
MOST_NPZ_BYTES: Final = 1 << 31  # most bytes of the arrays that are read: a day of one sensor at 100 Hz
_REQUIRED: Final = ("format", "version", "sensor", "scan", "time_ns", "counts")
_ORIGINS: Final = ("origin", "source")
"""Arrays that hold the origin of the scans; `source` in older files, which have no `origin`."""
_POSES: Final = ("pose_time_ns", "pose", "pose_sensor", "pose_holds", "pose_used_from_ns")
_BASELINE: Final = ("baseline", "baseline_counts", "baseline_age_s")
_KINDS: Final = {"U": "text", "b": "truth values", "iu": "whole numbers", "f": "real numbers", "fiu": "numbers"}


def load_npz(path: Path) -> Recording:
    """Read an npz; of one that lost its end the arrays that are whole, which `notes` then report.

    Raises:
        RecordingError: it is no recording, or a value is impossible.
        OSError: the file cannot be read.
    """
    notes: list[str] = []
    cut_off = f"{path} is damaged: its end is missing, and only its whole arrays are read; copy it again"
    names = (*_REQUIRED, *_ORIGINS, *_POSES, "rate_hz", "mountings")
    arrays = _read(path, names, lambda: notes.append(cut_off))
    for name in _REQUIRED:
        if name not in arrays:
            lost = f"; {notes[0]}" if notes else ""
            raise RecordingError(f"{path}, array '{name}': missing, expected what `edge-sr convert` writes{lost}")
    form, version = arrays["format"], arrays["version"]
    if str(form) != NPZ_FORMAT:
        _refuse(path, "format", repr(str(form)[:40]), f"'{NPZ_FORMAT}'")
    if version.shape or version.dtype.kind not in "iu" or int(version) != NPZ_VERSION:
        _refuse(path, "version", str(version)[:40], f"{NPZ_VERSION}")
    counts = _checked_counts(path, arrays["counts"])
    for name, kinds in (("sensor", "U"), ("scan", "iu"), ("time_ns", "iu")):
        _check_array(path, name, arrays[name], kinds, counts.shape[:1])
    sensors = arrays["sensor"]
    tracks = tuple(
        Track(sensor, counts[mine], _times(path, sensor, arrays["time_ns"][mine]))
        for sensor in _sensors(path, sensors)
        for mine in [sensors == sensor]
    )
    rate = arrays.get("rate_hz")
    if rate is not None and (rate.shape or rate.dtype.kind not in "iuf" or not is_rate(float(rate))):
        _refuse(path, "rate_hz", str(rate)[:40], A_RATE)
    return Recording(
        path,
        tracks,
        None if rate is None else float(rate),
        _baselines(path, tracks, sensors),
        _mountings(path, arrays.get("mountings"), tracks),
        notes=tuple(notes),
        origin=_origin(path, arrays, len(counts)),
        poses=[] if notes and "pose" not in arrays else _poses(path, arrays),
    )


def _read(path: Path, names: Sequence[str], damaged: Callable[[], object]) -> dict[str, NDArray[Any]]:
    try:
        return read_npz(path, names, MOST_NPZ_BYTES, damaged)
    except NpzError as error:
        raise RecordingError(f"{path}: {error}") from error


def _baselines(path: Path, tracks: Sequence[Track], sensors: NDArray[np.str_]) -> dict[str, Baseline]:
    """Return the baselines of the first scan of each sensor, dated by the clock of the scans."""
    arrays = _read(path, _BASELINE, lambda: None)
    if len(arrays) < len(_BASELINE):
        return {}
    scan_shape = tracks[0].counts.shape[1:]
    for name, kinds, shape in zip(_BASELINE, "Uff", ((), scan_shape, ()), strict=True):
        _check_array(path, name, arrays[name], kinds, (len(sensors), *shape))
    ids, counts, ages_s = (arrays[name] for name in _BASELINE)
    baselines: dict[str, Baseline] = {}
    for track in tracks:
        first = int(np.argmax(sensors == track.sensor))
        own, text, age_s = counts[first].astype(np.float32), str(ids[first]), float(ages_s[first])
        if not text or track.time_ns is None:
            continue
        known = np.isnan(own) | ((own >= 0) & (own <= HIGHEST_COUNT + 1))
        if not known.all() or not is_sensor_name(text):
            _refuse(path, "baseline_counts", "others", f"0..{HIGHEST_COUNT + 1}, or none")
        own.setflags(write=False)
        taken_s = int(track.time_ns[0]) / NS_PER_S - (age_s if 0 <= age_s <= LAST_UNIX_S else math.nan)
        baselines[track.sensor] = Baseline(track.sensor, own, taken_s, 1, "file", text)
    return baselines


def _sensors(path: Path, sensors: NDArray[np.str_]) -> list[str]:
    names = list(dict.fromkeys(sensors.tolist()))
    if len(names) > MOST_SENSORS:
        _refuse(path, "sensor", f"{len(names)} sensors", f"at most {MOST_SENSORS}")
    for name in names:
        if not is_sensor_name(name):
            _refuse(path, "sensor", repr(name[:20]), f"names of 1 to {LONGEST_SENSOR_NAME} printable characters")
    return names


def _mountings(path: Path, text: NDArray[Any] | None, tracks: Sequence[Track]) -> dict[str, Mounting]:
    if text is None:
        return {}
    try:
        texts = json.loads(str(text))
        return {
            one.sensor: read_mounting(texts[one.sensor], one.counts[0, 0].size) for one in tracks if one.sensor in texts
        }
    except (ValueError, TypeError, RecursionError) as error:
        _refuse(path, "mountings", " ".join(str(error).split())[:120], "JSON as `edge-sr convert` writes it")


def _times(path: Path, sensor: str, times: NDArray[np.integer]) -> NDArray[np.int64]:
    if times.min() < 0 or times.max() > LAST_TIME_NS:
        _refuse(path, "time_ns", f"times {times.min()}..{times.max()}", f"0..{LAST_TIME_NS}")
    if (times[1:] < times[:-1]).any():  # not a difference, which wraps around
        _refuse(path, "time_ns", f"times of sensor {sensor!r} that go back", "times that never fall")
    return times.astype(np.int64)


def _checked_counts(path: Path, counts: NDArray[Any]) -> NDArray[np.int32]:
    shape = counts.shape
    grid = len(shape) == 4 and shape[1] == len(AXES) and 0 < shape[2] * shape[3] <= MOST_TAXELS
    if counts.dtype.kind not in "iu" or not grid or counts.size == 0:
        most = f"{MOST_TAXELS} taxels at most"
        expected = f"whole numbers of shape (scans, {len(AXES)}, rows, cols), {most}, at least one scan"
        _refuse(path, "counts", f"{counts.dtype} of shape {counts.shape}", expected)
    if counts.min() < ABSENT or counts.max() > HIGHEST_COUNT:
        got = f"counts {counts.min()}..{counts.max()}"
        _refuse(path, "counts", got, f"0..{HIGHEST_COUNT}, or {ABSENT} where a taxel is absent")
    absent = counts == ABSENT
    if (absent.any(axis=1) != absent.all(axis=1)).any():
        _refuse(path, "counts", "a taxel absent on some axes", "all of a taxel's axes absent or none")
    return counts.astype(np.int32)


def _origin(path: Path, arrays: Mapping[str, NDArray[Any]], scans: int) -> Literal["device", "emulated"] | None:
    for name in _ORIGINS:
        if name in arrays:
            _check_array(path, name, arrays[name], "U", (scans,))
            return origin_of(np.unique(arrays[name]).tolist())
    return None


def _poses(path: Path, arrays: Mapping[str, NDArray[Any]]) -> list[TimedPose]:
    found = {name: arrays[name] for name in _POSES if name in arrays}
    if not found:
        return []
    for name in _POSES[:2]:
        if name not in found:
            raise RecordingError(f"{path}, array '{name}': missing, expected together with '{next(iter(found))}'")
    count = found["pose_time_ns"].size
    for name, kinds in zip(_POSES, ("iu", "fiu", "U", "b", "iu"), strict=True):
        if name in found:
            _check_array(path, name, found[name], kinds, (count, len(POSE_FIELDS)) if name == "pose" else (count,))
    if count > MOST_POSES:
        _refuse(path, "pose", f"{count:,} poses", f"at most {MOST_POSES:,}: cut it in parts")
    sensors = found.get("pose_sensor", np.zeros(count, "U1")).tolist()
    if len(set(sensors)) > MOST_SENSORS + 1:
        _refuse(path, "pose_sensor", f"{len(set(sensors))} sensors", f"at most {MOST_SENSORS}")
    for name in set(sensors) - {""}:
        if not is_sensor_name(name):
            _refuse(path, "pose_sensor", repr(name[:20]), "the name of a sensor, or none")
    times_ns, used_ns = found["pose_time_ns"], found.get("pose_used_from_ns", np.full(count, -1))
    for name, times, low in (("pose_time_ns", times_ns, 0), ("pose_used_from_ns", used_ns, -1)):
        if count and not low <= times.min() <= times.max() <= LAST_TIME_NS:
            _refuse(path, name, f"times {times.min()}..{times.max()}", f"{low}..{LAST_TIME_NS}")
    holds = found.get("pose_holds", np.zeros(count, bool))
    rows = zip(
        *(array.tolist() for array in (found["pose"].astype(np.float64), times_ns, holds, used_ns)),
        sensors,
        strict=True,
    )
    try:
        return [
            TimedPose(PadPose(*values), time_ns, sensor or None, held, None if used_from_ns < 0 else used_from_ns)
            for values, time_ns, held, used_from_ns, sensor in rows
        ]
    except ValueError as error:
        raise RecordingError(f"{path}, array 'pose': {error}") from error


def _check_array(path: Path, name: str, array: NDArray[Any], kinds: str, shape: tuple[int, ...]) -> None:
    if array.dtype.kind not in kinds or array.shape != shape:
        _refuse(path, name, f"{array.dtype} of shape {array.shape}", f"{_KINDS[kinds]} of shape {shape}")


def _refuse(path: Path, name: str, got: str, expected: str) -> NoReturn:
    raise RecordingError(f"{path}, array '{name}': {' '.join(got.split())}, expected {expected}")
