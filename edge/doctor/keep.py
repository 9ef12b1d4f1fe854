"""What the doctor found, written into a sensor file."""

from collections.abc import Mapping
from dataclasses import replace
from errno import EISDIR
from pathlib import Path
from tempfile import TemporaryFile

from firmware_bridge.baseline import Baseline
from firmware_bridge.errors import SensorFileError
from firmware_bridge.links.ports import serial_ports
from firmware_bridge.mounting import Mounting
from firmware_bridge.sensor_file import SensorEntry, SensorFile
from firmware_bridge.sensor_file_text import save_sensor_file


def check_writable(path: Path) -> None:
    """Find out whether a file can be written, before a minute is spent on what is to be in it.

    Raises:
        SensorFileError: it cannot.
    """
    try:
        if path.is_dir():
            raise IsADirectoryError(EISDIR, "it is a folder")
        with TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        why = error.strerror or error
        raise SensorFileError(f"{path}: cannot be written: {why}: give --out a file in a folder of yours") from error


def keep(
    path: Path,
    known: SensorFile,
    port: str | None,
    baselines: Mapping[str, Baseline],
    found: Mapping[str, Mounting],
    counts_per_newton: Mapping[str, float],
) -> SensorFile:
    """Write what was known and what was found into a sensor file; returns what was written.

    Args:
        path: of the file.
        known: what the doctor was started with.
        port: of the adapter, whose serial number is kept where it has one.
        baselines: of the free pads as they were read, by sensor.
        found: what is to be corrected of the mounting, by sensor.
        counts_per_newton: of the sensors that were weighed.

    Raises:
        SensorFileError: the file cannot be written.
    """
    entries = dict(known.sensors)
    for name in sorted({*baselines, *found, *counts_per_newton}):
        entry = entries.get(name, SensorEntry())
        turned = found.get(name, Mounting())
        baseline = baselines.get(name, entry.baseline)
        if baseline is not None and turned.moves_taxels:
            counts = baseline.counts.reshape(3, -1)[:, list(turned.order)].reshape(baseline.counts.shape)
            baseline = Baseline.of(name, counts, baseline.created_unix_s, baseline.scans, baseline.origin)
        per_newton = counts_per_newton.get(name, entry.counts_per_newton)
        pad = None if entry.pad is None else entry.pad.turned(turned)
        entries[name] = SensorEntry(entry.mounting.then(turned), per_newton, baseline, pad)
    # A sensor of a named source is one of several, each with an adapter of its own.
    serial_number = None if port is None or any("/" in name for name in entries) else _serial_number(port)
    written = replace(known, adapter=serial_number or known.adapter, sensors=entries)
    save_sensor_file(path, written)
    return written


def _serial_number(port: str) -> str | None:
    device = str(Path(port).resolve())
    return next((one.serial_number for one in serial_ports() if one.path == device), None)
