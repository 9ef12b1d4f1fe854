"""Recordings as npz, as other programs make them: arrays of raw counts with a row for each scan, and poses.

Nothing is unpickled, and no memory is allocated by an unchecked header.
"""

import io
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from math import prod
from pathlib import Path
from tokenize import TokenError
from typing import Any, Final, NoReturn

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from firmware_bridge.errors import CdrError, NpzError
from firmware_bridge.pad_geometry import AXES, MOST_TAXELS
from firmware_bridge.poses import POSE_FIELDS, TimedPose
from firmware_bridge.recording.tracks import (
    MOST_POSES,
    MOST_SENSORS,
    Recording,
    Track,
    check_raw,
    checked_pose,
    origin_of,
)
from firmware_bridge.scans.scan import ABSENT, HIGHEST_COUNT, LONGEST_SENSOR_NAME, is_sensor_name
from firmware_bridge.schedule import LAST_TIME_NS

LONGEST_READ_BYTES: Final = 1 << 20
"""Most bytes of one read: zipfile reads a table of contents in one piece, whose members could take gigabytes."""
_BROKEN: Final = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, ValueError, TypeError, LookupError, OverflowError),
    RuntimeError,  # encrypted, with an unsupported compression, or nested too deep
    *(SyntaxError, TokenError, MemoryError, Warning),  # errors that numpy's reader of the header passes on
)


def read_npz(path: Path, names: Iterable[str], most_bytes: int) -> dict[str, NDArray[Any]]:
    """Read the arrays of these names that are in the file, of `most_bytes` together; others are not read.

    Raises an NpzError for anything but a whole archive of plain arrays of numbers and text, or a larger one.
    """
    try:
        with (
            warnings.catch_warnings(),
            _ShortReads(io.FileIO(path)) as file,
            zipfile.ZipFile(file) as archive,
        ):
            warnings.simplefilter("error")  # numpy repairs headers of Python 2 with a warning, also for broken ones
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


class _ShortReads(io.BufferedReader):
    """File that refuses to read more than LONGEST_READ_BYTES in one piece."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > LONGEST_READ_BYTES:
            raise zipfile.BadZipFile(f"a piece of {size:,} bytes, expected at most {LONGEST_READ_BYTES:,}")
        return super().read(size)


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    # zipfile unpacks other compressions without a limit on the output of one piece.
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise NpzError(f"{info.filename} is compressed in another way than numpy's: save it again with numpy")
    with archive.open(info) as entry:
        version = npy.read_magic(entry)
        headers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        if version not in headers:
            raise NpzError(f"{info.filename} is of npy version {version}, expected (1, 0) or (2, 0)")
        shape, _, dtype = headers[version](entry)
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
        if points.max() > 0x10FFFF or ((points >= 0xD800) & (points <= 0xDFFF)).any():
            raise NpzError(f"{info.filename} holds text that is not Unicode")
    return array


NPZ_FORMAT: Final = "tactile-recording"
NPZ_VERSION: Final = 1
MOST_NPZ_BYTES: Final = 1 << 31  # most bytes of the arrays that are read: a day of one sensor at 100 Hz
_SCANS: Final = {"sensor": "U", "time_ns": "iu", "counts": "iu", "origin": "U"}
_POSES: Final = {"pose_time_ns": "iu", "pose": "fiu", "pose_sensor": "U", "pose_holds": "b"}
"""Arrays with a row for each scan, the last for each pose, and their kinds of numpy."""
_REQUIRED: Final = ("format", "version", "sensor", "time_ns", "counts")
_CONVERTED: Final = ("baseline_counts", "mountings", "source")
"""Arrays by which files that earlier releases wrote are known: readings would be wrong without what they hold."""
_KINDS: Final = {"U": "text", "b": "truth values", "iu": "whole numbers", "fiu": "numbers"}


def load_npz(path: Path) -> Recording:
    """Read an npz, or raise an NpzError without its name."""
    arrays = read_npz(path, (*_REQUIRED, *_SCANS, *_POSES, *_CONVERTED), MOST_NPZ_BYTES)
    if str(arrays.get("format", "missing")) != NPZ_FORMAT:
        got = repr(str(arrays.get("format", "missing"))[:40])
        _refuse("format", got, f"'{NPZ_FORMAT}'; of a converted file play the .mcap")
    for name in [name for name in _CONVERTED if name in arrays]:
        _refuse(name, "a file of an earlier release", "none: play its .mcap, or convert it to one with that release")
    for name in _REQUIRED:
        if name not in arrays:
            raise NpzError(f"array '{name}': missing, expected it beside {', '.join(_REQUIRED)}")
    version, counts = arrays["version"], arrays["counts"]
    if version.shape or version.dtype.kind not in "iu" or int(version) != NPZ_VERSION:
        _refuse("version", str(version)[:40], f"{NPZ_VERSION}")
    grid = counts.shape[1:]
    if len(grid) != 3 or grid[0] != len(AXES) or not 0 < grid[1] * grid[2] <= MOST_TAXELS or not counts.size:
        expected = f"(scans, {len(AXES)}, rows, cols), {MOST_TAXELS} taxels at most, at least one scan"
        _refuse("counts", f"shape {counts.shape}", expected)
    _check_arrays(arrays, _SCANS, len(counts), counts=grid)
    if counts.min() < ABSENT or counts.max() > HIGHEST_COUNT:
        got = f"counts {counts.min()}..{counts.max()}"
        _refuse("counts", got, f"0..{HIGHEST_COUNT}, or {ABSENT} where a taxel is absent")
    check_raw(f"{path}: array 'counts'", counts)
    origin = origin_of(np.unique(arrays.get("origin", np.empty(0))).tolist())
    return Recording(path, tuple(_tracks(arrays)), None, origin=origin, poses=_poses(arrays))


def _tracks(arrays: Mapping[str, NDArray[Any]]) -> Iterator[Track]:
    sensors = arrays["sensor"]
    names = list(dict.fromkeys(sensors.tolist()))
    if len(names) > MOST_SENSORS:
        _refuse("sensor", f"{len(names)} sensors", f"at most {MOST_SENSORS}")
    for name in names:
        if not is_sensor_name(name):
            _refuse("sensor", repr(name[:20]), f"names of 1 to {LONGEST_SENSOR_NAME} printable characters")
        times = arrays["time_ns"][sensors == name]
        if times.min() < 0 or times.max() > LAST_TIME_NS:
            _refuse("time_ns", f"times {times.min()}..{times.max()}", f"0..{LAST_TIME_NS}")
        if (times[1:] < times[:-1]).any():  # not a difference, which wraps around
            _refuse("time_ns", f"times of sensor {name!r} that go back", "times that never fall")
        yield Track(name, arrays["counts"][sensors == name].astype(np.int32), times.astype(np.int64))


def _poses(arrays: Mapping[str, NDArray[Any]]) -> list[TimedPose]:
    """Return the poses; other programs may leave out all but their times and numbers."""
    names = [name for name in _POSES if name in arrays]
    if not names:
        return []
    for name in ("pose_time_ns", "pose"):
        if name not in arrays:
            raise NpzError(f"array '{name}': missing, expected together with '{names[0]}'")
    count = arrays["pose_time_ns"].size
    if count > MOST_POSES:
        _refuse("pose", f"{count:,} poses", f"at most {MOST_POSES:,}: cut it in parts")
    _check_arrays(arrays, _POSES, count, pose=(len(POSE_FIELDS),))
    sensors = arrays.get("pose_sensor", np.zeros(count, "U1"))
    if len(np.unique(sensors)) > MOST_SENSORS + 1:
        _refuse("pose_sensor", f"{len(np.unique(sensors))} sensors", f"at most {MOST_SENSORS}")
    holds = arrays.get("pose_holds", np.zeros(count, bool))
    rows = (arrays["pose"].astype(np.float64), arrays["pose_time_ns"], holds, sensors)
    try:
        return [
            checked_pose(numbers, time_ns, rests, -1, sensor)
            for numbers, time_ns, rests, sensor in zip(*(array.tolist() for array in rows), strict=True)
        ]
    except CdrError as error:
        raise NpzError(f"array 'pose': {error}") from error


def _check_arrays(
    arrays: Mapping[str, NDArray[Any]], kinds: Mapping[str, str], rows: int, **of_a_row: tuple[int, ...]
) -> None:
    """Refuse arrays that are there, and not of these kinds, so many rows, and the shape of a row, else one value."""
    for name in filter(arrays.__contains__, kinds):
        array, shape = arrays[name], (rows, *of_a_row.get(name, ()))
        if array.dtype.kind not in kinds[name] or array.shape != shape:
            _refuse(name, f"{array.dtype} of shape {array.shape}", f"{_KINDS[kinds[name]]} of shape {shape}")


def _refuse(name: str, got: str, expected: str) -> NoReturn:
    raise NpzError(f"array '{name}': {' '.join(got.split())}, expected {expected}")
