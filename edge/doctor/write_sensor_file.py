"""Writing of the doctor's results into a sensor file, unless that would lose what the file holds already."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from firmware_bridge import in_place
from firmware_bridge.errors import SensorFileError
from firmware_bridge.links.serial_ports import serial_ports
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import changing, save_sensor_file
from firmware_bridge.zeroing.baseline import Baseline

_AS_WIRED = frozenset({"mounting"})


def check_writable(path: Path, known: SensorFile) -> None:
    """Check that a file may be written, before minutes are spent on its content.

    It is a new one, or that of `known`, of which all is kept that is not measured again. Raises SensorFileError for
    another, and for one that cannot be written.
    """
    try:
        in_place.check_writable(path)
    except OSError as error:
        why = error.strerror or error
        raise SensorFileError(f"{path}: cannot be written: {why}: pass --out a file in a folder of yours") from error
    if path.exists() and (known.path is None or known.path.resolve() != path.resolve()):
        raise SensorFileError(
            f"{path}: left as it is, because what it holds would be lost: pass --sensor {path} as well, to keep what "
            "is not measured again, or another --out"
        )


def refuse_device(path: Path, known: SensorFile) -> None:
    """Raise a SensorFileError where an emulated sensor would be written into the file of a device."""
    measured = (one for one in known.sensors.values() if one.baseline is not None or "mounting" not in one.assumed)
    if path.exists() and not all(one.emulated for one in measured):
        raise SensorFileError(
            f"{path}: left as it is, because it is of a device, and this one is emulated: another --out"
        )


def keep(
    path: Path,
    known: SensorFile,
    port: str | None,
    baselines: Mapping[str, Baseline],
    found: Mapping[str, Mounting],
    counts_per_newton: Mapping[str, float],
    *,
    emulated: bool = False,
) -> SensorFile:
    """Write what is `known` from before and the new results, by sensor, into a sensor file, and return it.

    `port` is that of the adapter, whose serial number is kept where it has one; baselines are of the free pads as they
    were read, and `found` are corrections of the mounting. Raises SensorFileError where the file cannot be written.
    """
    with changing(path):
        entries, as_wired = dict(known.sensors), Mounting(taxel_count=known.geometry.taxel_count)
        if path.exists():  # a run may have learned gains meanwhile
            for name, entry in load_sensor_file(path).sensors.items():
                entries[name] = replace(entries.get(name, entry), learned=entry.learned)
        for name in sorted({*baselines, *found, *counts_per_newton}):
            entry = entries.get(name, SensorEntry(as_wired, assumed=_AS_WIRED))
            parts = {"mounting": found, "force": counts_per_newton, "baseline": baselines}
            renewed = frozenset(part for part, of_sensors in parts.items() if name in of_sensors)
            turned = found.get(name, as_wired)
            baseline = baselines.get(name, entry.baseline)
            if baseline is not None and turned.moves_taxels:
                counts = baseline.counts.reshape(3, -1)[:, list(turned.order)].reshape(baseline.counts.shape)
                baseline = Baseline.of(name, counts, baseline.created_unix_s, baseline.scans, baseline.origin)
            per_newton = counts_per_newton.get(name, entry.counts_per_newton)
            pads = [None if pad is None else pad.turned(turned) for pad in (entry.pad, entry.learned)]
            entries[name] = SensorEntry(
                entry.mounting.then(turned),
                per_newton,
                baseline,
                *pads,
                assumed=entry.assumed - renewed,
                emulated=entry.emulated | renewed if emulated else entry.emulated - renewed,
                frame=entry.frame,
            )
        # A sensor of a named source is one of several, each with an adapter of its own.
        serial_number = None if port is None or any("/" in name for name in entries) else _serial_number(port)
        written = replace(known, adapter=serial_number or known.adapter, sensors=entries)
        save_sensor_file(path, written)
        return written


def _serial_number(port: str) -> str | None:
    device, ports = str(Path(port).resolve()), serial_ports()
    number = next((one.serial_number for one in ports if one.path == device), None)
    return number if [one.serial_number for one in ports].count(number) == 1 else None
