"""Keeping of learned gains in the sensor file, in a thread of its own: a disk may take longer than a scan."""

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from firmware_bridge.errors import SensorFileError
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.sensor_file.model import SensorEntry, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import changing, save_sensor_file


class GainKeeper:
    """Keeper of the gains that the sensors of one file have learned."""

    def __init__(self, path: Path, mountings: Mapping[str, Mounting], *, emulated: bool) -> None:
        """Prepare to keep gains, learned with these mountings; emulated sensors leave a real one's file alone."""
        self._path, self._mountings, self._emulated = path, mountings, emulated
        self._writer = ThreadPoolExecutor(1, "gain-keeper")
        self._written: Future[None] | None = None

    def keep(self, sensor: str, learned: Pad) -> None:
        """Begin to write the learned gains of a sensor, which must not wait."""
        learning = self._path, sensor, learned, self._mountings.get(sensor, Mounting())
        self._written = self._writer.submit(keep_learned, *learning, emulated=self._emulated)

    def close(self) -> str | None:
        """Wait until all is written, and return why the last gains could not be kept; None if they were."""
        self._writer.shutdown()
        try:
            if self._written is not None:
                self._written.result()
        except SensorFileError as error:
            return str(error)
        return None


def keep_learned(
    path: Path, sensor: str, learned: Pad, mounting: Mounting | None = None, *, emulated: bool = False
) -> None:
    """Write gains, learned with a mounting, into a sensor file, unless it holds surer ones; raises SensorFileError.

    A file that states another mounting now is refused: by it each gain would be another taxel's, or another axis's.
    """
    with changing(path):
        file = load_sensor_file(path)  # again, since a person or the doctor may have changed it meanwhile
        entry = file.sensors.get(sensor, SensorEntry(assumed=frozenset({"mounting"})))
        if mounting not in (None, entry.mounting):
            raise SensorFileError(f"{path}: the mounting of sensor {sensor} was changed after they were learned")
        before = entry.learned
        surer = before is not None and before.gains_certainty > learned.gains_certainty
        if surer or (emulated and not entry.emulated):
            return
        entry = replace(entry, learned=learned)
        save_sensor_file(path, replace(file, sensors=dict(file.sensors) | {sensor: entry}), keep_before=False)


def forget_learned(path: Path, sensor: str) -> None:
    """Remove the learned gains of a sensor from a sensor file, or raise a SensorFileError if it has none."""
    with changing(path):
        file = load_sensor_file(path)
        entry = file.sensors.get(sensor)
        if entry is None or entry.learned is None:
            there = ", ".join(name for name, kept in file.sensors.items() if kept.learned is not None) or "of no sensor"
            raise SensorFileError(f"{path}: no learned gains of sensor {sensor}, expected one that has them: {there}")
        save_sensor_file(path, replace(file, sensors=dict(file.sensors) | {sensor: replace(entry, learned=None)}))
