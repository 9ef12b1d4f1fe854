"""Recordings played back at the speed they were made."""

import heapq
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.errors import SourceError
from firmware_bridge.geometry import USPA44
from firmware_bridge.links.base import Link, SourceKind
from firmware_bridge.recording import Recording, Track, load_recording
from firmware_bridge.scan import Scan, ScanSeries
from firmware_bridge.schedule import NS_PER_S, Clock, Sleep, sleep_until


class _Due(NamedTuple):
    due_ns: int
    lane: int
    counts: NDArray[np.int32]


class ReplayLink(Link):
    """Scans from recordings, all started together. It never leaves a scan out; late ones come at once."""

    def __init__(
        self,
        paths: Sequence[str | Path],
        rate_hz: float | None = None,
        *,
        clock: Clock = time.monotonic_ns,
        sleep: Sleep = time.sleep,
    ) -> None:
        """Load the recordings.

        Args:
            paths: of the recordings.
            rate_hz: scans a second of each sensor; by default the recorded times, else the recorded rate.
            clock: monotonic time in [ns].
            sleep: sleeps for a time in [s].

        Raises:
            RecordingError: a file cannot be used.
            SourceError: the rate is no rate, a file tells neither times nor rate, or two files name the same sensor.
        """
        if rate_hz is not None and not 0 < rate_hz < math.inf:
            raise SourceError(f"rate is {rate_hz} Hz, expected a positive number")
        recordings = [load_recording(path) for path in paths]
        self.name = f"replay:{','.join(map(str, paths))}"
        self.kind: SourceKind = "replay"
        self.ended = False
        self._clock = clock
        self._sleep = sleep
        lanes = [
            (track, _due_times_ns(recording, track, rate_hz)) for recording in recordings for track in recording.tracks
        ]
        sensors = [track.sensor for track, _ in lanes]
        if len(set(sensors)) < len(sensors):
            raise SourceError(f"recordings of sensors {', '.join(sensors)}: expected each sensor once")
        self._series = [ScanSeries(track.sensor, USPA44) for track, _ in lanes]
        self._timeline = heapq.merge(*(_lane(i, *lane) for i, lane in enumerate(lanes)), key=lambda due: due.due_ns)
        self._next: _Due | None = next(self._timeline, None)
        self._start_ns = 0
        self._counts: dict[str, int] = dict.fromkeys(("scans", "torn_wire", "torn_source", "repeated"), 0)

    def __enter__(self) -> Self:
        self._start_ns = self._clock()
        return self

    def __exit__(self, *exc_info: object) -> None:
        pass

    def read(self, timeout_s: float) -> list[Scan]:
        """Scans that fell due since the last call; waits at most `timeout_s` for the first."""
        if self._next is None:
            return []
        latest_ns = self._clock() + int(timeout_s * NS_PER_S)
        now_ns = sleep_until(min(self._start_ns + self._next.due_ns, latest_ns), self._clock, self._sleep)
        scans: list[Scan] = []
        while self._next is not None and self._start_ns + self._next.due_ns <= now_ns:
            scans.append(self._close(self._next))
            self._next = next(self._timeline, None)
        self.ended = self._next is None
        return scans

    def counters(self) -> dict[str, int]:
        """Scans, and how many of them were torn or repeated, as the recording has them."""
        return dict(self._counts)

    def _close(self, due: _Due) -> Scan:
        scan = self._series[due.lane].close(due.counts.copy(), self._start_ns + due.due_ns)
        self._counts["scans"] += 1
        self._counts["torn_wire"] += not scan.complete
        self._counts["torn_source"] += scan.complete and scan.torn
        self._counts["repeated"] += scan.repeated
        return scan


def _lane(lane: int, track: Track, due_times_ns: NDArray[np.int64]) -> Iterator[_Due]:
    for due_ns, counts in zip(due_times_ns.tolist(), track.counts, strict=True):
        yield _Due(due_ns, lane, counts)


def _due_times_ns(recording: Recording, track: Track, rate_hz: float | None) -> NDArray[np.int64]:
    if rate_hz is None and track.time_ns is not None:
        first_ns = min(int(other.time_ns[0]) for other in recording.tracks if other.time_ns is not None)
        return track.time_ns - first_ns
    rate_hz = recording.rate_hz if rate_hz is None else rate_hz
    if rate_hz is None:
        raise SourceError(f"{recording.path} does not tell how fast it was recorded: give --rate-hz")
    return np.rint(np.arange(len(track.counts)) * (NS_PER_S / rate_hz)).astype(np.int64)
