"""Model of the sensor file: the properties of a sensor from its setup, in TOML that a person can read and edit.

This module holds its content and its reading; `toml_writer` writes it.
"""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.bounded_read import read_bounded
from firmware_bridge.errors import SensorFileError
from firmware_bridge.pad_geometry import AXES, SensorGeometry
from firmware_bridge.scans.can_id_maps import ID_MAPS, USPA44_MAP, ModelMap
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import GAIN_RANGE, PAD_RANGES, Pad
from firmware_bridge.scans.scan import LONGEST_SENSOR_NAME, is_sensor_name
from firmware_bridge.sensor_file.pad_frame import LARGEST_MM, PadFrame
from firmware_bridge.sensor_file.toml_reader import (
    REMEDY,
    Table,
    a_table,
    between,
    flat_cells,
    is_number,
    one_of,
    sensor_tables,
    text_value,
    truth,
    whole,
)
from firmware_bridge.zeroing.baseline import COUNTS_ON_CIRCLE, LAST_UNIX_S, Baseline

FILE_FORMAT: Final = "tactile-sensor"
FILE_VERSION: Final = 1
MOST_BYTES: Final = 1 << 16
"""Most bytes of a sensor file; a sensor takes 2 kB."""
LONGEST_LINE_BYTES: Final = 2048
"""Most bytes of a line, twice a line of all gains. The time of tomllib grows with the square of a key's dots: 60 kB
took 27 s."""
PARTS: Final = ("mounting", "force", "baseline", "gains")
"""Parts of an entry that can be marked as assumed, or as measured on an emulated sensor."""


@dataclass(frozen=True)
class SensorEntry:
    """Properties of one sensor.

    Attributes:
        mounting: mounting of the sensor.
        counts_per_newton: its summed z per [N].
        baseline: counts of its free pad.
        pad: constants and gains of the pad, measured or entered by hand.
        learned: its gains as a running sensor has learned them from contacts.
        assumed: those of PARTS that were never measured.
        emulated: those of PARTS that were measured on an emulated sensor.
        frame: place of the pad on the robot, entered by hand.
    """

    mounting: Mounting = field(default_factory=Mounting)
    counts_per_newton: float | None = None
    baseline: Baseline | None = None
    pad: Pad | None = None
    learned: Pad | None = None
    assumed: frozenset[str] = frozenset()
    emulated: frozenset[str] = frozenset()
    frame: PadFrame | None = None

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
    """Content of one sensor file.

    Attributes:
        model: name of the id map, one of ID_MAPS unless there is an `own_map`.
        adapter: serial number of the USB adapter; None if it is not available.
        sensors: entries by sensor name.
        own_map: id map outside ID_MAPS, for a program's own pad; files cannot hold it.
        path: file that it was read from; None without.
    """

    model: str = USPA44_MAP.name
    adapter: str | None = None
    sensors: Mapping[str, SensorEntry] = field(default_factory=dict)
    own_map: ModelMap | None = None
    path: Path | None = field(default=None, compare=False)

    @property
    def mountings(self) -> dict[str, Mounting]:
        """Mountings by sensor name."""
        return {name: entry.mounting for name, entry in self.sensors.items()}

    @property
    def orders(self) -> dict[str, tuple[int, ...]]:
        """Orders of the taxels by sensor name, for sensors that differ from the id map."""
        return {name: one.order for name, one in self.mountings.items() if one.moves_taxels}

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
        return {name: entry.baseline for name, entry in self.sensors.items() if entry.baseline is not None}

    @property
    def counts_per_newton(self) -> dict[str, float]:
        """Summed z per [N] by sensor name, where it is available."""
        known = {name: entry.counts_per_newton for name, entry in self.sensors.items()}
        return {name: counts for name, counts in known.items() if counts is not None}

    @property
    def frames(self) -> dict[str, PadFrame]:
        """Places of the pads on the robot by sensor name, where they are available."""
        return {name: entry.frame for name, entry in self.sensors.items() if entry.frame is not None}

    @property
    def measured_pads(self) -> dict[str, Pad]:
        """Pads without what was learned, by sensor name."""
        return {name: entry.pad for name, entry in self.sensors.items() if entry.pad is not None}

    @property
    def pads(self) -> dict[str, Pad]:
        """Pads in use by sensor name, with what was learned."""
        used = {name: entry.used_pad for name, entry in self.sensors.items()}
        return {name: pad for name, pad in used.items() if pad is not None}


def load_sensor_file(path: str | Path) -> SensorFile:
    """Read a sensor file.

    Raises:
        SensorFileError: the file cannot be read, or a value is invalid; the message names the key.
    """
    path = Path(path)
    try:
        content = read_bounded(path, MOST_BYTES)
        if max(map(len, content.splitlines()), default=0) > LONGEST_LINE_BYTES:
            raise ValueError(f"a line longer than {LONGEST_LINE_BYTES} bytes")
        document = tomllib.loads(content.decode())
    except OSError as error:
        raise SensorFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise SensorFileError(f"{path}: not TOML ({error}): {REMEDY}") from error
    top = Table(path, "", document)
    top.take("format", one_of(FILE_FORMAT))
    top.take("version", one_of(FILE_VERSION))
    model = top.take("model", one_of(*ID_MAPS))
    adapter = top.take("adapter", text_value, required=False)
    sensors = top.take("sensors", sensor_tables)
    for name in sensors:
        if not is_sensor_name(name):
            top.refuse("sensors", repr(name[:20]), f"names of 1 to {LONGEST_SENSOR_NAME} printable characters")
    top.end()
    entries = {name: _entry(path, name, table, ID_MAPS[model].geometry) for name, table in sensors.items()}
    return SensorFile(model, adapter, entries, path=path)


def _entry(path: Path, name: str, values: Mapping[str, Any], geometry: SensorGeometry) -> SensorEntry:
    table = Table(path, f"sensors.{name}.", values)
    order = table.take("order", partial(_order, geometry), required=False)
    swap_xy = table.take("swap_xy", truth, required=False)
    signs = table.take("signs", _signs, required=False)
    gains = table.take("gains", partial(_gains, geometry), required=False)
    counts_per_newton = table.take("counts_per_newton", between(*PAD_RANGES["counts_per_newton"]), required=False)
    pads = {key: table.take(key, a_table, required=False) for key in ("pad", "learned")}
    baseline = table.take("baseline", a_table, required=False)
    frame = table.take("frame", a_table, required=False)
    marks = {key: table.take(key, _parts, required=False) or frozenset() for key in ("assumed", "emulated")}
    table.end()
    known = {"order": order, "swap_xy": swap_xy, "signs": signs, "gains": gains}
    known = {key: value for key, value in known.items() if value is not None}
    mounting = Mounting(**known, taxel_count=geometry.taxel_count)
    pads = {key: None if one is None else _pad(path, f"{name}.{key}", one, geometry) for key, one in pads.items()}
    return SensorEntry(
        mounting,
        counts_per_newton,
        None if baseline is None else _baseline(path, name, baseline, geometry),
        pads["pad"],
        pads["learned"],
        marks["assumed"],
        marks["emulated"],
        None if frame is None else _frame(path, name, frame),
    )


def _pad(path: Path, name: str, values: Mapping[str, Any], geometry: SensorGeometry) -> Pad:
    table = Table(path, f"sensors.{name}.", values)
    constants: dict[str, float] = {}
    intervals: dict[str, tuple[float, float]] = {}
    for constant, (low, high) in PAD_RANGES.items():
        value = table.take(constant, between(low, high), required=False)
        interval = table.take(f"{constant}_interval", partial(_interval, low, high), required=False)
        if value is not None:
            constants[constant] = value
        if interval is not None:
            intervals[constant] = interval
    gains = table.take("gains", partial(_of_places, geometry, *GAIN_RANGE), required=False)
    widths = table.take("gain_half_widths", partial(_of_places, geometry, 0.0, 1.0), required=False)
    table.end()
    if widths is not None and gains is None:
        table.refuse("gain_half_widths", "without gains", "both, or none")
    return Pad(**constants, intervals=intervals, gains=gains, gain_half_widths=widths)


def _frame(path: Path, name: str, values: Mapping[str, Any]) -> PadFrame:
    table = Table(path, f"sensors.{name}.frame.", values)
    parent = table.take("parent", text_value)
    place_mm = table.take("place_mm", partial(_numbers, f"three numbers from -{LARGEST_MM:g} to {LARGEST_MM:g}", 3))
    quaternion = table.take("quaternion", partial(_numbers, "x, y, z, w of norm 1", 4), required=False)
    table.end()
    try:
        return PadFrame(parent, place_mm, **({} if quaternion is None else {"quaternion": quaternion}))
    except ValueError as error:
        return table.refuse("parent, place_mm and quaternion", str(error), "a frame of the robot and a place in it")


def _numbers(expected: str, count: int, value: Any) -> tuple[float, ...]:
    cells = flat_cells(value, (count,), expected)
    if not all(map(is_number, cells)):
        raise ValueError(expected)
    return tuple(map(float, cells))


def _baseline(path: Path, name: str, values: Mapping[str, Any], geometry: SensorGeometry) -> Baseline:
    table = Table(path, f"sensors.{name}.baseline.", values)
    expected_id = table.take("id", text_value, required=False)
    created_unix_s = table.take("created_unix_s", between(1, LAST_UNIX_S), required=False)
    scans = table.take("scans", whole)
    axes = [table.take(axis, partial(_rest_counts, geometry)) for axis in AXES]
    table.end()
    dated = math.nan if created_unix_s is None else created_unix_s
    baseline = Baseline.of(name, np.stack(axes), dated, scans, "file")
    if expected_id not in (None, baseline.id):
        table.refuse(
            "id", repr(expected_id), f"'{baseline.id}', which the counts give, or none; the baseline was changed"
        )
    return baseline


def _order(geometry: SensorGeometry, value: Any) -> tuple[int, ...]:
    expected = f"{geometry.rows} rows of {geometry.cols}, each of 0..{geometry.taxel_count - 1} once"
    cells = flat_cells(value, geometry.scan_shape[1:], expected)
    if not all(type(cell) is int for cell in cells) or sorted(cells) != list(range(geometry.taxel_count)):
        raise ValueError(expected)
    return tuple(cells)


def _parts(value: Any) -> frozenset[str]:
    if not isinstance(value, list) or not all(isinstance(one, str) and one in PARTS for one in value):
        raise ValueError(f"a list of {', '.join(PARTS)}")
    return frozenset(value)


def _signs(value: Any) -> tuple[int, ...]:
    expected = "1 or -1 for each of x, y, z"
    signs = flat_cells(value, (len(AXES),), expected)
    if not all(type(sign) is int and sign in (1, -1) for sign in signs):
        raise ValueError(expected)
    return tuple(signs)


def _gains(geometry: SensorGeometry, value: Any) -> tuple[float, ...]:
    expected = f"positive numbers, 3, or {len(AXES)} x {geometry.rows} x {geometry.cols}"
    per_taxel = isinstance(value, list) and any(isinstance(one, list) for one in value)
    cells = flat_cells(value, geometry.scan_shape if per_taxel else (len(AXES),), expected)
    if not all(is_number(cell) and cell > 0 for cell in cells):
        raise ValueError(expected)
    gains = [float(cell) for cell in cells]
    return tuple(gains if per_taxel else [gain for gain in gains for _ in range(geometry.taxel_count)])


def _interval(low: float, high: float, value: Any) -> tuple[float, float]:
    expected = f"two numbers from {low:g} to {high:g}, the lower first"
    ends = flat_cells(value, (2,), expected)
    if not (all(map(is_number, ends)) and low <= ends[0] <= ends[1] <= high):
        raise ValueError(expected)
    return ends[0], ends[1]


def _of_places(geometry: SensorGeometry, low: float, high: float, value: Any) -> tuple[float, ...]:
    count = len(AXES) * geometry.taxel_count
    expected = f"{count} numbers from {low:g} to {high:g}: x of all places, then y, then z"
    values = flat_cells(value, (count,), expected)
    if not all(is_number(one) and low <= one <= high for one in values):
        raise ValueError(expected)
    return tuple(map(float, values))


def _rest_counts(geometry: SensorGeometry, value: Any) -> NDArray[np.float64]:
    grid = geometry.scan_shape[1:]
    expected = f"{grid[0]} rows of {grid[1]} numbers 0..{COUNTS_ON_CIRCLE - 1}"
    cells = flat_cells(value, grid, expected)
    if not all(is_number(cell) and 0 <= cell < COUNTS_ON_CIRCLE for cell in cells):
        raise ValueError(expected)
    return np.array(cells, dtype=np.float64).reshape(grid)
