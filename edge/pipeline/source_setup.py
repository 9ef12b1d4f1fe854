"""Settings of the sensors, from a sensor file and the options next to it."""

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from edge.errors import UsageError
from edge.inference.bundled import demo_recording
from edge.validation import check_positive
from firmware_bridge.errors import SensorFileError, harmless
from firmware_bridge.links.base import Link, SourceKind
from firmware_bridge.links.registry import DEMO_LOOP, open_sources
from firmware_bridge.pad_geometry import PADS, SensorGeometry
from firmware_bridge.scans.can_id_maps import ID_MAPS, USPA44_MAP, ModelMap
from firmware_bridge.sensor_file.model import PARTS, SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.zeroing.baseline import Baseline, load_baselines

FRESH_S: Final = 600.0  # age of a baseline, in [s], up to which a pad rests near it: it moves by 60 counts an hour


def unmapped(pad: SensorGeometry) -> str | ModelMap:
    """Return the id map of a pad whose ids are not needed, as in a recording."""
    return pad.name if pad in PADS else ModelMap(pad.name, pad, {})


def sensor_settings(sensor: str | Path | None, id_map: str | ModelMap | None) -> SensorFile:
    """Return the settings of the sensors, by a sensor file and an id map as requested; raises where they differ."""
    if isinstance(id_map, ModelMap):
        if sensor is not None:
            raise UsageError(f"id map {id_map.name} of the program's own, and {sensor}: leave one of them out")
        return SensorFile(id_map.name, own_map=id_map)
    if id_map not in (None, *ID_MAPS):
        raise UsageError(f"id map is {id_map!r}, expected one of: {', '.join(ID_MAPS)}")
    sensor_file = SensorFile(id_map or USPA44_MAP.name) if sensor is None else load_sensor_file(sensor)
    if id_map not in (None, sensor_file.model):
        raise UsageError(
            f"id map {id_map}, but {sensor} is of a {sensor_file.model}, and so are its order and baseline: "
            "leave one of them out"
        )
    return sensor_file


def links_to(texts: Sequence[str], sensor_file: SensorFile, rate_hz: float | None) -> tuple[list[Link], SensorFile]:
    """Return links, not yet entered, to the sources, else the file's adapter or the only one, and sensors' settings."""
    if rate_hz is not None:
        check_positive("rate_hz", rate_hz)
    for text in texts:
        if not isinstance(text, str):
            raise UsageError(f"source is {text!r}, expected text, as after --source; of several each by itself")
    if not texts and sensor_file.adapter is not None:
        texts = [f"slcan:serial={sensor_file.adapter}"]
    demo = any(text.rpartition("=")[2] in ("demo", DEMO_LOOP) for text in texts)
    recording = demo_recording() if demo else None
    links = open_sources(texts, rate_hz, recording, sensor_file.model_map, mountings=sensor_file.mountings)
    return links, with_recorded(sensor_file, links)


def with_recorded(sensor_file: SensorFile, links: Iterable[Link]) -> SensorFile:
    """Return the settings, with the recorded mountings of sensors that they do not name."""
    recorded = {name: SensorEntry(mounting) for link in links for name, mounting in link.mountings.items()}
    return replace(sensor_file, sensors=recorded | dict(sensor_file.sensors))


def refuse_emulated(sensor_file: SensorFile, kind: SourceKind, origin: SourceKind | None) -> None:
    """Raise a SensorFileError for settings of an emulated sensor on a device, or on a recording of anything else."""
    if "emulated" in (kind, origin):
        return
    this = "recording is not known to be of one" if kind == "replay" else "is a device"
    for name, entry in sensor_file.sensors.items():
        if entry.emulated:
            parts = ", ".join(part for part in PARTS if part in entry.emulated)
            raise SensorFileError(
                f"the sensor file has {parts} of an emulated sensor {name}, and this {this}: write a new one with "
                "edge-sr doctor --out, or leave --sensor out"
            )


def stored_baselines(
    baselines: Mapping[str, Baseline] | str | Path | None, sensor_file: SensorFile
) -> Mapping[str, Baseline]:
    """Return the baselines of free pads: stored ones, or their file, before those of the sensor file."""
    if isinstance(baselines, (str, Path)):
        return load_baselines(baselines, sensor_file.orders)
    if not isinstance(baselines, Mapping):  # which is refused where the runtime is made
        return sensor_file.baselines if baselines is None else baselines
    now_s = time.time()  # one that a program has kept for long is as old as one of a file, and in doubt as well
    return {
        name: replace(one, origin="file") if isinstance(one, Baseline) and not one.age_s(now_s) < FRESH_S else one
        for name, one in baselines.items()
    }


def of_single_csv(baselines: Mapping[str, Baseline], played: str) -> Mapping[str, Baseline]:
    """Return a single baseline under the name of the single CSV that is played, which states no sensor."""
    file = played.removeprefix("replay:")
    single = file != played and "," not in file and file.lower().endswith(".csv")
    if not (single and isinstance(baselines, Mapping) and len(baselines) == 1):
        return baselines
    sensor = harmless(Path(file).stem, kept="")  # as the reader of the file names it
    (baseline,) = baselines.values()
    return {sensor: replace(baseline, sensor=sensor)}
