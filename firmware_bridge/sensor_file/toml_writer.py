"""Writer of the sensor file, in which a pad's numbers have the same arrangement as on the pad."""

import fcntl
import json
import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from firmware_bridge.errors import SensorFileError
from firmware_bridge.in_place import write_in_place
from firmware_bridge.pad_geometry import AXES
from firmware_bridge.scans.can_id_maps import ID_MAPS
from firmware_bridge.scans.pad_constants import PAD_RANGES, Pad
from firmware_bridge.sensor_file.model import (
    FILE_FORMAT,
    FILE_VERSION,
    PARTS,
    SensorEntry,
    SensorFile,
    load_sensor_file,
)

LOCKED_S: Final = 5.0  # longest wait for another program that changes the file, in [s]: changing it takes milliseconds


@contextmanager
def changing(path: str | Path) -> Iterator[None]:
    """Change a sensor file within a with statement, from its reading to its writing, while no other program does.

    The lock is on the folder, since the file is replaced by a new one each time. Where a file system has no locks, none
    is taken. Raises SensorFileError where another program holds it for LOCKED_S.
    """
    try:
        folder = os.open(Path(path).parent, os.O_RDONLY)
    except OSError:  # a folder that is missing or closed, which reading or writing reports
        yield
        return
    try:
        end_s = time.monotonic() + LOCKED_S
        while True:
            try:
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if time.monotonic() >= end_s:
                    raise SensorFileError(f"{path}: another program has kept it locked for {LOCKED_S:g} s") from error
                time.sleep(0.01)
            except OSError:
                break
        yield
    finally:
        os.close(folder)


def save_sensor_file(path: str | Path, sensor_file: SensorFile, *, keep_before: bool = True) -> None:
    """Write a sensor file in place, or raise a SensorFileError; the one before stays as NAME.bak, if wanted."""
    path = Path(path)
    if not sensor_file.sensors:
        raise SensorFileError(f"{path}: not written, because nothing was measured: correct the findings first")
    for name, entry in sensor_file.sensors.items():
        if entry.baseline is not None and np.isnan(entry.baseline.counts).any():
            raise SensorFileError(
                f"{path}: a taxel of sensor {name} was silent while zeroing: zero again when it is not"
            )
    if sensor_file.own_map is not None:
        raise SensorFileError(
            f"{path}: not written, because no file can name the id map {sensor_file.model!r} of a program's own: "
            f"expected one of {', '.join(ID_MAPS)}"
        )
    text = _text(sensor_file)
    try:
        write_in_place(
            path, lambda draft: draft.write_text(text, encoding="utf-8"), load_sensor_file, keep_before=keep_before
        )
    except OSError as error:
        raise SensorFileError(f"{path}: cannot be written: {error.strerror or error}") from error


def _text(sensor_file: SensorFile) -> str:
    lines = [
        "# Sensor file of edge-sr doctor; use it with edge-sr --sensor FILE.",
        *_line("format", FILE_FORMAT),
        *_line("version", FILE_VERSION),
        *_line("model", sensor_file.model, "which CAN id is which taxel, as --id-map"),
        *_line("adapter", sensor_file.adapter, "serial number"),
    ]
    shape = sensor_file.geometry.scan_shape
    for name, entry in sensor_file.sensors.items():
        for part, own in _tables(entry, shape).items():
            lines += ["", f"[sensors.{_value(name)}{part}]", *own]
    return "\n".join([*lines, ""])


def _tables(entry: SensorEntry, shape: tuple[int, int, int]) -> dict[str, list[str]]:
    """Return the lines of an entry's tables, by what follows the sensor's name in theirs."""
    mounting, frame, baseline = entry.mounting, entry.frame, entry.baseline
    own = [
        "# Which taxel of the model's map lies at each place, seen from above, as patterns are drawn.",
        *_line("order", np.reshape(mounting.order, shape[1:]).tolist()),
        *_line("swap_xy", mounting.swap_xy),
        *_line("signs", mounting.signs, "of x (to the right), y (down) and z (into the pad), after the swap"),
        *_line("counts_per_newton", entry.counts_per_newton, "of the summed z"),
        *_line("counts_per_newton_interval", entry.counts_per_newton_interval, "90 %"),
        *_line("assumed", sorted(entry.assumed, key=PARTS.index) or None, "as wired; not measured"),
        *_line(
            "emulated",
            sorted(entry.emulated, key=PARTS.index) or None,
            "measured on an emulated sensor: not for a device",
        ),
    ]
    tables = {"": own}
    if frame is not None:
        tables[".frame"] = [
            "# Where the middle of the pad's face is on the robot, for ROS 2 and recordings.",
            *_line("parent", frame.parent),
            *_line("place_mm", frame.place_mm),
            *_line("quaternion", frame.quaternion, "x, y, z, w"),
        ]
    for part, pad, about in (
        (".pad", entry.pad, "The pad itself, for networks that ask for it."),
        (".learned", entry.learned, "Learned from contacts while it ran; edge-sr doctor --forget-gains removes it."),
    ):
        if pad is not None:
            tables[part] = [f"# {about}", *_pad_lines(pad, shape[2])]
    if baseline is not None:
        created_unix_s = None if math.isnan(baseline.created_unix_s) else baseline.created_unix_s
        tables[".baseline"] = [
            "# What the free pad reads, in counts, place by place.",
            *_line("id", baseline.id),
            *_line("created_unix_s", created_unix_s),
            *_line("scans", baseline.scans),
        ]
        for axis, plane in zip(AXES, baseline.counts.tolist(), strict=True):
            tables[".baseline"] += _line(axis, plane)
    return tables


def _pad_lines(pad: Pad, cols: int) -> list[str]:
    lines: list[str] = []
    for name in PAD_RANGES:
        lines += [*_line(name, pad.constants.get(name)), *_line(f"{name}_interval", pad.intervals.get(name))]
    for key, values, about in (
        ("gains", pad.gains, "how strongly each place reads: x row by row, then y, then z"),
        ("gain_half_widths", pad.gain_half_widths, "half of each one's 90 % interval, as a share of it"),
    ):
        if values is not None:
            rows = [_value(values[first : first + cols])[1:-1] for first in range(0, len(values), cols)]
            lines += [f"{key} = [  # {about}", *(f"    {row}," for row in rows), "]"]
    return lines


def _line(key: str, value: Any, about: str = "") -> list[str]:
    """Return the lines of a value, a grid with a line for each row, as it lies on the pad; none of None."""
    comment = f"  # {about}" if about else ""
    if value is None:
        return []
    if isinstance(value, list) and isinstance(value[0], list):
        return [f"{key} = [{comment}", *(f"    {_value(row)}," for row in value), "]"]
    return [f"{key} = {_value(value)}{comment}"]


def _value(value: object) -> str:
    """Return a text, number, truth value or list of them in TOML, which writes these as JSON does."""
    return json.dumps(value, ensure_ascii=False, default=float)  # numpy's numbers are no numbers of JSON
