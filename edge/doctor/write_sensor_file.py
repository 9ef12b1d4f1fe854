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


def check_writable(path: Path, known: SensorFile, *, presses: bool, weighs: bool) -> None:
    """Check that a file may be written, before minutes are spent on its content.

    The doctor started with what is `known`, and will ask for `presses`, and for a weight where it `weighs`. Raises
    SensorFileError where the file cannot be written, or holds values that this visit cannot measure.
    """
    try:
        in_place.check_writable(path)
    except OSError as error:
        why = error.strerror or error
        raise SensorFileError(f"{path}: cannot be written: {why}: pass --out a file in a folder of yours") from error
    before = _before(path)
    at_best = {
        name: replace(
            entry,
            counts_per_newton=entry.counts_per_newton if weighs else None,
            assumed=entry.assumed if presses else entry.assumed | _AS_WIRED,
            pad=None,
            learned=None,
            emulated=frozenset(),
        )
        for name, entry in before.sensors.items()
    }
    _refuse_loss(path, before, replace(before, sensors=at_best | dict(known.sensors)))


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
    were read, and `found` are corrections of the mounting. Raises SensorFileError where the file cannot be written, or
    holds values that were not measured this time.
    """
    with changing(path):
        before = _before(path)
        entries, as_wired = dict(known.sensors), Mounting(taxel_count=known.geometry.taxel_count)
        if known.path is not None and known.path.resolve() == path.resolve():  # a run may have learned gains meanwhile
            for name, entry in before.sensors.items():
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
        _refuse_loss(path, before, written)
        save_sensor_file(path, written)
        return written


def _before(path: Path) -> SensorFile:
    """Return the content of the file; an empty one where there is no file, or edge-sr would refuse it."""
    try:
        return load_sensor_file(path)
    except SensorFileError:
        return SensorFile()


def _refuse_loss(path: Path, before: SensorFile, written: SensorFile) -> None:
    lost = [
        f"{part} of sensor {name}"
        for name, entry in before.sensors.items()
        for part in _lost(entry, written.sensors.get(name, SensorEntry(assumed=_AS_WIRED)))
    ]
    if before.adapter is not None and written.adapter is None:
        lost.append("serial number of the adapter")
    if lost:
        raise SensorFileError(
            f"{path}: left as it is, because it holds what would be lost: {', '.join(lost)}: pass --sensor {path} "
            "as well, to keep what is not measured again, or another --out"
        )


def _lost(entry: SensorEntry, written: SensorEntry) -> list[str]:
    """Name the values of one entry that the other lacks, or has only of an emulated sensor."""

    def lost(part: str, held: bool, holds: bool) -> bool:
        return held and (not holds or part in written.emulated - entry.emulated)

    return [
        *["order and axes"] * lost("mounting", "mounting" not in entry.assumed, "mounting" not in written.assumed),
        *["gains"] * (entry.mounting.evens_gains and not written.mounting.evens_gains),
        *["counts per newton"] * lost("force", entry.counts_per_newton is not None, bool(written.counts_per_newton)),
        *["constants of the pad"] * lost("gains", entry.pad is not None, written.pad is not None),
        *["learned gains"] * (entry.learned is not None and written.learned is None and written.pad is None),
        *["place on the robot"] * (entry.frame is not None and written.frame is None),
        *["baseline"] * lost("baseline", entry.baseline is not None, written.baseline is not None),
    ]


def _serial_number(port: str) -> str | None:
    device, ports = str(Path(port).resolve()), serial_ports()
    number = next((one.serial_number for one in ports if one.path == device), None)
    return number if [one.serial_number for one in ports].count(number) == 1 else None
