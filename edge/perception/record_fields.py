"""Table of the fields of a result, from which every output and, by `tests/docs/field_tables.py`, the pages are made.

A new field is one row here: in the JSON record, the npz and the ROS message, and with a `byte` in shared memory.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import Flag, auto
from functools import lru_cache, partial
from itertools import repeat
from operator import attrgetter, methodcaller
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.perception.result import REASON_TEXTS, NextTap, Result, Wrench, mask_bits
from firmware_bridge.poses import POSE_FIELDS, PadPose
from firmware_bridge.scans.scan import Scan, VendorReading
from firmware_bridge.zeroing.drift_tracker import Drift

Function = Callable[[Any], Any]
PLACE_IN_HEADER: Final = -1  # mark of a map in shared memory: its byte follows from the map's size


class Out(Flag):
    """Outputs that hold a field, in addition to shared memory, where a field has a byte."""

    RECORD = auto()  # of JSON, and with it zenoh, MCAP, the live page and, of a single value, ROS diagnostics
    NPZ = auto()  # arrays that `edge-sr convert` makes of a recording
    ROS = auto()  # members of tactile_edge_sr/msg/Result
    MAP = auto()  # next to the record: in lines of JSON, in packed messages and as grids of MCAP
    RECORD_NPZ = RECORD | NPZ
    RECORD_ROS = RECORD | ROS
    ALL = RECORD | NPZ | ROS
    NONE = 0


@dataclass(frozen=True, slots=True)
class Kind:
    """Type of a value in each output."""

    label: str  # in JSON
    array: str = ""  # numpy's, in npz
    packed: str = ""  # struct's character, in shared memory
    message: str = ""  # in ROS
    unknown: Any = None  # value for "unknown" in outputs without null; None where the value is always available
    # Of a choice, numbered in shared memory from 1, since 0 is memory that nobody wrote: their order is the format's.
    words: tuple[str, ...] = ()
    shape: str = ""  # of an array: "scan", "pattern", "deviation", "traction" or "poses", a row for each tap


class Column(NamedTuple):
    """One value to read: `make` makes it of an attribute that is not None; `unknown` stands for None."""

    attribute: str
    make: Function | None
    unknown: Any


class Columns:
    """Values of several fields of a result, read with one call for all plain attributes."""

    def __init__(self, columns: Iterable[Column]) -> None:
        columns = tuple(columns)
        self._get = attrgetter(*(column.attribute for column in columns))
        self._made = tuple((index, one.make) for index, one in enumerate(columns) if one.make is not None)
        self._unknown = tuple((index, one.unknown) for index, one in enumerate(columns) if one.unknown is not None)
        # From the last to the first, so that spreading out a vector does not move those still to come.
        self._vectors = tuple(index for index, unknown in reversed(self._unknown) if isinstance(unknown, tuple))

    def of(self, result: Result) -> list[Any]:
        """Return the values, in the order of the columns."""
        values = list(self._get(result))
        for index, make in self._made:
            if (value := values[index]) is not None:
                values[index] = make(value)
        for index, unknown in self._unknown:
            if values[index] is None:
                values[index] = unknown
        return values

    def flat(self, result: Result) -> list[Any]:
        """Return the values with each vector replaced by its components."""
        values = self.of(result)
        for index in self._vectors:
            values[index : index + 1] = values[index]
        return values


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a result, in every output that holds it."""

    name: str  # in every output; ends with the unit if it has one
    kind: Kind  # type of the value, or of each component of a vector
    attribute: str  # dotted path from the result to the attribute that the value is made of
    text: str  # description of the value, for the pages
    make: Function | None = None  # converts the attribute into the value, unless that is None; None takes it as it is
    decimals: int | None = None  # decimals of a number in JSON
    parts: tuple[str, ...] = ()  # names of a vector's components, for outputs that hold them one by one
    json: Function | None = None  # converts the attribute into the JSON value, if `make` and `decimals` do not
    out: Out = Out.ALL  # outputs that hold it
    byte: int | None = None  # its first byte in a half of shared memory. The layout only grows at its end.
    left_out: bool = False  # a record omits the key while the value is unknown

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the components, or the field's own."""
        return self.parts or (self.name,)

    def in_record(self) -> Column:
        """Return the column of the JSON record, with null for an unknown value."""
        make = self.make if self.json is None else self.json
        if self.decimals is not None:
            rounded = methodcaller("round" if self.kind.shape else "__round__", self.decimals)
            make = _then(make, partial(_rounded, decimals=self.decimals) if self.parts else rounded)
        return Column(self.attribute, make, None)

    def in_message(self) -> Column:
        """Return the column of ROS messages; a vector is a tuple."""
        unknown = self.kind.unknown
        return Column(self.attribute, self.make, (unknown,) * len(self.parts) if self.parts else unknown)

    def in_memory(self) -> Column:
        """Return the column of shared memory, as struct packs it; a vector is a tuple."""
        kind = self.kind
        if kind.words:
            numbers = {word: number for number, word in enumerate(kind.words, 1)}
            return Column(self.attribute, _then(self.make, numbers.__getitem__), None if kind.unknown is None else 0)
        if not kind.packed.endswith("s"):
            return self.in_message()
        most = int(kind.packed[:-1])  # the beginning of a text, never half a character
        return Column(self.attribute, lambda text: text.encode()[:most].decode(errors="ignore").encode(), None)


def _then(first: Function | None, second: Function) -> Function:
    """Chain two functions; the second is never called with None."""
    return second if first is None else lambda value: None if (made := first(value)) is None else second(made)


def _text(characters: int, packed_bytes: int) -> Kind:
    return Kind("text", f"<U{characters}", f"{packed_bytes}s", "string")


def _array(shape: str, unknown: float = math.nan) -> Kind:
    return Kind("array", "<f4", unknown=unknown, shape=shape)


def _one_of(*words: str, unknown: str | None = None) -> Kind:
    return Kind("text", f"<U{max(map(len, words))}", "i", "string", unknown, words)


_REAL: Final = Kind("number", "<f4", "d", "float64", math.nan)
_NUMBER: Final = Kind("integer", "<i8", "q", "int64")
_NUMBER_OR_NOT: Final = Kind("integer", "<i8", "q", "int64", -1)
_SMALL: Final = Kind("integer", "<i2", "i", "int32")
_SMALL_OR_NOT: Final = Kind("integer", "<i2", "i", "int32", -1)
_BITS: Final = Kind("integer", "<u8", "Q", "uint64")
_YES_OR_NO: Final = Kind("boolean", "|i1", "i", "int8", -1)
_IS_THERE: Final = Kind("boolean", "|b1", "i", "bool", False)
_TEXT: Final = Kind("text")
_OBJECT: Final = Kind("object")


def _there(_: object) -> bool:
    return True


def _readings(scan: Scan) -> NDArray[np.int32] | list[list[list[int | None]]]:
    if scan.complete:
        return np.ascontiguousarray(scan.counts)
    readings = scan.counts.astype(object)
    readings[:, ~scan.fresh] = None
    return readings.tolist()


def _temperature(vendor: VendorReading) -> float | None:
    return None if vendor.temperature_k is None else float(np.nanmean(vendor.temperature_k))


def _dead_bits(dead: Mapping[int, str]) -> int:
    return sum(1 << taxel for taxel in dead)


def _dead_reasons(dead: Mapping[int, str]) -> dict[str, str]:
    return dict(zip(map(str, dead), dead.values(), strict=True))


@lru_cache(maxsize=64)  # the same for many scans of a sensor in a row
def _drift(drift: Drift) -> dict[str, Any]:
    common = [round(counts, 2) for counts in drift.common_counts]
    return {"common": common, "own": round(drift.own_counts, 2), "step": round(drift.step_counts, 1)}


def _rounded(numbers: Iterable[float], decimals: int = 3) -> list[float]:
    return list(map(round, numbers, repeat(decimals)))


def _wrench(wrench: Wrench) -> dict[str, list[float] | None]:
    centre = wrench.centre_of_pressure_mm
    return {
        "force_n": list(map(round, wrench.force_n, repeat(4))),
        "torque_n_mm": list(map(round, wrench.torque_n_mm, repeat(3))),
        "centre_of_pressure_mm": None if centre is None else list(map(round, centre, repeat(3))),
    }


def _pose(pose: PadPose) -> dict[str, float]:
    return dict(zip(POSE_FIELDS, _rounded(_pose_numbers(pose), 4), strict=True))


def _next_tap(proposed: NextTap) -> dict[str, Any]:
    numbers = dict(zip(_NEXT_TAP_KEYS, _rounded(_next_tap_numbers(proposed)), strict=True))
    return numbers | {"target": None if proposed.target is None else _pose(proposed.target)}


def _poses(poses: NDArray[np.float32]) -> list[list[float]]:
    return [_rounded(row, 4) for row in poses.tolist()]


_pose_numbers: Final = attrgetter(*POSE_FIELDS)
_POSE_PARTS: Final = tuple(f"pose_{key}" for key in POSE_FIELDS)
_NEXT_TAP_KEYS: Final = ("dx_mm", "dy_mm", "turn_deg")
_next_tap_numbers: Final = attrgetter(*_NEXT_TAP_KEYS)

# Every field, in the order of the outputs but for shared memory, whose order is that of the bytes.
# fmt: off
FIELDS: Final = (
    Field("time_ns", _NUMBER, "scan.time_ns", "monotonic time of arrival (`CLOCK_MONOTONIC`)", byte=16),
    Field("sensor", _text(64, 256), "scan.sensor", "name of the sensor, such as its controller id",
          out=Out.RECORD_NPZ, byte=184),
    Field("scan", _NUMBER, "scan.number", "number of the scan, of this sensor", byte=24),
    Field("device_time_ns", _NUMBER_OR_NOT, "scan.device_ns",
          "when its last reading was on the bus, by the device's own time stamps on the same clock",
          out=Out.RECORD_NPZ, byte=32),
    Field("source", _one_of("device", "replay", "emulated"), "source",
          "kind of source: a robot acts on `device` alone", byte=48),
    Field("state", _one_of("zeroing", "incomplete", "idle", "contact", "dropped", "baseline_in_doubt"), "state",
          "`incomplete`: a taxel has not arrived yet, or more are dead than can be estimated; "
          "`baseline_in_doubt`: an old baseline or drift explains the readings as well as a touch; "
          "`dropped`: a newer scan was already waiting", byte=52),
    Field("model", _text(32, 64), "model", "name of the model; npz and shared memory cut a long one",
          byte=440),
    Field("fresh", _BITS, "scan.fresh", "bit i: taxel i (row-major from the top left) arrived in this scan",
          make=mask_bits, out=Out.RECORD, byte=88),
    Field("renewed", _BITS, "scan.renewed", "bit i: and differs from its reading before",
          make=mask_bits, out=Out.RECORD, byte=96),
    Field("contact", _YES_OR_NO, "contact", "whether something touches; unknown while the baseline is in doubt",
          byte=56),
    Field("taps_used", _SMALL, "taps_used", "taps that the pattern was made from", byte=60),
    Field("has_pattern", _IS_THERE, "pattern", "whether there is a pattern", make=_there, out=Out.NPZ, byte=64),
    Field("has_deviation", _IS_THERE, "deviation", "whether there is a deviation", make=_there, out=Out.NONE, byte=68),
    Field("has_traction", _IS_THERE, "traction", "whether there is a traction", make=_there, out=Out.NONE, byte=508),
    Field("force_counts", _REAL, "force_counts", "summed z over the baseline", decimals=1, byte=104),
    Field("force_n", _REAL, "force_n",
          "the same in newtons, with `--counts-per-newton`; else the vendor's z force, where its server gives one",
          decimals=4, byte=112),
    Field("area_mm2", _REAL, "area_mm2", "touched area", decimals=3, byte=120),
    Field("centroid_mm", _REAL, "centroid_mm", "centroid of the touched area, from the pad's centre, x right, y down",
          decimals=4, parts=("centroid_x_mm", "centroid_y_mm"), byte=128),
    Field("interval_mm", _REAL, "interval_mm",
          "how far off a touched pixel may be: half of the interval that holds the truth of 90 % of pixels, mean over "
          "the touched area", decimals=5, byte=144),
    Field("expected_rmse_mm", _REAL, "expected_rmse_mm",
          "RMS error, over all pixels, that patterns of the same uncertainty had on taps not trained on",
          decimals=5, byte=152),
    Field("another_tap", _YES_OR_NO, "another_tap", "whether another tap is expected to take away 2 % of the "
          "error; unknown where the model takes no further one", out=Out.RECORD_NPZ, byte=72),
    Field("next_tap", _REAL, "next_tap", "from the end of a tap to the next one: where to touch next, dx, dy in mm and "
          "turn in degrees from the newest tap's pad; records hold `target` too, the same pose in the object's plane; "
          "unknown without poses",
          make=_next_tap_numbers, parts=("next_tap_dx_mm", "next_tap_dy_mm", "next_tap_turn_deg"), json=_next_tap),
    Field("wrench", _REAL, "wrench", "force x, y, z on the pad in N, torque about x, y, z in N mm: see "
          "[Wrench](formats.md#wrench)",
          make=lambda wrench: wrench.force_n + wrench.torque_n_mm,
          parts=("force_x_n", "force_y_n", "force_z_n", "torque_x_n_mm", "torque_y_n_mm", "torque_z_n_mm"),
          json=_wrench, out=Out.RECORD_NPZ, byte=512),
    Field("centre_of_pressure_mm", _REAL, "wrench", "from the pad's centre, x right, y down; in records part of "
          "`wrench`", make=attrgetter("centre_of_pressure_mm"),
          parts=("centre_of_pressure_x_mm", "centre_of_pressure_y_mm"), out=Out.NPZ, byte=560),
    Field("wrench_origin", _one_of("nominal", "calibrated", unknown=""), "wrench_origin",
          "whether newtons are this sensor's own: see [Wrench](formats.md#wrench)", out=Out.RECORD_NPZ, byte=504),
    Field("shear_ratio", _REAL, "wrench", "tangential over normal force: an object slips where it reaches the "
          "coefficient of friction; needs no counts per newton", make=attrgetter("shear_ratio"), decimals=4, byte=576),
    Field("reused_from", _NUMBER_OR_NOT, "reused_from",
          "number of the scan whose pattern this is, where nothing has changed since", out=Out.RECORD_NPZ, byte=40),
    Field("trusted", _YES_OR_NO, "trusted", "whether the pattern is to be believed: see [Trust](trust.md); unknown for "
          "a contact that is too light to check, and for models without checks", byte=592),
    # Four bytes after it are free: an earlier release had a further word there.
    Field("untrusted_reason", replace(_one_of(*REASON_TEXTS, unknown=""), packed="i4x"), "untrusted_reason",
          "why not: see [the reasons](trust.md#the-reasons)", byte=596),
    Field("taps_dropped", _SMALL_OR_NOT, "taps_dropped", "earlier taps that the pattern is made "
          "without, because they do not belong to this contact; unknown without earlier taps",
          out=Out.RECORD_NPZ, byte=604),
    Field("mismatch", _REAL, "mismatch", "share of the readings' energy that the pattern does not explain, weighted by "
          "noise, gains and drift", decimals=4, byte=584),
    Field("tap_mismatch", _OBJECT, "tap_mismatch", "of each earlier tap, the newest first: how little it belongs to "
          "this contact, 0 to 1; from 0.5 it is left out", json=_rounded, out=Out.RECORD),
    Field("pose", _REAL, "pose", "pose of the pad at this scan in the object's plane: place, turn from x to y, and "
          "their standard deviations; unknown without poses", make=_pose_numbers, parts=_POSE_PARTS, json=_pose,
          out=Out.RECORD_ROS),
    Field("scan_pose", _REAL, "pose", "in records `pose`: x, y in mm, turn in degrees, and their standard deviations",
          make=_pose_numbers, parts=_POSE_PARTS, out=Out.NPZ),
    Field("poses", _array("poses"), "poses", "of each tap that the pattern is made from, newest first, its pad's "
          "pose as the newest tap's pad sees it: dx, dy in mm, turn in degrees, and their standard deviations; unknown "
          "for models that take no poses", json=_poses, out=Out.RECORD_NPZ),
    Field("run_time_us", _REAL, "run_time_us", "time of the inference, of all sensors in one call; unknown where the "
          "pattern was there already", decimals=1, byte=168),
    Field("latency_us", _REAL, "latency_us", "from the read that gave the scan's last byte to the pattern",
          decimals=1, byte=176),
    Field("baseline", Kind("text", "<U16", unknown=""), "baseline", "id of the baseline", make=attrgetter("id"),
          out=Out.RECORD_NPZ),
    Field("baseline_origin", _TEXT, "baseline", "`start-up`, `file` or `demand`; or from the "
          "recording that is played: `recording`, where its pad is free, and `unsure`, where it may hold something all "
          "the time", make=attrgetter("origin"),
          out=Out.RECORD),
    Field("baseline_age_s", _REAL, "baseline_age_s", "how old the baseline is; unknown where the clock was wrong when "
          "it was stored", decimals=1, byte=160),
    Field("drift_counts", _OBJECT, "drift", "followed since: `common` on x, y, z, and the largest of a taxel's `own` "
          "beyond it; `step`: the largest step in rest level that was not followed", json=_drift, out=Out.RECORD),
    Field("dead", _BITS, "dead", "dead taxels, whose readings are not used, and why: "
          "`{\"3\": \"stuck\", \"7\": \"silent\"}`, "
          "`saturated`, `far`, `unzeroed`; elsewhere bit i: taxel i. A pattern is then made without them",
          make=_dead_bits, json=_dead_reasons, out=Out.RECORD_NPZ, byte=80),
    Field("filled", _one_of("rest", "neighbours", unknown=""), "filled",
          "what stands for the dead taxels: an estimate from their `neighbours` "
          "(`rest` only by earlier releases); unknown while no "
          "taxel is dead, or no pattern can be made",
          out=Out.RECORD_NPZ, byte=76),
    Field("gains_certainty", _REAL, "gains_certainty", "how certain the gains of the sensor's channels are: 1 exact, "
          "0 as uncertain as those of a new sensor; unknown without gains", decimals=3, out=Out.RECORD_NPZ),
    Field("scale_error", _REAL, "scale_error", "by what share all newtons of this sensor may be off together: from "
          "its counts per newton to the farther end of their 90 % interval; unknown before it is zeroed, and where "
          "they were given without one", decimals=3, out=Out.RECORD_NPZ),
    Field("note", _TEXT, "note", "why there is no pattern, which reading is held, how old a reading is or may be, "
          "what is wrong with the baseline", out=Out.RECORD),
    Field("event", _TEXT, "event", "what happened before this scan: earlier taps forgotten, what came of zeroing "
          "again, a step in rest level", out=Out.RECORD),
    Field("vendor_force_n", _REAL, "scan.vendor_force_n", "force x, y, z on the pad by the vendor's server, while "
          "every taxel arrives; no such key without", decimals=4, parts=("x", "y", "z"), out=Out.RECORD,
          left_out=True),
    Field("temperature_k", _REAL, "scan.vendor", "mean of the sensor's thermometers by the vendor's server; no such "
          "key without", make=_temperature, decimals=2, out=Out.RECORD, left_out=True),
    Field("pattern_unit", _TEXT, "pattern_unit", "unit of the pattern and its deviation", out=Out.RECORD),
    Field("zeroed", _array("scan"), "zeroed", "counts over the baseline", out=Out.NONE, byte=PLACE_IN_HEADER),
    Field("counts", Kind("array", "<i4", unknown=-1, shape="scan"), "scan", "raw counts x, y, z, so that everything "
          "can be computed again; null in records, else -1, where a taxel gave no reading",
          make=attrgetter("counts"), json=_readings, out=Out.RECORD_NPZ,
          byte=PLACE_IN_HEADER),
    Field("pattern", _array("pattern", 0.0), "pattern", "surface deformation, in `pattern_unit`", decimals=7,
          out=Out.NPZ | Out.MAP, byte=PLACE_IN_HEADER),
    Field("deviation", _array("deviation", 0.0), "deviation", "standard deviation of each pixel of the pattern, "
          "where the model gives it", decimals=7, out=Out.NPZ | Out.MAP, byte=PLACE_IN_HEADER),
    Field("traction", _array("traction", 0.0), "traction", "force on the pad per area along x, y and z, in kPa, z "
          "into the pad, over the same face as the pattern, where the model gives it", decimals=4,
          out=Out.NPZ | Out.MAP, byte=PLACE_IN_HEADER),
    Field("baseline_counts", _array("scan"), "baseline", "what was subtracted, drift and all; NaN also where a "
          "taxel was not zeroed", make=attrgetter("counts"), out=Out.NPZ),
)
# fmt: on

MAPS: Final = tuple(field for field in FIELDS if Out.MAP in field.out)


def maps_of(result: Result) -> dict[str, NDArray[np.float32]]:
    """Return the maps of a result that accompany its record, by name."""
    maps = ((field.name, getattr(result, field.attribute)) for field in MAPS)
    return {name: values for name, values in maps if values is not None}
