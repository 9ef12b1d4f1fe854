"""Recordings as CSV, as loggers and spreadsheets write them: one line for each scan of one sensor."""

import codecs
import csv
import itertools
import math
import re
from array import array
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from firmware_bridge.errors import RecordingError, harmless
from firmware_bridge.pad_geometry import AXES, PADS, USPA44, SensorGeometry
from firmware_bridge.poses import PadPose, TimedPose
from firmware_bridge.recording.tracks import A_RATE, Recording, Track, check_raw, is_rate
from firmware_bridge.scans.scan import HIGHEST_COUNT, VendorReading
from firmware_bridge.scans.xela_server_messages import HIGHEST_NEWTONS

CSV_POSES: Final = ("pose_x_mm", "pose_y_mm", "pose_turn_deg")
EMULATED: Final = "emulated"  # column of a recording of an emulated sensor, whatever its cells are
_TAXEL: Final = re.compile(r"(?P<force>force[ _])?(?:txl|taxel)?[ _]?0*(?P<taxel>[1-9][0-9]?)[ _]?(?P<axis>[xyz])")
_SENSORS: Final = {"sensor", "sensor_id", "sensor id", "sensor_name", "sensor name"}
_TIMES: Final = {"t", "time", "times", "timestamp", "timestamps", "stamp", "datetime", "clock", "epoch", "elapsed"}
_UNITS: Final = {
    word: per_second
    for words, per_second in (
        ("s sec secs second seconds", 1.0),
        ("ms msec msecs millis milliseconds", 1e3),
        ("us usec usecs micros microseconds", 1e6),
        ("ns nsec nsecs nanos nanoseconds", 1e9),
    )
    for word in words.split()
}
_WHOLE_NUMBER: Final = re.compile(r"[0-9]{1,9}(\.0*)?")
SHORTEST_PERIOD_S: Final = 0.0005  # of the scans of any sensor
MOST_CSV_BYTES: Final = 1 << 30  # most bytes of a CSV: some eight hours of one sensor at 100 Hz
LONGEST_PAUSE: Final = 1e5  # periods for which a gap in the times is waited at most: a clock may have been set
LONGEST_CSV_LINE: Final = 1 << 14  # most characters of a line: fifty times a row of counts


def csv_header(taxel_count: int = USPA44.taxel_count) -> tuple[str, ...]:
    """Return the columns of so many taxels, by default those of a uSPa44."""
    return tuple(f"txl{taxel}_{axis}" for taxel in range(1, taxel_count + 1) for axis in AXES)


class _Pace(NamedTuple):
    """Rate of scans in [Hz] by a column of times, or why there is none, and pauses (n,) before them, in periods."""

    rate_hz: float | None
    doubt: str
    pauses: NDArray[np.float64] | None = None

    def __str__(self) -> str:
        text = f"no rate: {self.doubt}" if self.rate_hz is None else f"{self.rate_hz:.4g} scans/s"
        if self.pauses is None:
            return text
        place, many = int(self.pauses.argmax()), int(np.count_nonzero(self.pauses))
        longest = self.pauses[place] + 1
        lasting = f"{longest:.4g} periods" if self.rate_hz is None else f"{longest / self.rate_hz:.4g} s"
        return f"{text}; before scan {place + 1} there is a gap of {lasting}" + (f", one of {many}" if many > 1 else "")


def _pace_of(name: str, times: ArrayLike) -> _Pace:
    """Return the pace of scans by their times (n,) in a column of this name."""
    values = np.asarray(times, dtype=np.float64)
    unread = np.flatnonzero(~np.isfinite(values))
    if unread.size:
        return _Pace(None, f"that of scan {unread[0] + 1} is neither a number nor a date and time")
    steps = np.diff(values)
    if not steps.any():
        return _Pace(None, "they never change" if steps.size else "there is one alone")
    named = [_UNITS[word] for word in _words(name) if word in _UNITS][-1:]
    # Rows that are closer together than the scans of any sensor were written in a burst.
    apart = steps[steps >= SHORTEST_PERIOD_S * min(named, default=1.0)]
    usual = float(np.percentile(apart if len(apart) > 1 else steps, 90))
    # A gap of ten usual steps says nothing about the rate.
    gaps = np.abs(steps) > (10 * usual if usual > 0 else np.inf)
    step = float(steps[~gaps].mean())
    pauses = np.concatenate([[0.0], np.where(gaps, np.abs(steps) / step - 1, 0.0)]) if gaps.any() and step > 0 else None
    if steps.min() < 0:
        return _Pace(None, f"they go back at scan {int(np.argmax(steps < 0)) + 2}", pauses)
    if not named and (steps == 1).all():
        return _Pace(None, "they may as well number the scans")
    # No period of a sensor in this range is usual in two units.
    units = [unit for unit in named or sorted(set(_UNITS.values())) if SHORTEST_PERIOD_S <= step / unit < 0.25]
    if units:
        return _Pace(units[-1] / step, "", pauses)
    unit = next((word for word, per_second in _UNITS.items() if [per_second] == named), "s, ms, us or ns")
    return _Pace(None, f"their mean step, {step:.4g} {unit}, is that of no sensor (4 to 2000 scans/s)", pauses)


def _taxels(pad: SensorGeometry) -> set[tuple[int, str]]:
    return {(taxel, axis) for taxel in range(1, pad.taxel_count + 1) for axis in AXES}


def _words(name: str) -> list[str]:
    return re.findall(r"[a-z]+", name.lower().replace("\u00b5", "u").replace("\u03bc", "u"))


class _Row(NamedTuple):
    """Cells of a line, without spaces around them and with decimal points; `whole` if the line has its end."""

    line: int
    cells: list[str]
    whole: bool


class _DamageError(Exception):
    """A line cannot be read, so that what follows is not read either."""

    def __init__(self, line: int, got: str, expected: str) -> None:
        super().__init__(f"line {line}: {got}, expected {expected}")


def load_csv(path: Path) -> Recording:
    """Read a CSV up to its end, or up to a damaged line, which `notes` then report."""
    scans = row = damaged = None
    try:
        for row in _rows(path):
            if scans is None:
                scans = _Scans(row.cells)
            else:
                scans.add(row)
    except _DamageError as damage:
        damaged = damage
    except RecordingError:
        raise
    except ValueError as error:
        raise RecordingError(f"{path}, line {row.line if row else 1}: {error}") from error
    if scans is None or not scans.count:
        empty = (
            "line 1: an empty file, expected a header and"
            if scans is None
            else "after its first line: no row, expected"
        )
        raise RecordingError(f"{path}, {damaged or empty + ' a row of counts'}")
    notes = []
    if damaged is not None:
        notes.append(f"{path} is damaged, {damaged}: only the {scans.count} scans before that are read")
    return scans.recording(path, notes)


class _Scans:
    """Scans of the rows so far, in columns: a list of rows would take ten times the memory of the file."""

    def __init__(self, header: Sequence[str]) -> None:
        """Sort the columns by their names."""
        counts: dict[tuple[int, str], int] = {}
        newtons: dict[tuple[int, str], int] = {}
        others: dict[str, int] = {}
        self._time_names: dict[int, str] = {}
        names = ["".join(char if char.isprintable() else "?" for char in name.strip()) for name in header]
        for column, name in enumerate(names):
            matched = _TAXEL.fullmatch(name.lower())
            if matched is not None:
                columns, key = newtons if matched["force"] else counts, (int(matched["taxel"]), matched["axis"])
                if key in columns:
                    raise ValueError(f"two columns {name[:20]!r}, expected each of them once")
                columns[key] = column
            elif _TIMES & set(_words(name)):
                self._time_names[column] = name
            elif name:
                others[name] = column
        self._pad = next((pad for pad in PADS if counts.keys() == _taxels(pad)), USPA44)
        wanted = _taxels(self._pad)
        if counts.keys() != wanted:
            shown = ", ".join(names)
            raise ValueError(
                f"{len(names)} columns: {shown[:60]}{'...' if len(shown) > 60 else ''}, expected a first line with "
                f"{len(wanted)}: txl1_x, txl1_y, txl1_z, txl2_x, ..., txl{self._pad.taxel_count}_z, of one sensor"
            )
        posed = [name for name in others if name.lower().startswith("pose")]
        if sorted(posed) not in ([], list(CSV_POSES[:2]), sorted(CSV_POSES)):
            raise ValueError(f"columns {', '.join(posed)[:60]}, expected {', '.join(CSV_POSES)}, or no poses")
        # Taxel by taxel, x, y and z each.
        self._count_columns = [counts[key] for key in sorted(wanted)]
        self._newton_columns = [newtons[key] for key in sorted(wanted)] if newtons.keys() == wanted else []
        self._pose_columns = [others[name] for name in CSV_POSES if name in others]
        self._emulated = EMULATED in others
        self._sensor_columns = [others[name] for name in others if name.lower() in _SENSORS]
        self._left_out = [name for name in others if name not in (*CSV_POSES, EMULATED)]
        self._width = max(place + 1 for place, name in enumerate(header) if name)
        self._counts = array("i")
        self._newtons = array("f")
        self._poses: list[TimedPose] = []
        self._times = {column: array("d") for column in self._time_names}
        self._before: list[str] = []
        self.count = 0

    def add(self, row: _Row) -> None:
        """Take one row; a _DamageError where it is damaged."""
        cells = row.cells
        _check_whole(row, self._width, self._before)
        for column in self._sensor_columns if self._before else ():
            if cells[column] != self._before[column]:
                both = f"sensor '{cells[column][:20]}' after '{self._before[column][:20]}'"
                raise ValueError(f"{both}, expected one sensor: cut the file in one for each")
        self._counts.extend(_count(cells[column]) for column in self._count_columns)
        self._newtons.extend(_number(cells[column]) for column in self._newton_columns)
        if any(cells[column] for column in self._pose_columns):
            try:
                pose = PadPose(*(_number(cells[column]) for column in self._pose_columns))
            except ValueError as error:
                raise ValueError(f"its pose: {error}") from error
            self._poses.append(TimedPose(pose, self.count, used_from_ns=self.count))
        for column, times in self._times.items():
            times.append(_time_s(cells[column]))
        self._before = cells
        self.count += 1

    def recording(self, path: Path, notes: list[str]) -> Recording:
        """Return the recording, with these notes and others."""
        paces = [_pace_of(self._time_names[column], times) for column, times in self._times.items()]
        pace = next((pace for pace in paces if pace.rate_hz is not None), paces[0] if paces else None)
        if pace is not None:
            notes.append(f"{path}: left out as times, which give {pace}: {_listed(self._time_names.values())}")
        if self._left_out:
            why = "none of a taxel, a time or a pose; if one is, rename it, such as txl1_x, time_s, pose_x_mm"
            notes.append(f"{path}: left out as {why}: {_listed(self._left_out)}")
        vendor = None
        if self._newtons:
            newtons = _by_axis(np.frombuffer(self._newtons, np.float32), self._pad)
            sound = np.abs(newtons).max(axis=(1, 2, 3)) <= HIGHEST_NEWTONS  # False of NaN
            vendor = tuple(VendorReading(force) if right else None for force, right in zip(newtons, sound, strict=True))
        counts = _by_axis(np.frombuffer(self._counts, np.int32), self._pad)
        check_raw(path, counts)
        return Recording(
            path,
            (Track(harmless(path.stem, kept=""), counts, time_ns=None, vendor=vendor),),
            (pace and pace.rate_hz) or _meta_rate_hz(path.with_name("meta_data.csv")),
            notes=tuple(notes),
            origin="emulated" if self._emulated else None,
            poses=self._poses,
            poses_by_row=True,
            pauses=None if pace is None or pace.pauses is None else np.minimum(pace.pauses, LONGEST_PAUSE),
        )


def _rows(path: Path) -> Iterator[_Row]:
    """Yield the rows that are not empty, each from one line; the first one is the header, and tells the separator."""
    read, separator = 0, None
    with path.open("rb") as file:
        start = file.read(2)
    utf16 = start in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)  # as Excel's "Unicode text"
    with path.open(encoding="utf-16" if utf16 else "utf-8-sig", errors="replace", newline="") as file:
        for number in itertools.count(1):
            line = file.readline(LONGEST_CSV_LINE + 1)
            if not line:
                return
            read += len(line)
            if read > MOST_CSV_BYTES:
                too_large = f"a file larger than {MOST_CSV_BYTES:,} bytes, expected a smaller one: cut it in parts"
                raise RecordingError(f"{path}, line {number}: {too_large}")
            if len(line) > LONGEST_CSV_LINE:
                raise _DamageError(number, f"a line longer than {LONGEST_CSV_LINE} bytes", "a row of counts")
            if "\ufffd" in line and separator is not None:  # a header may have a name in another encoding
                raise _DamageError(number, "bytes that are no UTF-8 text", "a row of counts")
            named = re.fullmatch(r'"?sep=(.)"?\s*', line) if separator is None else None
            if named is not None:
                separator = named[1]
                continue
            separator = separator or max(",;\t", key=line.count)
            try:
                cells = next(csv.reader([line], delimiter=separator, strict=True))
            except csv.Error as error:
                raise _DamageError(number, f"not CSV ({error})", "a row of counts") from error
            cells = [(cell if separator == "," else cell.replace(",", ".")).strip() for cell in cells]
            if any(cells):
                yield _Row(number, cells, line.endswith(("\n", "\r")))


def _check_whole(row: _Row, width: int, before: list[str]) -> None:
    """Raise a _DamageError where a row does not have `width` cells, or its last line was cut off within a number."""
    cells = row.cells[:width]
    if len(cells) < width or any(row.cells[width:]):
        raise _DamageError(row.line, f"{len(row.cells)} columns", f"{width}")
    unprintable = [cell for cell in cells if not cell.isprintable()]
    if unprintable:
        raise _DamageError(row.line, ascii(unprintable[0][:10]), "a row of counts")
    # A line without its end may be whole; a number that was cut off is still a number, and shorter.
    if not row.whole and before and len(cells[-1].lstrip("-")) < len(before[width - 1].lstrip("-")):
        raise _DamageError(row.line, f"a last line that ends in '{cells[-1][:20]}'", "its end: it seems cut off")


def _count(cell: str) -> int:
    # Not float(): it takes nan, 1e4 and 1_0 as well.
    whole = int(cell.partition(".")[0]) if _WHOLE_NUMBER.fullmatch(cell) else None
    if whole is None or whole > HIGHEST_COUNT:
        raise ValueError(f"'{cell[:20]}', expected a whole number 0..{HIGHEST_COUNT}")
    return whole


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _time_s(cell: str) -> float:
    """Return the number in a cell, or the seconds since 1970 of a date and time."""
    value = _number(cell)
    if math.isnan(value):
        try:
            return datetime.fromisoformat(cell).timestamp()
        except (ValueError, OverflowError, OSError):
            return math.nan
    return value


def _by_axis(values: NDArray[Any], geometry: SensorGeometry) -> NDArray[Any]:
    """Return values of rows as (n, 3, rows, cols)."""
    taxels = values.reshape(-1, geometry.taxel_count, len(AXES))
    return np.ascontiguousarray(taxels.transpose(0, 2, 1)).reshape(-1, *geometry.scan_shape)


def _meta_rate_hz(path: Path) -> float | None:
    if not path.is_file():
        return None
    try:
        rows = list(itertools.islice(_rows(path), 2))
    except _DamageError as damage:
        raise RecordingError(f"{path}, {damage}") from damage
    if not rows or "frequency_hz" not in rows[0].cells:
        return None
    column = rows[0].cells.index("frequency_hz")
    cell = rows[1].cells[column] if len(rows) > 1 and len(rows[1].cells) > column else ""
    rate_hz = _number(cell)
    if not is_rate(rate_hz):
        raise RecordingError(f"{path}, line 2: frequency_hz '{cell[:20]}', expected {A_RATE}")
    return rate_hz


def _listed(names: Iterable[str]) -> str:
    """Return the names of a few columns."""
    shown = [repr(name[:30]) for name in names]
    return ", ".join(shown[:6]) + (f" and {len(shown) - 6} more" if len(shown) > 6 else "")
