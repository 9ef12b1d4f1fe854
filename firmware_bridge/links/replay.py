"""Link that plays recordings, at their own speed or as fast as they are read."""

import math
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from heapq import merge
from operator import itemgetter
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.errors import SourceError, harmless
from firmware_bridge.links.base import Link, Notice, SourceKind
from firmware_bridge.poses import GAP_NS, TimedPose
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.tracks import Recording, Track, origin_of
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import ABSENT, Scan, ScanSeries
from firmware_bridge.schedule import LAST_TIME_NS, NS_PER_S, Clock, Sleep, sleep_until


class ReplayLink(Link):
    """Link to recordings, all started together. It never leaves a scan out; late ones come at once."""

    def __init__(
        self,
        paths: Sequence[str | Path | Recording],
        rate_hz: float | None = None,
        *,
        paced: bool = True,
        begins: threading.Event | None = None,
        clock: Clock = time.monotonic_ns,
        sleep: Sleep = time.sleep,
    ) -> None:
        """Load the recordings, from their paths or in memory.

        They are played by their recorded times, else at their recorded rate, or at `rate_hz` scans a second of each
        sensor. If `paced`, that is so from now on, or once `begins` is set; else each `read` returns a scan at its
        recorded time. Raises RecordingError, or SourceError where they cannot be played so, or not together.
        """
        if rate_hz is not None and not 0 < rate_hz < math.inf:
            raise SourceError(f"rate is {rate_hz} Hz, expected a positive number")
        self.recordings = [path if isinstance(path, Recording) else load_recording(path) for path in paths]
        timed = [file.path for file in self.recordings for track in file.tracks if track.time_ns is not None]
        if not paced and rate_hz is not None and timed:
            raise SourceError(f"{timed[0]} has times of its own, which are kept: leave out --rate-hz, or add --paced")
        emulated = {str(file.path): file.origin == "emulated" for file in self.recordings}
        if len(set(emulated.values())) > 1:
            listed = ", ".join(f"{path} is {'emulated' if is_so else 'not'}" for path, is_so in emulated.items())
            raise SourceError(f"recordings are of several kinds ({listed}), expected one: play them apart")
        self.name = harmless(f"replay:{','.join(str(file.path) for file in self.recordings)}")
        self.kind: SourceKind = "replay"
        self.lasts = False
        self.patient = not paced
        self.origin = origin_of(recording.origin for recording in self.recordings)
        self.mountings = {
            track.sensor: recording.mountings.get(track.sensor, Mounting(taxel_count=track.geometry.taxel_count))
            for recording in self.recordings
            if recording.mountings
            for track in recording.tracks
        }
        self.notes: list[str] = []  # remarks for the user, which become notices
        self._begins = begins
        self._clock = clock
        self._sleep = sleep
        lanes = [
            (track, _due_times_ns(recording, track, rate_hz))
            for recording in self.recordings
            for track in recording.tracks
        ]
        self._tracks = [track for track, _ in lanes]
        # Times (n,) of each sensor's scans since the first scan, in [ns].
        self.times_ns = {track.sensor: due_times_ns for track, due_times_ns in lanes}
        sensors = [track.sensor for track in self._tracks]
        if len(set(sensors)) < len(sensors):
            raise SourceError(f"recordings of sensors {', '.join(sensors)}: expected each sensor once")
        self._series = [ScanSeries(track.sensor, track.geometry) for track in self._tracks]
        lasting = [file for file in self.recordings if file.poses and self._has_pose_times(file, rate_hz)]
        self.states_poses = bool(lasting)
        self._poses_to_come = merge(*map(self._posed, lasting), key=itemgetter(0))
        self._next_pose = next(self._poses_to_come, None)
        self._poses: list[TimedPose] = []
        due_ns = np.concatenate([times_ns for _, times_ns in lanes])
        lane = np.concatenate([np.full(len(times_ns), number) for number, (_, times_ns) in enumerate(lanes)])
        row = np.concatenate([np.arange(len(times_ns)) for _, times_ns in lanes])
        order = np.lexsort((lane, due_ns))
        self._due_ns, self._lane, self._row = due_ns[order], lane[order], row[order]
        self._place = 0
        self.length_s = int(self._due_ns[-1]) / NS_PER_S
        self.first_ns = _first_ns(self.recordings[0]) or 0  # time of the first scan as it is played, in [ns]
        if not paced:
            self.unix_offset_ns = self.recordings[0].unix_offset_ns
        self.notes += [note for recording in self.recordings for note in recording.notes]
        self._counts: dict[str, int] = dict.fromkeys(("scans", "torn_wire", "torn_source", "repeated"), 0)

    def __enter__(self) -> Self:
        if not self.patient:
            self.first_ns = self._clock()
        return self

    def __exit__(self, *exc_info: object) -> None:
        pass

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans due since the last call; waits at most `timeout_s` for the first. If patient, the next."""
        if self._begins is not None:
            if not self._begins.wait(timeout_s):
                return []
            self._begins, self.first_ns = None, self._clock()
        next_ns = self._next_ns()
        if next_ns is None:
            return []
        if self.patient:
            return [self._take()]
        latest_ns = self._clock() + int(timeout_s * NS_PER_S)
        now_ns = sleep_until(min(next_ns, latest_ns), self._clock, self._sleep)
        scans: list[Scan] = []
        while (next_ns := self._next_ns()) is not None and next_ns <= now_ns:
            scans.append(self._take())
        return scans

    def place(self, mountings: Mapping[str, Mounting]) -> None:
        """Put the taxels of each CSV, which are as wired, in their places; those of other files are there already.

        Raises SourceError where a CSV is of a pad with another number of taxels than its mounting.
        """
        as_wired = [file for file in self.recordings if file.path.suffix.lower() == ".csv"]
        paths = {track.sensor: file.path for file in as_wired for track in file.tracks if track.sensor in mountings}
        for number, track in enumerate(self._tracks):
            if track.sensor in paths:
                mounting, taxels = mountings[track.sensor], track.geometry.taxel_count
                if taxels != mounting.taxel_count:
                    raise SourceError(
                        f"{paths[track.sensor]} has {taxels} taxels, and in the sensor file sensor {track.sensor} has "
                        f"{mounting.taxel_count}: leave out the sensor file, or give that of this pad"
                    )
                self._tracks[number] = replace(track, counts=mounting.place_counts(track.counts))

    def notices(self) -> list[Notice]:
        """Return the notes on the files, once."""
        notes, self.notes = self.notes, []
        return [Notice(self.first_ns, "note", note) for note in notes]

    def poses(self) -> list[TimedPose]:
        """Return the poses that the scans of the last `read` were made with, as in the recording, each once."""
        poses, self._poses = self._poses, []
        return poses

    def counters(self) -> dict[str, int]:
        """Return the counts of scans, and of the torn and repeated ones among them, as in the recording."""
        return dict(self._counts)

    def _has_pose_times(self, recording: Recording, rate_hz: float | None) -> bool:
        """Return False, and note it, where the times of a recording's poses do not hold."""
        first_ns, poses, why = _first_ns(recording), recording.poses, "--rate-hz replaces the times"
        if recording.poses_by_row:
            return True
        if rate_hz is None and first_ns is not None:
            newest_ns = max(pose.time_ns if pose.used_from_ns is None else first_ns for pose in poses)
            since_s = (first_ns - newest_ns) / NS_PER_S
            if since_s < 3600:
                return True
            why = f"the last is of {since_s:.4g} s before the first scan, as by another clock"
        self.notes.append(f"{recording.path}: its {len(poses)} poses are left out, since {why}")
        return False

    def _posed(self, recording: Recording) -> Iterator[tuple[int, TimedPose]]:
        """Yield poses in their order, timed from the first scan, each with the time of the scan that it served first.

        Beside other recordings, a pose of all sensors is one of this recording's sensors each.
        """
        first_ns = 0 if recording.poses_by_row else _first_ns(recording) or 0
        sensors = [track.sensor for track in recording.tracks] if len(self.recordings) > 1 else [None]
        for pose in recording.poses:
            if recording.poses_by_row:
                row_ns = int(self.times_ns[recording.tracks[0].sensor][pose.time_ns])
                pose = replace(pose, time_ns=row_ns, used_from_ns=row_ns)
            # A file of another program does not state which scan a pose served. There each pose comes early, so that
            # it is interpolated; one that comes earlier than the longest gap would not be used earlier.
            used_from_ns = pose.time_ns - GAP_NS if pose.used_from_ns is None else pose.used_from_ns
            for sensor in sensors if pose.sensor is None else [pose.sensor]:
                yield used_from_ns - first_ns, replace(pose.later(-first_ns), sensor=sensor)

    def _next_ns(self) -> int | None:
        """Return the time of the next scan, in [ns]; None after the last."""
        return None if self._place == len(self._due_ns) else self.first_ns + int(self._due_ns[self._place])

    def _take(self) -> Scan:
        """Return the next scan."""
        due_ns, lane, row = map(int, (self._due_ns[self._place], self._lane[self._place], self._row[self._place]))
        while self._next_pose is not None and self._next_pose[0] <= due_ns:
            self._poses.append(self._next_pose[1].later(self.first_ns))
            self._next_pose = next(self._poses_to_come, None)
        self._place += 1
        self.ended = self._place == len(self._due_ns)
        time_ns = self.first_ns + due_ns
        track = self._tracks[lane]
        if track.renewed is None:
            vendor = track.vendor[row] if track.vendor else None
            scan = self._series[lane].close(track.counts[row].copy(), time_ns, vendor=vendor)
        else:
            scan = _recorded(track, track.renewed, row, time_ns)
        self._counts["scans"] += 1
        self._counts["torn_wire"] += not scan.complete
        self._counts["torn_source"] += scan.complete and scan.torn
        self._counts["repeated"] += scan.repeated
        return scan


def _recorded(track: Track, renewed: NDArray[np.bool_], row: int, time_ns: int) -> Scan:
    """Return a scan as it was, even if a part of the recording before it is missing."""
    counts = track.counts[row].copy()
    fresh, new = counts[0] != ABSENT, renewed[row].copy()
    for array in (counts, fresh, new):
        array.setflags(write=False)
    number = row if track.numbers is None else int(track.numbers[row])
    device_ns = -1 if track.device_time_ns is None else int(track.device_time_ns[row])
    moved_ns = None if track.time_ns is None or device_ns < 0 else device_ns + time_ns - int(track.time_ns[row])
    return Scan(
        track.sensor, number, time_ns, counts, fresh, new, moved_ns, track.vendor[row] if track.vendor else None
    )


def _first_ns(recording: Recording) -> int | None:
    return min((int(track.time_ns[0]) for track in recording.tracks if track.time_ns is not None), default=None)


def _due_times_ns(recording: Recording, track: Track, rate_hz: float | None) -> NDArray[np.int64]:
    first_ns = _first_ns(recording)
    if rate_hz is None and track.time_ns is not None and first_ns is not None:
        return track.time_ns - first_ns
    rate_hz = recording.rate_hz if rate_hz is None else rate_hz
    if rate_hz is None:
        why = "".join(f"; {note}" for note in recording.notes)
        raise SourceError(f"{recording.path} does not state its rate: pass --rate-hz{why}")
    due_ns = np.arange(len(track.counts)) * (NS_PER_S / rate_hz)
    if recording.pauses is not None:  # as long as they were, however fast it is played: no tap goes on over an outage
        due_ns += np.cumsum(recording.pauses) * (NS_PER_S / (recording.rate_hz or rate_hz))
    if due_ns[-1] > LAST_TIME_NS:
        lasting_s = due_ns[-1] / NS_PER_S
        raise SourceError(f"{recording.path} lasts {lasting_s:.3g} s at {rate_hz:g} Hz: give a higher rate")
    return np.rint(due_ns).astype(np.int64)
