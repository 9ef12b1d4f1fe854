"""Model of the sensor file and its reading: the properties of a sensor, in TOML that a person can read and edit."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from firmware_bridge.errors import SensorFileError
from firmware_bridge.in_place import read_bounded
from firmware_bridge.pad_geometry import AXES, SensorGeometry
from firmware_bridge.scans.can_id_maps import ID_MAPS, USPA44_MAP, ModelMap
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import GAIN_RANGE, PAD_RANGES, Pad
from firmware_bridge.scans.scan import LONGEST_SENSOR_NAME, is_sensor_name
from firmware_bridge.strict_table import (
    Table,
    a_table,
    between,
    cells,
    is_number,
    numbers,
    one_of,
    reader,
    text_value,
    truth,
    whole,
)
from firmware_bridge.zeroing.baseline import COUNTS_ON_CIRCLE, LAST_UNIX_S, Baseline

FILE_FORMAT: Final = "tactile-sensor"
FILE_VERSION: Final = 1
MOST_BYTES: Final = 1 << 16  # most bytes of a sensor file; a sensor takes 2 kB
LONGEST_LINE_BYTES: Final = 2048  # twice a line of all gains; tomllib's time grows with the square of a key's dots
_REMEDY: Final = "correct it, or write it again with edge-sr doctor --out"
PARTS: Final = ("mounting", "force", "baseline", "gains")  # that can be marked as assumed, or as emulated
LARGEST_MM: Final = 1e5


@dataclass(frozen=True)
class PadFrame:
    """Place of a pad in a frame of the robot: the middle of its face, x to the right, y down, z into the pad."""

    parent: str  # name of the robot's frame, such as "tool0"
    place_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the middle of the face in the parent
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)  # from the parent's axes to the pad's

    def __post_init__(self) -> None:
        if not self.parent or self.parent.startswith("/") or not self.parent.isprintable() or " " in self.parent:
            raise ValueError(f"parent is {self.parent[:40]!r}, expected the name of a frame such as tool0")
        if len(self.place_mm) != 3 or not all(abs(place) <= LARGEST_MM for place in self.place_mm):
            raise ValueError(f"place_mm is {self.place_mm}, expected three numbers up to {LARGEST_MM:g}")
        if len(self.quaternion) != 4 or not abs(math.hypot(*self.quaternion) - 1) <= 1e-3:
            raise ValueError(f"quaternion is {self.quaternion}, expected x, y, z, w of norm 1")


def with_scale(pad: Pad | None, counts_per_newton: float | None, interval: tuple[float, float] | None) -> Pad | None:
    """Return a pad with its sensor's counts per newton, and their 90 % interval, where it has none of its own."""
    if counts_per_newton is None or (pad is not None and pad.counts_per_newton is not None):
        return pad
    pad = pad or Pad()
    intervals = {name: ends for name, ends in pad.intervals.items() if name != "counts_per_newton"}
    own = {} if interval is None else {"counts_per_newton": interval}
    return replace(pad, counts_per_newton=counts_per_newton, intervals=intervals | own)


@dataclass(frozen=True)
class SensorEntry:
    """Properties of one sensor."""

    mounting: Mounting = field(default_factory=Mounting)  # mounting of the sensor
    counts_per_newton: float | None = None  # its summed z per [N]
    baseline: Baseline | None = None  # counts of its free pad
    pad: Pad | None = None  # constants and gains of the pad, measured or entered by hand
    learned: Pad | None = None  # its gains as a running sensor has learned them from contacts
    assumed: frozenset[str] = frozenset()  # those of PARTS that were never measured
    emulated: frozenset[str] = frozenset()  # those of PARTS that were measured on an emulated sensor
    frame: PadFrame | None = None  # place of the pad on the robot, entered by hand
    counts_per_newton_interval: tuple[float, float] | None = None  # 90 % interval of the counts per newton

    @property
    def used_pad(self) -> Pad | None:
        """Pad with what was learned where that is not there by hand, and with learned gains that are surer."""
        learned, pad = self.learned, self.pad
        if learned is None or pad is None:
            return learned or pad
        if pad.gains_certainty < learned.gains_certainty:
            pad = replace(pad, gains=None, gain_half_widths=None)
        return learned.behind(pad)


@dataclass(frozen=True)
class SensorFile:
    """Content of one sensor file."""

    model: str = USPA44_MAP.name  # name of the id map, one of ID_MAPS unless there is an `own_map`
    adapter: str | None = None  # serial number of the USB adapter; None if it is not available
    sensors: Mapping[str, SensorEntry] = field(default_factory=dict)  # entries by sensor name
    own_map: ModelMap | None = None  # id map outside ID_MAPS, for a program's own pad; files cannot hold it
    path: Path | None = field(default=None, compare=False)  # file that it was read from; None without

    @property
    def mountings(self) -> dict[str, Mounting]:
        """Mountings by sensor name."""
        return self._by_sensor("mounting")

    @property
    def orders(self) -> dict[str, tuple[int, ...]]:
        """Orders of the taxels by sensor name, for sensors that differ from the id map."""
        return {name: mounting.order for name, mounting in self.mountings.items() if mounting.moves_taxels}

    @property
    def model_map(self) -> ModelMap:
        """Id map of the sensors."""
        return ID_MAPS[self.model] if self.own_map is None else self.own_map

    @property
    def geometry(self) -> SensorGeometry:
        """Geometry of each sensor's pad."""
        return self.model_map.geometry

    @property
    def baselines(self) -> dict[str, Baseline]:
        """Available baselines by sensor name."""
        return self._by_sensor("baseline")

    @property
    def counts_per_newton(self) -> dict[str, float]:
        """Summed z per [N] by sensor name, where it is available."""
        return self._by_sensor("counts_per_newton")

    @property
    def scale_intervals(self) -> dict[str, tuple[float, float]]:
        """90 % intervals of the counts per newton by sensor name, where they are available."""
        return self._by_sensor("counts_per_newton_interval")

    @property
    def frames(self) -> dict[str, PadFrame]:
        """Places of the pads on the robot by sensor name, where they are available."""
        return self._by_sensor("frame")

    @property
    def measured_pads(self) -> dict[str, Pad]:
        """Pads without what was learned, by sensor name."""
        return self._by_sensor("pad")

    @property
    def pads(self) -> dict[str, Pad]:
        """Pads in use by sensor name, with what was learned."""
        return self._by_sensor("used_pad")

    def _by_sensor(self, name: str) -> dict[str, Any]:
        values = {sensor: getattr(entry, name) for sensor, entry in self.sensors.items()}
        return {sensor: value for sensor, value in values.items() if value is not None}


def load_sensor_file(path: str | Path) -> SensorFile:
    """Read a sensor file, or raise a SensorFileError that names the key."""
    path = Path(path)
    try:
        content = read_bounded(path, MOST_BYTES)
        if max(map(len, content.splitlines()), default=0) > LONGEST_LINE_BYTES:
            raise ValueError(f"a line longer than {LONGEST_LINE_BYTES} bytes")
        document = tomllib.loads(content.decode())
    except OSError as error:
        raise SensorFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise SensorFileError(f"{path}: not TOML ({error}): {_REMEDY}") from error
    top = Table(path, "", document, SensorFileError, _REMEDY)
    top.take("format", one_of(FILE_FORMAT))
    top.take("version", one_of(FILE_VERSION))
    model = top.take("model", one_of(*ID_MAPS))
    adapter = top.take("adapter", text_value, required=False)
    sensors = top.take("sensors", _sensor_tables)
    top.end()
    entries = {
        name: _entry(top.part(f"sensors.{name}", table), name, ID_MAPS[model].geometry)
        for name, table in sensors.items()
    }
    return SensorFile(model, adapter, entries, path=path)


def _sensor_tables(value: Any) -> dict[str, dict[str, Any]]:
    if not isinstance(value, dict) or not value or not all(isinstance(table, dict) for table in value.values()):
        raise ValueError("a table for each sensor, such as [sensors.4]")
    if not all(map(is_sensor_name, value)):
        raise ValueError(f"names of 1 to {LONGEST_SENSOR_NAME} printable characters")
    return value


def _entry(table: Table, name: str, geometry: SensorGeometry) -> SensorEntry:
    grid, taxels = geometry.scan_shape[1:], list(range(geometry.taxel_count))
    places = f"{grid[0]} rows of {grid[1]}, each of 0..{taxels[-1]} once"
    parts = {"pad": _pad, "learned": _pad, "baseline": _baseline, "frame": _frame}
    readers = {
        "order": cells(grid, lambda all_: set(map(type, all_)) == {int} and sorted(all_) == taxels, places),
        "swap_xy": truth,
        "signs": cells((len(AXES),), _are_signs, "1 or -1 for each of x, y, z"),
        "counts_per_newton": between(*PAD_RANGES["counts_per_newton"]),
        "counts_per_newton_interval": partial(_interval, *PAD_RANGES["counts_per_newton"]),
        **dict.fromkeys(("assumed", "emulated"), _marks),
        **dict.fromkeys(parts, a_table),
        "gains": reader(_are_ones, "1 for each, or none: how strongly each place reads is [sensors.NAME.pad] gains"),
    }
    taken = {key: table.take(key, read, required=False) for key, read in readers.items()}
    table.end()
    values = {key: value for key, value in taken.items() if value is not None and key != "gains"}
    _check_around(table, "counts_per_newton", values, values.get("counts_per_newton_interval"))
    mounting = {key: values.pop(key) for key in ("order", "swap_xy", "signs") if key in values}
    for key, read in parts.items():
        if key in values:
            values[key] = read(table.part(key, values[key]), name, geometry)
    return SensorEntry(Mounting(**mounting, taxel_count=geometry.taxel_count), **values)


def _pad(table: Table, sensor: str, geometry: SensorGeometry) -> Pad:
    constants: dict[str, float | None] = {}
    intervals: dict[str, tuple[float, float] | None] = {}
    for name, (low, high) in PAD_RANGES.items():
        constants[name] = table.take(name, between(low, high), required=False)
        intervals[name] = table.take(f"{name}_interval", partial(_interval, low, high), required=False)
    count = len(AXES) * geometry.taxel_count
    places: dict[str, Any] = {}
    for name, (low, high) in (("gains", GAIN_RANGE), ("gain_half_widths", (0.0, 1.0))):
        expected = f"{count} numbers from {low:g} to {high:g}: x of all places, then y, then z"
        places[name] = table.take(name, numbers((count,), expected, low, high), required=False)
    table.end()
    if places["gains"] is None and places["gain_half_widths"] is not None:
        table.refuse("gain_half_widths", "without gains", "both, or none")
    stated = {name: ends for name, ends in intervals.items() if ends is not None}
    for name, ends in stated.items():
        if constants[name] is not None:
            _check_around(table, name, constants, ends)
    return Pad(**constants, intervals=stated, **places)


def _check_around(
    table: Table, name: str, values: Mapping[str, float | None], ends: tuple[float, float] | None
) -> None:
    value = values.get(name)
    if ends is not None and not (value is not None and ends[0] <= value <= ends[1]):
        given = f"{list(ends)} of {f'no {name}' if value is None else value}"
        table.refuse(f"{name}_interval", given, f"an interval around {name}")


def _frame(table: Table, sensor: str, geometry: SensorGeometry) -> PadFrame:
    parent = table.take("parent", text_value)
    place_mm = table.take("place_mm", numbers((3,), f"three numbers from -{LARGEST_MM:g} to {LARGEST_MM:g}"))
    quaternion = table.take("quaternion", numbers((4,), "x, y, z, w of norm 1"), required=False)
    table.end()
    try:
        return PadFrame(parent, place_mm, **({} if quaternion is None else {"quaternion": quaternion}))
    except ValueError as error:
        return table.refuse("parent, place_mm and quaternion", str(error), "a frame of the robot and a place in it")


def _baseline(table: Table, sensor: str, geometry: SensorGeometry) -> Baseline:
    expected_id = table.take("id", text_value, required=False)
    created_unix_s = table.take("created_unix_s", between(1, LAST_UNIX_S), required=False)
    scans = table.take("scans", whole)
    grid = geometry.scan_shape[1:]
    expected = f"{grid[0]} rows of {grid[1]} numbers 0..{COUNTS_ON_CIRCLE - 1}"
    read = numbers(grid, expected, 0, math.nextafter(COUNTS_ON_CIRCLE, 0))
    counts = np.array([table.take(axis, read) for axis in AXES]).reshape(geometry.scan_shape)
    table.end()
    dated = math.nan if created_unix_s is None else created_unix_s
    baseline = Baseline.of(sensor, counts, dated, scans, "file")
    if expected_id not in (None, baseline.id):
        table.refuse(
            "id", repr(expected_id), f"'{baseline.id}', which the counts give, or none; the baseline was changed"
        )
    return baseline


def _marks(value: Any) -> frozenset[str]:
    if not isinstance(value, list) or not all(isinstance(mark, str) and mark in PARTS for mark in value):
        raise ValueError(f"a list of {', '.join(PARTS)}")
    return frozenset(value)


def _are_signs(signs: list[Any]) -> bool:
    return all(type(sign) is int and sign in (1, -1) for sign in signs)


def _are_ones(value: Any) -> bool:
    """Return whether lists hold nothing but 1, as the gains that earlier releases wrote into every file."""
    return all(map(_are_ones, value)) if isinstance(value, list) else value == 1


def _interval(low: float, high: float, value: Any) -> tuple[float, ...]:
    expected = f"two numbers from {low:g} to {high:g}, the lower first"
    ends = cells((2,), lambda both: all(is_number(end, low, high) for end in both) and both[0] <= both[1], expected)
    return ends(value)
