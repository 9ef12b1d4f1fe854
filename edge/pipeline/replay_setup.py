"""Recording as a source, with what it stores of its sensors."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from edge.pipeline.scan_reader import Source
from edge.pipeline.source_setup import settled, with_recorded
from edge.terminal.progress_bar import Progress
from firmware_bridge.links.registry import place_recordings, recording_paths
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.pad_geometry import PADS, SensorGeometry
from firmware_bridge.recording.formats import npz_baselines
from firmware_bridge.recording.tracks import Recording
from firmware_bridge.scans.can_id_maps import ModelMap
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.sensor_file.model import SensorEntry
from firmware_bridge.zeroing.baseline import Baseline


def open_recording(
    path: str | Path,
    *,
    sensor: str | Path | None,
    zero: bool,
    paced: bool,
    rate_hz: float | None,
    bar: bool = False,
) -> Source:
    """Return the source that plays a recording, as edge.api.open_recording does; `bar` shows its progress."""
    paths = recording_paths(str(path))
    replay = (_FollowedReplay if bar else ReplayLink)(paths, rate_hz, paced=paced)
    tracks = [track for recording in replay.recordings for track in recording.tracks]
    # A sensor file names the pad; without one the recording's grid does.
    pad = tracks[0].geometry
    file = settled(sensor, None if sensor is not None else _named(pad))
    known = with_recorded(file, [replay])
    recorded = [_in_its_time(recording, paced=paced) for recording in replay.recordings]
    baselines = {} if zero else {name: one for each in recorded for name, one in each.items()} or known.baselines
    mountings = known.mountings
    sensors = {*mountings, *baselines}
    if sensor is None:  # else a note reports the sensors that the file lacks
        sensors |= {track.sensor for track in tracks}
    entries = {
        name: SensorEntry(
            mountings.get(name, Mounting(taxel_count=file.geometry.taxel_count)),
            known.counts_per_newton.get(name),
            baselines.get(name),
            entry.pad,
            entry.learned,
        )
        for name in sorted(sensors)
        for entry in [known.sensors.get(name, SensorEntry())]
    }
    known = replace(known, sensors=entries)
    return Source(place_recordings(replay, paths, file.mountings), sensor_file=known, rate_hz=rate_hz)


def _named(pad: SensorGeometry) -> str | ModelMap:
    """Return a replacement for the id map of a recording's sensors, whose ids are no longer needed."""
    return pad.name if pad in PADS else ModelMap(pad.name, pad, {})


class _FollowedReplay(ReplayLink):
    """Recording with a bar that shows how much of it was taken."""

    def __init__(self, paths: Sequence[str], rate_hz: float | None, *, paced: bool) -> None:
        super().__init__(paths, rate_hz, paced=paced)
        scans = sum(len(track.counts) for recording in self.recordings for track in recording.tracks)
        self._bar = Progress("replay", scans, "scan")

    def __exit__(self, *exc_info: object) -> None:
        self._bar.close()
        super().__exit__(*exc_info)

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that fell due since the last call."""
        scans = super().read(timeout_s)
        self._bar.advance(len(scans))
        return scans


def _in_its_time(recording: Recording, *, paced: bool) -> dict[str, Baseline]:
    """Return a recording's baselines; if it is paced and undated, dated so that they keep their ages at its scans."""
    baselines = dict(recording.baselines)
    if recording.path.suffix.lower() == ".npz":
        baselines = npz_baselines(recording)
    if not paced or recording.unix_offset_ns:  # 0: the time of recording was unknown even then
        return baselines
    firsts_ns = {track.sensor: track.time_ns[0] for track in recording.tracks if track.time_ns is not None}
    now_s = time.time()
    return {
        name: replace(one, created_unix_s=now_s - (firsts_ns[name] / 1e9 - one.created_unix_s))
        for name, one in baselines.items()
    }
