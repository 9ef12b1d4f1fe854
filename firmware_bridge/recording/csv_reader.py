"""Recordings as CSV, as loggers and spreadsheets write them: one line for each scan of one sensor."""

import csv
import itertools
import math
import re
from array import array
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from firmware_bridge.errors import RecordingError, harmless
from firmware_bridge.pad_geometry import AXES, PADS, USPA44, SensorGeometry
from firmware_bridge.poses import PadPose, TimedPose
from firmware_bridge.recording.tracks import HIGHEST_COUNT, RATES_HZ, Recording, Track

CSV_POSES: Final = ("pose_x_mm", "pose_y_mm", "pose_turn_deg")
EMULATED: Final = "emulated"  # column of a recording of an emulated sensor, whatever its cells are
_TAXEL: Final = re.compile(r"(?:txl|taxel)?[ _]?0*(?P<taxel>[1-9][0-9]?)[ _]?(?P<axis>[xyz])")
_TIMES: Final = {"t", "time", "timestamp"}
_PER_S: Final = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_USUAL_HZ: Final = (4.0, 2000.0)  # rates of sensors: another one shows that the times have another unit
_WHOLE_NUMBER: Final = re.compile(r"[0-9]{1,9}(\.0*)?")
MOST_CSV_BYTES: Final = 1 << 30  # most bytes of a CSV: some eight hours of one sensor at 100 Hz
LONGEST_CSV_LINE: Final = 1 << 14  # most characters of a line: fifty times a row of counts


def csv_header(taxel_count: int) -> tuple[str, ...]:
    """Return the columns of so many taxels."""
    return tuple(f"txl{taxel}_{axis}" for taxel in range(1, taxel_count + 1) for axis in AXES)


CSV_HEADER: Final = csv_header(USPA44.taxel_count)


def _rate_of(name: str, times: ArrayLike) -> float | None:
    """Return the rate in [Hz] by the times (n,) of a column: in the unit of its name, else in seconds.

    None where the times fall, or give no rate that a sensor can have.
    """
    steps = np.diff(np.asarray(times, dtype=np.float64))
    if not steps.size or not np.isfinite(steps).all() or steps.min() < 0:
        return None
    usual = float(np.percentile(steps, 90))
    # A gap of ten usual steps says nothing about the rate.
    step = float(steps[steps <= 10 * usual].mean() if usual else steps.mean())
    per_s = _per_s(name)
    rate_hz = (per_s or 1.0) / step if step else math.inf
    low, high = RATES_HZ if per_s else _USUAL_HZ
    return rate_hz if low <= rate_hz <= high else None


def _per_s(name: str) -> float | None:
    """Return how many of the unit in a column's name make a second; None where it states none."""
    return next((_PER_S[word] for word in _words(name) if word in _PER_S), None)


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
            "line 1: an empty file, expected a header" if scans is None else "after its first line: no row, expected"
        )
        raise RecordingError(f"{path}, {damaged or empty + ' a row of counts'}")
    notes = []
    if damaged is not None:
        notes.append(f"{path} is damaged, {damaged}: only the {scans.count} scans before that are read")
    return scans.recording(path, notes)


class _Scans:
    """Scans of the rows so far, in columns: a list of rows would take ten times the memory of the file.

    A ValueError states what was got of a line, and what was expected.
    """

    def __init__(self, header: Sequence[str]) -> None:
        """Sort the columns by their names."""
        counts: dict[tuple[int, str], int] = {}
        others: dict[str, int] = {}
        self._time_names: dict[int, str] = {}
        names = ["".join(char if char.isprintable() else "?" for char in name.strip()) for name in header]
        for column, name in enumerate(names):
            matched = _TAXEL.fullmatch(name.lower())
            if matched is not None:
                key = (int(matched["taxel"]), matched["axis"])
                if key in counts:
                    raise ValueError(f"two columns {name[:20]!r}, expected each of them once")
                counts[key] = column
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
        self._pose_columns = [others[name] for name in CSV_POSES if name in others]
        self._emulated = EMULATED in others
        self._left_out = [name for name in others if name not in (*CSV_POSES, EMULATED)]
        self._width = max(place + 1 for place, name in enumerate(header) if name)
        self._counts = array("i")
        self._poses: list[TimedPose] = []
        self._times = {column: array("d") for column in self._time_names}
        self._before: list[str] = []
        self.count = 0

    def add(self, row: _Row) -> None:
        """Take one row; a _DamageError where it is damaged."""
        cells = row.cells
        _check_whole(row, self._width, self._before)
        self._counts.extend(_count(cells[column]) for column in self._count_columns)
        if any(cells[column] for column in self._pose_columns):
            try:
                pose = PadPose(*(_number(cells[column]) for column in self._pose_columns))
            except ValueError as error:
                raise ValueError(f"its pose: {error}") from error
            self._poses.append(TimedPose(pose, self.count, used_from_ns=self.count))
        for column, times in self._times.items():
            times.append(_number(cells[column]))
        self._before = cells
        self.count += 1

    def recording(self, path: Path, notes: list[str]) -> Recording:
        """Return the recording, with these notes and others."""
        rates_hz = [_rate_of(self._time_names[column], times) for column, times in self._times.items()]
        rate_hz = next((rate for rate in rates_hz if rate is not None), None)
        if rates_hz and (rate_hz is None or not any(map(_per_s, self._time_names.values()))):
            by = "which give no rate" if rate_hz is None else f"which give {rate_hz:.4g} scans/s"
            notes.append(f"{path}: {_listed(self._time_names.values())} left out as times, {by}")
        if self._left_out:
            notes.append(
                f"{path}: {_listed(self._left_out)} left out as none of a taxel, a time or a pose; if one is, rename "
                "it, such as txl1_x, time_s, pose_x_mm"
            )
        taxels = np.frombuffer(self._counts, np.int32).reshape(-1, self._pad.taxel_count, len(AXES))
        counts = np.ascontiguousarray(taxels.transpose(0, 2, 1)).reshape(-1, *self._pad.scan_shape)
        return Recording(
            path,
            (Track(harmless(path.stem, kept=""), counts, time_ns=None),),
            rate_hz,
            notes=tuple(notes),
            origin="emulated" if self._emulated else None,
            poses=self._poses,
            poses_by_row=True,
        )


def _rows(path: Path) -> Iterator[_Row]:
    """Yield the rows that are not empty, each from one line; the first one is the header, and tells the separator."""
    read, separator = 0, None
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
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


def _listed(names: Iterable[str]) -> str:
    """Return "column a is" or "columns a, b are", with the names of a few."""
    shown = [repr(name[:30]) for name in names]
    text = ", ".join(shown[:6]) + (f" and {len(shown) - 6} more" if len(shown) > 6 else "")
    return f"column {text} is" if len(shown) == 1 else f"columns {text} are"
