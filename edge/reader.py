"""A link read in a thread of its own, so that nothing waits for inference."""

import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Final, NamedTuple

from firmware_bridge.links.base import Link, Notice
from firmware_bridge.scan import Scan

CAPACITY_SCANS: Final = 1024
"""Five seconds of two sensors at 100 Hz: only a sink that hangs lets so many wait."""
POLL_S: Final = 0.1
"""How long a stop, a command or a silent link may go unnoticed."""


class Arrival(NamedTuple):
    """A scan, and the link's counters when it had been read."""

    scan: Scan
    counters: Mapping[str, int]


class ScanReader:
    """Reads an open link; what nobody takes in time is thrown away, oldest first.

    Attributes:
        overruns: scans thrown away.
    """

    def __init__(self, link: Link, capacity_scans: int = CAPACITY_SCANS) -> None:
        self.overruns = 0
        self._link = link
        # Unlike a Condition it wakes its reader without Python on either side: half of what a scan cost was waking.
        self._waiting: SimpleQueue[Arrival | Notice | None] = SimpleQueue()
        self._capacity_scans = capacity_scans
        self._through = False
        self._stop = threading.Event()
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="scan-reader")
        self._reading: Future[None] | None = None

    def __enter__(self) -> "ScanReader":
        self._reading = self._executor.submit(self._read)
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._stop.set()
        self._executor.shutdown()

    def take(self, timeout_s: float) -> list[Arrival | Notice] | None:
        """All that waits, in its order, after waiting at most `timeout_s` for something; None when no more will come.

        Raises:
            LinkLostError: and whatever else ended the reading, after all scans before it were taken.
        """
        taken: list[Arrival | Notice] = []
        try:
            heard = None if self._through else self._waiting.get(timeout=timeout_s)
            while heard is not None:
                taken.append(heard)
                heard = self._waiting.get_nowait()
            self._through = True
        except Empty:
            return taken
        if taken:
            return taken
        if self._reading is not None:
            self._reading.result()
        return None

    def _read(self) -> None:
        try:
            while not (self._stop.is_set() or self._link.ended):
                scans = self._link.read(POLL_S)
                for notice in self._link.notices():
                    self._waiting.put(notice)
                if scans:
                    self._put(scans)
        finally:
            for notice in self._link.notices():
                self._waiting.put(notice)
            self._waiting.put(None)

    def _put(self, scans: Sequence[Scan]) -> None:
        counters = self._link.counters()
        for scan in scans:
            if self._waiting.qsize() >= self._capacity_scans:
                self._make_room()
            self._waiting.put(Arrival(scan, counters))

    def _make_room(self) -> None:
        with suppress(Empty):  # taken after all, that moment
            oldest = self._waiting.get_nowait()
            if isinstance(oldest, Arrival):
                self.overruns += 1
            else:
                self._waiting.put(oldest)  # late is better than never: a notice is rare, and no reading
