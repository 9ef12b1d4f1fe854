"""`edge-sr convert`: a recording in another format, with what was recorded of it; nothing is computed."""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, TextIO

from edge.errors import SinkError, UsageError
from edge.perception.record_fields import FIELDS, Out
from edge.pipeline.sink import check_new
from edge.pipeline.source_setup import sensor_settings, unmapped
from edge.terminal.progress_bar import progress
from firmware_bridge.errors import as_typed
from firmware_bridge.in_place import write_in_place
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.tracks import Recording
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.sensor_file.model import SensorEntry

_NOT_IN_NPZ: Final = [
    field.name for field in FIELDS if Out.RECORD in field.out and Out.NPZ not in field.out and field.name != "pose"
]
_WITHOUT: Final = {
    (".mcap", ".npz"): f"events, counters, the wall clock, and of each record {', '.join(_NOT_IN_NPZ)}",
    (".mcap", ".csv"): "all but counts, times and poses: errors of poses, patterns, events, baselines, the mounting",
    (".npz", ".mcap"): "what was computed (edge-sr replay computes it), the device's times, later baselines",
    (".csv", ".mcap"): "the time of day, which the file does not state",
}
"""Parts of a recording that are not in the new file, by the endings of both."""


def run(options: argparse.Namespace, out: TextIO, err: TextIO) -> None:
    """Write a recording in the format that the new name ends in, or for a CSV a file for each sensor.

    Of a new file that cannot be written nothing is left.
    """
    source, target = Path(options.recording), Path(options.new)
    was, ending = source.suffix.lower(), target.suffix.lower()
    if ending not in _WRITERS:
        raise UsageError(f"{target}: expected a name that ends in .mcap, .npz or .csv")
    if was == ending:
        raise UsageError(f"{source} and {target} have the same format: copy it, or name the new file otherwise")
    if was in _WRITERS and (was, ending) not in _WITHOUT:
        made = as_typed(source.with_suffix(".mcap").name)
        rate = f" --rate-hz {options.rate_hz or 'R'}" if was == ".csv" else ""
        first, then = f"{as_typed(source)} {made}{rate}", f"{made} {as_typed(target)}"
        raise UsageError(f"{source} becomes no {ending}: edge-sr convert {first}; edge-sr convert {then}")
    if options.rate_hz is not None and was != ".csv":
        raise UsageError(f"--rate-hz is for a .csv alone: {source} has times of its own")
    check_new(target)
    replay = ReplayLink([source], options.rate_hz, paced=False)
    for notice in replay.notices():
        err.write(f"edge-sr: {notice.text}\n")
    sensors = [track.sensor for track in replay.recordings[0].tracks]
    files: dict[Path, str | None] = {target: None}
    if ending == ".csv" and len(sensors) > 1:
        parts = [name.replace("/", "-") for name in sensors]
        if len(set(parts)) < len(parts):
            parts = [str(number) for number in range(1, len(parts) + 1)]
        files = {target.with_stem(f"{target.stem}-{part}"): name for part, name in zip(parts, sensors, strict=True)}
    for path in files:
        check_new(path)
    for path, sensor in files.items():
        for line in _write(replay, path, sensor):
            out.write(f"{line}\n")
    out.write(f"not in it: {_WITHOUT[was, ending]}\n")


def _write(replay: ReplayLink, path: Path, sensor: str | None) -> Iterator[str]:
    """Write one file, read it back before it gets its name, and yield what is in it."""
    made: list[Recording] = []
    write = partial(_WRITERS[path.suffix.lower()], replay, sensor=sensor)
    try:
        write_in_place(path, write, lambda draft: made.append(load_recording(draft)), keep_before=False)
    except SinkError:
        raise
    except OSError as error:
        raise SinkError(f"cannot write {path}: {error.strerror or error}") from error
    recording = replay.recordings[0]
    tracks = [track for track in recording.tracks if sensor in (None, track.sensor)]
    expected, scans = (sum(len(track.counts) for track in some) for some in (tracks, made[0].tracks))
    names = ", ".join(track.sensor for track in tracks)
    lasting_s = max(float(replay.times_ns[track.sensor][-1]) for track in tracks) / 1e9
    emulated = ", EMULATED" if recording.origin == "emulated" else ""
    size_mb = path.stat().st_size / 1e6
    yield f"{path}: {scans} scans of sensor {names}, {lasting_s:.1f} s, {size_mb:.2f} MB{emulated}"
    if scans < expected:
        yield f"{expected - scans} scans are left out: a taxel gave no reading, for which a CSV has no cell"


def _write_npz(replay: ReplayLink, path: Path, *, sensor: str | None) -> None:
    from edge.sinks.converted_files import RecordedRows, write_npz

    recording = replay.recordings[0]
    origin, geometry = recording.origin or "replay", recording.tracks[0].geometry
    write_npz(path, RecordedRows(recording.path, geometry, origin), recording.mountings, recording.poses)


def _write_mcap(replay: ReplayLink, path: Path, *, sensor: str | None) -> None:
    from edge.sinks.mcap import McapScans

    recording = replay.recordings[0]
    kind = recording.origin or "replay"
    sensor_file = sensor_settings(None, unmapped(recording.tracks[0].geometry))
    entries = {name: SensorEntry(mounting) for name, mounting in recording.mountings.items()}
    to = McapScans(path, replace(sensor_file, sensors=entries), 0)  # the time of recording is unknown
    try:
        with progress("convert", sum(len(track.counts) for track in recording.tracks), "scan") as bar:
            while not replay.ended:
                (scan,) = replay.read(0.0)
                bar.update()
                baseline = recording.baselines.get(scan.sensor)
                age_s = None if baseline is None else scan.time_ns / 1e9 - baseline.created_unix_s
                to.drain()
                to.add_poses(replay.poses())
                frame = scan.sensor if kind == "device" else f"{kind}/{scan.sensor}"
                to.add_scan(scan, kind, frame, baseline, age_s)
                to.look()
    except BaseException:
        to.abandon()
        raise
    to.close()


def _write_csv(replay: ReplayLink, path: Path, *, sensor: str | None) -> None:
    from edge.sinks.converted_files import write_csv

    recording = replay.recordings[0]
    track = next(track for track in recording.tracks if sensor in (None, track.sensor))
    mounting = recording.mountings.get(track.sensor, Mounting(taxel_count=track.geometry.taxel_count))
    poses = [pose.later(-replay.first_ns) for pose in recording.poses]
    own = [pose for pose in poses if pose.sensor == track.sensor] or [pose for pose in poses if pose.sensor is None]
    write_csv(path, track, replay.times_ns[track.sensor], mounting, own, emulated=recording.origin == "emulated")


_WRITERS: Final = {".mcap": _write_mcap, ".npz": _write_npz, ".csv": _write_csv}
