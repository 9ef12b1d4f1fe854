"""A link, read in a thread of its own, so that nothing waits for inference; and what is known of its sensors."""

import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from queue import Empty, SimpleQueue
from typing import Final, NamedTuple, Self

from edge.errors import UsageError
from edge.pipeline.source_setup import refuse_emulated
from firmware_bridge.links.base import Link, Notice, SourceKind
from firmware_bridge.scans.scan import Scan
from firmware_bridge.sensor_file.model import SensorFile
from firmware_bridge.silence import POLL_S

CAPACITY_SCANS: Final = 1024
"""Five seconds of two sensors at 100 Hz: only a sink that hangs lets so many wait."""


class Arrival(NamedTuple):
    """A scan, and the link's counters when it had been read."""

    scan: Scan
    counters: Mapping[str, int]


class Source:
    """Opens a link, reads it, and closes it; what nobody takes in time is thrown away, oldest first.

    Reading begins when it is opened: what comes while a model loads waits here. A patient link is read by whoever
    takes, a scan at a time, so that nothing is thrown away or overtaken. A source is opened once.

    Attributes:
        name: as a user would write it, such as "slcan:/dev/ttyUSB0".
        patient: the link waits for its reader, and its scans are of another time than now.
        sensor_file: what is known of its sensors.
        rate_hz: of each sensor, where one was asked for, in [Hz].
        overruns: scans thrown away.
        thread_ids: by the system's numbers, of what reads beside whoever takes.
    """

    def __init__(
        self,
        link: Link,
        capacity_scans: int = CAPACITY_SCANS,
        *,
        sensor_file: SensorFile | None = None,
        rate_hz: float | None = None,
        force: bool = False,
    ) -> None:
        """Prepare to read a link that is not open yet.

        Args:
            link: opened and closed by this source.
            capacity_scans: how many scans may wait.
            sensor_file: what is known of the sensors; nothing without.
            rate_hz: of each sensor, in [Hz].
            force: use of a device also what the sensor file has of an emulated sensor.
        """
        self.name = link.name
        self.patient = link.patient
        self.sensor_file = SensorFile() if sensor_file is None else sensor_file
        self.rate_hz = rate_hz
        self._force = force
        self.overruns = 0
        self.thread_ids: tuple[int, ...] = ()
        self._link = link
        self._last_ns = 0
        self._opened = self._closed = False
        self._waiting: list[Arrival | Notice] = []
        self._lock = threading.Lock()
        # Holds one thing while something waits, or no more will come. Unlike a Condition it wakes its reader without
        # Python on either side: half of what a scan cost was waking.
        self._bell: SimpleQueue[None] = SimpleQueue()
        self._capacity_scans = capacity_scans
        self._through = False
        self._stop = threading.Event()
        self._open = ExitStack()
        self._reading: Future[None] | None = None

    def __enter__(self) -> Self:
        if self._opened:
            raise UsageError(f"source {self.name} was opened before: make another, with open_source")
        with ExitStack() as opening:
            opening.enter_context(self._link)
            refuse_emulated(self.sensor_file, self._link.kind, self._force)
            if not self.patient:
                self._begin(opening)
            self._open = opening.pop_all()
        self._opened = True
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._closed = True
        self._open.close()

    @property
    def kind(self) -> SourceKind:
        """What kind of source it is.

        Raises:
            UsageError: it was not opened yet, and some do not know before.
        """
        if not self._opened:
            raise self._not_open()
        return self._link.kind

    def counters(self) -> dict[str, int]:
        """What was received, skipped and missed so far, by name."""
        return self._link.counters()

    @property
    def unix_offset_ns(self) -> int | None:
        """Added to the time of a scan gives [ns] since 1970, 0 where nobody knows; None where it is of now."""
        return (self._link.unix_offset_ns or 0) if self.patient else None

    @property
    def origin(self) -> SourceKind | None:
        """Of a recording, what kind of source its scans come from; None where that is not known, or it is `kind`."""
        return self._link.origin

    def unix_time_s(self) -> float:
        """The time in [s] since 1970: now, or where the scans are of another time that of the last one taken."""
        offset_ns = self.unix_offset_ns
        return time.time() if offset_ns is None else (self._last_ns + offset_ns) / 1e9

    def take(self, timeout_s: float) -> list[Arrival | Notice] | None:
        """All that waits, in its order, after waiting at most `timeout_s` for something; None when no more will come.

        Raises:
            LinkLostError: and whatever else ended the reading, after all scans before it were taken.
            UsageError: it is not open: what waited when it was closed is old.
        """
        if not self._opened or self._closed:
            raise self._not_open()
        if self.patient:
            return self._take_next(timeout_s)
        if not self._through:
            try:
                self._bell.get(timeout=timeout_s)
            except Empty:
                return []
            with self._lock:
                taken, self._waiting = self._waiting, []
            if taken:
                return taken
            self._through = True
        if self._reading is not None:
            self._reading.result()
        return None

    def _not_open(self) -> UsageError:
        return UsageError(f"source {self.name} is not open: use it in a with statement")

    def _begin(self, opening: ExitStack) -> None:
        executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="scan-reader")
        opening.callback(executor.shutdown)
        opening.callback(self._stop.set)
        self.thread_ids = (executor.submit(threading.get_native_id).result(),)  # of the one thread that there is
        self._reading = executor.submit(self._read)

    def _take_next(self, timeout_s: float) -> list[Arrival | Notice] | None:
        if self._link.ended:
            return None
        scans = self._link.read(timeout_s)
        self._last_ns = scans[-1].time_ns if scans else self._last_ns
        counters = self._link.counters()
        return [*self._link.notices(), *(Arrival(scan, counters) for scan in scans)]

    def _read(self) -> None:
        try:
            while not (self._stop.is_set() or self._link.ended):
                scans = self._link.read(POLL_S)
                self._put(self._link.notices(), scans)
        finally:
            self._put(self._link.notices(), ())
            self._bell.put(None)

    def _put(self, notices: Sequence[Notice], scans: Sequence[Scan]) -> None:
        if not notices and not scans:
            return
        counters = self._link.counters()
        with self._lock:
            if not self._waiting:
                self._bell.put(None)
            self._waiting += notices
            for scan in scans:
                if len(self._waiting) >= self._capacity_scans:
                    self._make_room()
                self._waiting.append(Arrival(scan, counters))

    def _make_room(self) -> None:
        """Throw away the oldest scan; a notice stays in its place, since it parts the scans before from those after."""
        for index, heard in enumerate(self._waiting):
            if isinstance(heard, Arrival):
                del self._waiting[index]
                self.overruns += 1
                return
