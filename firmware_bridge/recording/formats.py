"""Recordings of scans, read from disk: CSV rows, or files of the sinks npz: and mcap:."""

import csv
import itertools
import math
import re
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.errors import NpzError, RecordingError, harmless
from firmware_bridge.pad_geometry import AXES, MOST_TAXELS, PADS, USPA44, SensorGeometry
from firmware_bridge.recording.csv_poses import CsvPoses
from firmware_bridge.recording.npz_poses import NPZ_POSES, npz_poses
from firmware_bridge.recording.npz_reader import read_npz
from firmware_bridge.recording.tracks import HIGHEST_COUNT, MOST_SENSORS, Recording, Track, origin_of
from firmware_bridge.scans.scan import ABSENT, LONGEST_SENSOR_NAME, is_sensor_name
from firmware_bridge.schedule import LAST_TIME_NS, NS_PER_S

if TYPE_CHECKING:
    from firmware_bridge.zeroing.baseline import Baseline

NPZ_FORMAT: Final = "tactile-recording"
NPZ_VERSION: Final = 1
_NPZ_REQUIRED: Final = ("format", "version", "sensor", "scan", "time_ns", "counts")
_NPZ_ORIGINS: Final = ("origin", "source")
"""Arrays that hold the origin of the scans; `source` in older files, which have no `origin`."""
_NPZ_BASELINE: Final = ("baseline", "baseline_counts", "baseline_age_s")

MOST_CSV_BYTES: Final = 1 << 30
"""Most bytes of a CSV: some eight hours of one sensor at 100 Hz."""
LONGEST_CSV_LINE_BYTES: Final = 1 << 14
"""Most bytes of a line: fifty times a row of counts."""
MOST_NPZ_BYTES: Final = 1 << 31
"""Most bytes of the arrays that are read: a day of one sensor at 100 Hz."""
RATES_HZ: Final = (1e-3, 1e5)
"""Lowest and highest rate, in [Hz]: beyond them periods in [ns] overflow, or become 0."""


def csv_header(taxel_count: int) -> tuple[str, ...]:
    """Return the columns of so many taxels."""
    return tuple(f"txl{taxel}_{axis}" for taxel in range(1, taxel_count + 1) for axis in AXES)


CSV_HEADER: Final = csv_header(USPA44.taxel_count)
_CSV_PADS: Final = {len(AXES) * pad.taxel_count: pad for pad in PADS}
"""Pads by the number of columns of a CSV, which does not name its pad."""
_META_NAME: Final = "meta_data.csv"
_META_RATE: Final = "frequency_hz"
_A_RATE: Final = f"a positive number, {RATES_HZ[0]:g} to {RATES_HZ[1]:g}"
_WHOLE_NUMBER = re.compile(r"[0-9]{1,9}(\.0*)?")


def load_recording(path: str | Path) -> Recording:
    """Read a recording; the ending of its name, .csv, .npz or .mcap, selects the format.

    Raises:
        RecordingError: the file cannot be read, or is not a recording.
    """
    path = Path(path)
    readers = {".csv": _load_csv, ".npz": _load_npz, ".mcap": _load_mcap}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise RecordingError(f"{path}: a recording ends in .csv, .npz or .mcap")
    try:
        recording = reader(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    if recording.origin != "emulated":
        return recording
    return replace(recording, notes=(*recording.notes, f"{path} was recorded from an emulated sensor"))


def _load_csv(path: Path) -> Recording:
    rows = _csv_rows(path)
    header = next(rows, None)
    if header is None:
        _refuse(path, 1, "an empty file", "a header and rows of counts")
    poses = CsvPoses([name.strip() for name in header])
    counts_end = len(header) - poses.columns
    pad = _pad_of_header(path, header[:counts_end])
    values = array("i")  # a list of rows would take ten times the memory of the file
    for line, row in enumerate(rows, 2):
        if len(row) != len(header):
            _refuse(path, line, f"{len(row)} columns", f"{len(header)}")
        values.extend(_count(path, line, cell.strip()) for cell in row[:counts_end])
        wrong = poses.add(line - 2, row[counts_end:])
        if wrong is not None:
            _refuse(path, line, f"'{wrong[:20]}'", "a number in each column of a pose, or none in all of them")
    if not values:
        _refuse(path, 2, "the end of the file", "a row of counts")
    taxels = np.frombuffer(values, dtype=np.int32).reshape(-1, pad.rows, pad.cols, len(AXES))
    counts = np.ascontiguousarray(taxels.transpose(0, 3, 1, 2))
    rate_hz = _meta_rate_hz(path.with_name(_META_NAME))
    try:
        return Recording(
            path, (Track(harmless(path.stem, kept=""), counts, time_ns=None),), rate_hz, poses=poses.poses()
        )
    except ValueError as error:
        raise RecordingError(f"{path}: its poses: {error}") from error


def _csv_rows(path: Path) -> Iterator[list[str]]:
    """Yield the rows, each from one line."""
    read_bytes = 0
    with path.open("rb") as file:
        for number in itertools.count(1):
            line = file.readline(LONGEST_CSV_LINE_BYTES + 1)
            read_bytes += len(line)
            if not line:
                return
            if len(line) > LONGEST_CSV_LINE_BYTES:
                _refuse(path, number, f"a line longer than {LONGEST_CSV_LINE_BYTES} bytes", "a row of counts")
            if read_bytes > MOST_CSV_BYTES:
                _refuse(path, number, f"a file larger than {MOST_CSV_BYTES:,} bytes", "a smaller one: cut it in parts")
            yield _csv_row(path, number, line)


def _csv_row(path: Path, number: int, line: bytes) -> list[str]:
    try:
        text = line.decode("utf-8-sig" if number == 1 else "utf-8")
    except UnicodeDecodeError as error:
        _refuse(path, number, f"byte {line[error.start]:#04x}", "UTF-8 text")
    # A truncated number is still a number: only the line end shows that the last row is whole.
    if not text.endswith("\n"):
        _refuse(path, number, "a last line without its end", "a whole file: copy it again")
    try:
        return next(csv.reader([text], strict=True))
    except csv.Error as error:
        raise RecordingError(f"{path}, line {number}: not CSV: {error}") from error


def _pad_of_header(path: Path, header: list[str]) -> SensorGeometry:
    names = tuple(name.strip() for name in header)
    pad = _CSV_PADS.get(len(names), USPA44)
    expected = csv_header(pad.taxel_count)
    if sorted(names) != sorted(expected):
        text = f"{len(expected)}: {_header_text(expected)}"
        _refuse(path, 1, f"{len(names)} columns: {', '.join(names[:4])[:60]}, ...", text)
    if names != expected:
        _refuse(
            path,
            1,
            f"columns {', '.join(names[:4])}, ...",
            f"x, y, z of each taxel side by side: {_header_text(expected)}",
        )
    return pad


def _header_text(header: tuple[str, ...]) -> str:
    return f"{', '.join(header[:4])}, ..., {header[-1]}"


def _count(path: Path, line: int, cell: str) -> int:
    # Not float(): it takes nan, 1e4 and 1_0 as well.
    whole = int(cell.partition(".")[0]) if _WHOLE_NUMBER.fullmatch(cell) else None
    if whole is None or whole > HIGHEST_COUNT:
        _refuse(path, line, f"'{cell[:20]}'", f"a whole number 0..{HIGHEST_COUNT}")
    return whole


def _meta_rate_hz(path: Path) -> float | None:
    if not path.is_file():
        return None
    rows = list(itertools.islice(_csv_rows(path), 2))
    if not rows or _META_RATE not in rows[0]:
        return None
    column = rows[0].index(_META_RATE)
    cell = rows[1][column] if len(rows) > 1 and len(rows[1]) > column else ""
    try:
        rate_hz = float(cell)
    except ValueError:
        rate_hz = 0.0
    if not _is_rate(rate_hz):
        _refuse(path, 2, f"{_META_RATE} '{cell[:20]}'", _A_RATE)
    return rate_hz


def _is_rate(rate_hz: float) -> bool:
    return RATES_HZ[0] <= rate_hz <= RATES_HZ[1]


def _refuse(path: Path, line: int, got: str, expected: str) -> NoReturn:
    raise RecordingError(f"{path}, line {line}: {got}, expected {expected}")


def _load_npz(path: Path) -> Recording:
    arrays = _npz_arrays(path)
    form, version = arrays["format"], arrays["version"]
    if str(form) != NPZ_FORMAT:
        _refuse_array(path, "format", repr(str(form)[:40]), f"'{NPZ_FORMAT}'")
    if version.shape or version.dtype.kind not in "iu" or int(version) != NPZ_VERSION:
        _refuse_array(path, "version", str(version)[:40], f"{NPZ_VERSION}")
    counts = _check_npz_counts(path, arrays["counts"])
    for name, kinds in (("sensor", "U"), ("scan", "iu"), ("time_ns", "iu")):
        array = arrays[name]
        if array.dtype.kind not in kinds or array.shape != counts.shape[:1]:
            kind = "text" if kinds == "U" else "whole numbers"
            _refuse_array(path, name, f"{array.dtype} of shape {array.shape}", f"{kind} of shape {counts.shape[:1]}")
    tracks = [
        Track(sensor, counts[mine], _npz_times(path, sensor, arrays["time_ns"][mine]))
        for sensor in _npz_sensors(path, arrays["sensor"])
        for mine in [arrays["sensor"] == sensor]
    ]
    return Recording(
        path,
        tuple(tracks),
        _npz_rate_hz(path, arrays.get("rate_hz")),
        origin=_npz_origin(path, arrays, len(counts)),
        poses=npz_poses(path, arrays),
    )


def _load_mcap(path: Path) -> Recording:
    from firmware_bridge.recording.mcap_reader import load_mcap  # imported here, since it loads the mcap package

    return load_mcap(path)


def npz_baselines(recording: Recording) -> "dict[str, Baseline]":
    """Return the baselines of the first scan of each sensor of an npz, dated by the clock of the scans.

    Raises:
        RecordingError: the values there cannot be a baseline.
    """
    from firmware_bridge.zeroing.baseline import (  # imported here, since most readers of a recording do not need it
        LAST_UNIX_S,
        Baseline,
    )

    path = recording.path
    try:
        arrays = read_npz(path, ("sensor", *_NPZ_BASELINE), MOST_NPZ_BYTES)
    except NpzError as error:
        raise RecordingError(f"{path}: {error}") from error
    if not all(name in arrays for name in _NPZ_BASELINE):
        return {}
    ids, counts, ages_s = (arrays[name] for name in _NPZ_BASELINE)
    scans = len(arrays["sensor"])
    scan_shape = recording.tracks[0].counts.shape[1:]
    for name, kind, shape in zip(_NPZ_BASELINE, "Uff", ((scans,), (scans, *scan_shape), (scans,)), strict=True):
        if arrays[name].dtype.kind != kind or arrays[name].shape != shape:
            _refuse_array(path, name, f"{arrays[name].dtype} of shape {arrays[name].shape}", f"shape {shape}")
    baselines: dict[str, Baseline] = {}
    for track in recording.tracks:
        first = int(np.argmax(arrays["sensor"] == track.sensor))
        own, text, age_s = counts[first].astype(np.float32), str(ids[first]), float(ages_s[first])
        if not text or track.time_ns is None:
            continue
        known = np.isnan(own) | ((own >= 0) & (own <= HIGHEST_COUNT + 1))
        if not known.all() or not is_sensor_name(text):
            _refuse_array(path, "baseline_counts", "others", f"0..{HIGHEST_COUNT + 1}, or none")
        own.setflags(write=False)
        taken_s = int(track.time_ns[0]) / NS_PER_S - (age_s if 0 <= age_s <= LAST_UNIX_S else math.nan)
        baselines[track.sensor] = Baseline(track.sensor, own, taken_s, 1, "file", text)
    return baselines


def _npz_arrays(path: Path) -> dict[str, NDArray[Any]]:
    try:
        arrays = read_npz(path, (*_NPZ_REQUIRED, *_NPZ_ORIGINS, *NPZ_POSES, "rate_hz"), MOST_NPZ_BYTES)
    except NpzError as error:
        raise RecordingError(f"{path}: {error}") from error
    for name in _NPZ_REQUIRED:
        if name not in arrays:
            raise RecordingError(f"{path}, array '{name}': missing, expected what the npz sink writes")
    return arrays


def _npz_sensors(path: Path, sensors: NDArray[np.str_]) -> list[str]:
    names = list(dict.fromkeys(sensors.tolist()))
    if len(names) > MOST_SENSORS:
        _refuse_array(path, "sensor", f"{len(names)} sensors", f"at most {MOST_SENSORS}")
    for name in names:
        if not is_sensor_name(name):
            _refuse_array(path, "sensor", repr(name[:20]), f"names of 1 to {LONGEST_SENSOR_NAME} printable characters")
    return names


def _npz_times(path: Path, sensor: str, times: NDArray[np.integer]) -> NDArray[np.int64]:
    if times.min() < 0 or times.max() > LAST_TIME_NS:
        _refuse_array(path, "time_ns", f"times {times.min()}..{times.max()}", f"0..{LAST_TIME_NS}")
    if (times[1:] < times[:-1]).any():  # not a difference, which wraps around
        _refuse_array(path, "time_ns", f"times of sensor {sensor!r} that go back", "times that never fall")
    return times.astype(np.int64)


def _check_npz_counts(path: Path, counts: NDArray[Any]) -> NDArray[np.int32]:
    shape = counts.shape
    grid = len(shape) == 4 and shape[1] == len(AXES) and 0 < shape[2] * shape[3] <= MOST_TAXELS
    if counts.dtype.kind not in "iu" or not grid or counts.size == 0:
        most = f"{MOST_TAXELS} taxels at most"
        expected = f"whole numbers of shape (scans, {len(AXES)}, rows, cols), {most}, at least one scan"
        _refuse_array(path, "counts", f"{counts.dtype} of shape {counts.shape}", expected)
    if counts.min() < ABSENT or counts.max() > HIGHEST_COUNT:
        got = f"counts {counts.min()}..{counts.max()}"
        _refuse_array(path, "counts", got, f"0..{HIGHEST_COUNT}, or {ABSENT} where a taxel is absent")
    absent = counts == ABSENT
    if (absent.any(axis=1) != absent.all(axis=1)).any():
        _refuse_array(path, "counts", "a taxel absent on some axes", "all of a taxel's axes absent or none")
    return counts.astype(np.int32)


def _npz_origin(path: Path, arrays: Mapping[str, NDArray[Any]], scans: int) -> Literal["device", "emulated"] | None:
    for name in _NPZ_ORIGINS:
        array = arrays.get(name)
        if array is None:
            continue
        if array.dtype.kind != "U" or array.shape != (scans,):
            _refuse_array(path, name, f"{array.dtype} of shape {array.shape}", f"text of shape {(scans,)}")
        return origin_of(np.unique(array).tolist())
    return None


def _npz_rate_hz(path: Path, rate: NDArray[Any] | None) -> float | None:
    if rate is None:
        return None
    if rate.shape or rate.dtype.kind not in "iuf" or not _is_rate(float(rate)):
        _refuse_array(path, "rate_hz", str(rate)[:40], _A_RATE)
    return float(rate)


def _refuse_array(path: Path, name: str, got: str, expected: str) -> NoReturn:
    raise RecordingError(f"{path}, array '{name}': {got}, expected {expected}")
