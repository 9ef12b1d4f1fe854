"""Recordings of scans, read from disk: CSV rows, or what the npz sink wrote."""

import csv
import io
import re
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.errors import RecordingError
from firmware_bridge.geometry import AXES, USPA44
from firmware_bridge.scan import ABSENT
from firmware_bridge.schedule import NS_PER_S

NPZ_FORMAT: Final = "tactile-recording"
NPZ_VERSION: Final = 1
_NPZ_REQUIRED: Final = ("format", "version", "sensor", "scan", "time_ns", "counts")
HIGHEST_COUNT: Final = 0xFFFF

CSV_HEADER: Final = tuple(f"txl{taxel}_{axis}" for taxel in range(1, USPA44.taxel_count + 1) for axis in AXES)
_META_NAME: Final = "meta_data.csv"
_META_RATE: Final = "frequency_hz"
_WHOLE_NUMBER = re.compile(r"[0-9]{1,9}(\.0*)?")


@dataclass(frozen=True, slots=True)
class Track:
    """The scans of one sensor in a recording.

    Attributes:
        sensor: name of the sensor.
        counts: (n, 3, rows, cols) int32, ABSENT where a taxel gave no reading.
        time_ns: (n,) int64 monotonic time of each scan in [ns], never falling; None if not recorded.
    """

    sensor: str
    counts: NDArray[np.int32]
    time_ns: NDArray[np.int64] | None

    @property
    def mean_rate_hz(self) -> float | None:
        """Scans a second by the recorded times, or None."""
        if self.time_ns is None or self.time_ns[-1] <= self.time_ns[0]:
            return None
        return (len(self.time_ns) - 1) * NS_PER_S / float(self.time_ns[-1] - self.time_ns[0])


@dataclass(frozen=True, slots=True)
class Recording:
    """One file's tracks, at least one, each with at least one scan.

    Attributes:
        path: of the file.
        tracks: one per sensor, in the order in which they first occur.
        rate_hz: scans a second of each sensor; None if the file does not say.
    """

    path: Path
    tracks: tuple[Track, ...]
    rate_hz: float | None


def load_recording(path: str | Path) -> Recording:
    """Read a recording; its name's ending, .csv or .npz, says which form.

    Raises:
        RecordingError: the file cannot be read, or is not a recording.
    """
    path = Path(path)
    readers = {".csv": _load_csv, ".npz": _load_npz}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise RecordingError(f"{path}: a recording ends in .csv or .npz")
    try:
        return reader(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error


def _load_csv(path: Path) -> Recording:
    rows = _csv_rows(path)
    if not rows:
        _refuse(path, 1, "an empty file", "a header and rows of counts")
    _check_header(path, rows[0])
    if len(rows) == 1:
        _refuse(path, 2, "the end of the file", "a row of counts")
    values = [_count_row(path, line, row) for line, row in enumerate(rows[1:], 2)]
    taxels = np.array(values, dtype=np.int32).reshape(-1, USPA44.rows, USPA44.cols, len(AXES))
    counts = np.ascontiguousarray(taxels.transpose(0, 3, 1, 2))
    return Recording(path, (Track(path.stem, counts, time_ns=None),), _meta_rate_hz(path.with_name(_META_NAME)))


def _csv_rows(path: Path) -> list[list[str]]:
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        _refuse(path, data[: error.start].count(b"\n") + 1, f"byte {data[error.start]:#04x}", "UTF-8 text")
    # A number cut short is still a number: only the line end shows that the last row is whole.
    if text and not text.endswith("\n"):
        _refuse(path, text.count("\n") + 1, "a last line without its end", "a whole file: copy it again")
    try:
        return list(csv.reader(io.StringIO(text, newline=""), strict=True))
    except csv.Error as error:
        raise RecordingError(f"{path}: not CSV: {error}") from error


def _check_header(path: Path, header: list[str]) -> None:
    names = tuple(name.strip() for name in header)
    if names == CSV_HEADER:
        return
    if sorted(names) == sorted(CSV_HEADER):
        _refuse(
            path, 1, f"columns {', '.join(names[:4])}, ...", f"x, y, z of each taxel side by side: {_header_text()}"
        )
    _refuse(path, 1, f"{len(names)} columns: {', '.join(names[:4])}, ...", f"{len(CSV_HEADER)}: {_header_text()}")


def _header_text() -> str:
    return f"{', '.join(CSV_HEADER[:4])}, ..., {CSV_HEADER[-1]}"


def _count_row(path: Path, line: int, row: list[str]) -> list[int]:
    if len(row) != len(CSV_HEADER):
        _refuse(path, line, f"{len(row)} columns", f"{len(CSV_HEADER)}")
    return [_count(path, line, cell.strip()) for cell in row]


def _count(path: Path, line: int, cell: str) -> int:
    # Not float(): it takes nan, 1e4 and 1_0 as well.
    whole = int(cell.partition(".")[0]) if _WHOLE_NUMBER.fullmatch(cell) else None
    if whole is None or whole > HIGHEST_COUNT:
        _refuse(path, line, f"'{cell[:20]}'", f"a whole number 0..{HIGHEST_COUNT}")
    return whole


def _meta_rate_hz(path: Path) -> float | None:
    if not path.is_file():
        return None
    rows = _csv_rows(path)
    if not rows or _META_RATE not in rows[0]:
        return None
    column = rows[0].index(_META_RATE)
    cell = rows[1][column] if len(rows) > 1 and len(rows[1]) > column else ""
    try:
        rate_hz = float(cell)
    except ValueError:
        rate_hz = 0.0
    if not 0 < rate_hz < float("inf"):
        _refuse(path, 2, f"{_META_RATE} '{cell}'", "a positive number")
    return rate_hz


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
    tracks = []
    for sensor in dict.fromkeys(arrays["sensor"].tolist()):
        mine = arrays["sensor"] == sensor
        time_ns = arrays["time_ns"][mine].astype(np.int64)
        if (np.diff(time_ns) < 0).any():
            _refuse_array(path, "time_ns", f"times of sensor {sensor!r} that go back", "times that never fall")
        tracks.append(Track(str(sensor), counts[mine], time_ns))
    return Recording(path, tuple(tracks), _npz_rate_hz(path, arrays.get("rate_hz")))


def _npz_arrays(path: Path) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {}
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.lib.npyio.NpzFile):
            with loaded:
                arrays = {name: loaded[name] for name in (*_NPZ_REQUIRED, "rate_hz") if name in loaded}
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, NotImplementedError) as error:
        raise RecordingError(f"{path}: not a whole .npz archive of plain arrays: {error}") from error
    for name in _NPZ_REQUIRED:
        if name not in arrays:
            raise RecordingError(f"{path}, array '{name}': missing, expected what the npz sink writes")
    return arrays


def _check_npz_counts(path: Path, counts: NDArray[Any]) -> NDArray[np.int32]:
    if counts.dtype.kind not in "iu" or counts.ndim != 4 or counts.shape[1] != len(AXES) or counts.size == 0:
        expected = "whole numbers of shape (scans, 3, rows, cols), at least one scan"
        _refuse_array(path, "counts", f"{counts.dtype} of shape {counts.shape}", expected)
    if counts.min() < ABSENT or counts.max() > HIGHEST_COUNT:
        got = f"counts {counts.min()}..{counts.max()}"
        _refuse_array(path, "counts", got, f"0..{HIGHEST_COUNT}, or {ABSENT} where a taxel is absent")
    absent = counts == ABSENT
    if (absent.any(axis=1) != absent.all(axis=1)).any():
        _refuse_array(path, "counts", "a taxel absent on some axes", "all of a taxel's axes absent or none")
    return counts.astype(np.int32)


def _npz_rate_hz(path: Path, rate: NDArray[Any] | None) -> float | None:
    if rate is None:
        return None
    if rate.shape or rate.dtype.kind not in "iuf" or not 0 < float(rate) < float("inf"):
        _refuse_array(path, "rate_hz", str(rate)[:40], "a positive number")
    return float(rate)


def _refuse_array(path: Path, name: str, got: str, expected: str) -> NoReturn:
    raise RecordingError(f"{path}, array '{name}': {got}, expected {expected}")
