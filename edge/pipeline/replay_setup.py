"""Recording as a source, with what it stores of its sensors."""

import math
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from edge.pipeline.scan_reader import Source
from edge.pipeline.source_setup import refuse_emulated, sensor_settings, unmapped, with_recorded
from firmware_bridge.errors import BaselineRefusedError, as_typed
from firmware_bridge.links.registry import recording_paths
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile
from firmware_bridge.zeroing.baseline import FEWEST_SCANS, Baseline
from firmware_bridge.zeroing.free_stretch import FEWEST_RECORDED, free_stretch


def open_recording(
    path: str | Path,
    *more: str | Path,
    sensor: str | Path | None = None,
    zero: bool = False,
    paced: bool = False,
    rate_hz: float | None = None,
    begins: threading.Event | None = None,
) -> Source:
    """Open a recording as a source, to compute its results again as `edge-sr replay` does.

    Every scan gets a result, however slow the loop is, with the time, mounting and baseline of the recording.

    Args:
        path: .mcap, .npz or .csv.
        more: recordings of other sensors, played beside it.
        sensor: file that `edge-sr doctor` wrote, used instead of the recorded settings.
        zero: zero from the first 100 scans, instead of using the recorded baselines.
        paced: play at the recorded speed, as if live; a loop that is too slow loses scans, as with a sensor.
        rate_hz: scans a second of each sensor, where the file does not state it, or to play it at another speed.
        begins: set when a paced recording is to begin; at once without.

    Raises:
        RecordingError: the recording cannot be used.
        SourceError: its rate is unknown or out of range.
        SensorFileError: the sensor file cannot be used.
    """
    paths = [path for file in (path, *more) for path in recording_paths(str(file))]
    replay = ReplayLink(paths, rate_hz, paced=paced, begins=begins)
    tracks = [track for recording in replay.recordings for track in recording.tracks]
    # A sensor file names the pad; without one the recording's grid does.
    file = sensor_settings(sensor, unmapped(tracks[0].geometry) if sensor is None else None)
    stored = with_recorded(file, [replay])
    baselines: dict[str, Baseline] = {}
    for recording in () if zero else replay.recordings:
        # By the clock of an undated recording, they would be half a century old in a run of today.
        undated = {"created_unix_s": math.nan} if paced and not recording.unix_offset_ns else {}
        baselines |= {name: replace(baseline, **undated) for name, baseline in recording.baselines.items()}
    if not zero:
        baselines = baselines or stored.baselines
        baselines |= free_baselines(replay, stored.mountings, baselines, rate_hz=rate_hz)
    sensors = {*stored.sensors, *baselines}
    if sensor is None:  # else a note reports the sensors that the file lacks
        sensors |= {track.sensor for track in tracks}
    as_wired = SensorEntry(Mounting(taxel_count=file.geometry.taxel_count))
    entries = {
        name: replace(stored.sensors.get(name, as_wired), baseline=baselines.get(name)) for name in sorted(sensors)
    }
    replay.place(file.mountings)
    return Source(replay, sensor_file=replace(stored, sensors=entries), rate_hz=rate_hz)


def recorded_baselines(
    text: str, sensor_file: SensorFile, rate_hz: float | None
) -> tuple[dict[str, Baseline], list[str]]:
    """Return the baselines of FILE[,FILE], from where each pad is free and still, and notes where that is.

    `rate_hz` is that of each sensor, where a file does not state it.

    Raises:
        BaselineRefusedError: a pad is nowhere free and still.
        RecordingError: a recording cannot be used.
        SensorFileError: the sensor file is of an emulated sensor, and the recording is not.
        SourceError: its rate is unknown or out of range.
    """
    replay = ReplayLink(recording_paths(text), rate_hz)
    refuse_emulated(sensor_file, replay.kind, replay.origin)
    baselines = free_baselines(replay, with_recorded(sensor_file, [replay]).mountings, opening=True, rate_hz=rate_hz)
    sensors = {track.sensor for recording in replay.recordings for track in recording.tracks}
    notes = [notice.text for notice in replay.notices()]
    if sensors - baselines.keys():
        faults = "; ".join(note for note in notes if ": zeroed from " not in note)
        raise BaselineRefusedError(faults or f"fewer than {FEWEST_RECORDED} scans: expected as many of a free pad")
    return baselines, notes


def free_baselines(
    replay: ReplayLink,
    mountings: Mapping[str, Mounting],
    stored: Mapping[str, Baseline] = MappingProxyType({}),
    *,
    opening: bool = False,
    rate_hz: float | None = None,
) -> dict[str, Baseline]:
    """Return the baselines of sensors that have none in `stored`, from where the recordings are free and still.

    The replay gets a note for each sensor. `mountings` are those of taxels that still have to be put in place. With
    `opening` the first scans count, too, from which a live run would zero by itself: for baselines that are kept.
    """
    baselines: dict[str, Baseline] = {}
    for recording in replay.recordings:
        raw = recording.path.suffix.lower() == ".csv"
        held = _remedy(recording.path, rate_hz)
        for track in recording.tracks:
            name = track.sensor
            if name in stored or len(track.counts) < FEWEST_RECORDED:
                continue
            try:
                stretch = free_stretch(track.counts)
            except BaselineRefusedError as refusal:
                replay.notes.append(f"sensor {name}: {refusal}. {held}")
                continue
            doubt = "" if stretch.touched else f". Its readings hardly change: is the pad free, or held? {held}"
            if stretch.opens and not opening:
                if doubt:
                    replay.notes.append(f"sensor {name}: zeroed from its first {FEWEST_SCANS} scans{doubt}")
                continue
            first, last = int(stretch.rows[0]), int(stretch.rows[-1])
            at_ns = replay.times_ns[name][[first, last]]
            how = "still and pressed least"
            if stretch.within_counts is not None:
                how = f"pressed least; it recovers there: a taxel may be off by {stretch.within_counts:.0f} counts"
            replay.notes.append(
                f"sensor {name}: zeroed from its scans {first + 1} to {last + 1}, {at_ns[0] / 1e9:.1f} to "
                f"{at_ns[1] / 1e9:.1f} s, where the pad is {how}{doubt}"
            )
            if raw and name in mountings:
                stretch = stretch._replace(counts=mountings[name].place_counts(stretch.counts))
            created_s = math.nan
            if recording.unix_offset_ns and track.time_ns is not None:  # 0: recorded again from an undated file
                created_s = (int(track.time_ns[last]) + recording.unix_offset_ns) / 1e9
            baselines[name] = stretch.baseline(name, created_s)
    return baselines


def _remedy(path: Path, rate_hz: float | None) -> str:
    """Return what to do about a recording whose pad may never be free."""
    rate = "" if rate_hz is None else f" --rate-hz {rate_hz:g}"
    return (
        "If it holds something all the time, take the baseline of a recording of this sensor in which it lets go: "
        f"edge-sr baseline --source replay:OTHER{rate} --out zero.json; edge-sr replay {as_typed(path)}{rate} "
        "--baseline zero.json shows patterns, marked as not to be believed"
    )
