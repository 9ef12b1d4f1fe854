"""Source of scans from links, each read in a thread of its own: nothing waits for inference or for a slow link."""

import atexit
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from queue import Empty, SimpleQueue
from typing import Any, Final, Self

from edge.errors import UsageError
from edge.pipeline.cadence import ReadingPace
from edge.pipeline.source_setup import refuse_emulated
from firmware_bridge.errors import SourceError
from firmware_bridge.links.base import Link, LinkReader, Notice, SourceKind
from firmware_bridge.poses import TimedPose
from firmware_bridge.recording.tracks import origin_of
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import POLL_S
from firmware_bridge.sensor_file.model import SensorFile

CAPACITY_SCANS: Final = 1024  # that may wait, five seconds of two sensors at 100 Hz: only a sink that hangs lets them


class Source:
    """Source that opens links, reads them and closes them; scans not taken in time are discarded, oldest first.

    Reading begins when its links are open: scans that come while a model loads wait here. Scans of one link stay in
    their order; a link that is slow or away holds up no other, and one that is lost for good ends the source. A patient
    link is read by the thread that takes, a scan at a time, so that nothing is discarded or overtaken.
    """

    def __init__(
        self,
        *links: Link,
        sensor_file: SensorFile | None = None,
        rate_hz: float | None = None,
        give_up_s: float = 0.0,
    ) -> None:
        """Prepare to read links that are not open yet, all emulated or none; one may be away for `give_up_s` [s]."""
        _one_kind(links)
        self.name = ", ".join(link.name for link in links)
        self.patient = len(links) == 1 and links[0].patient  # it waits for its reader, and its scans are not of now
        self.prefixes = tuple(link.prefix for link in links)  # of the names of each link's sensors, such as "left/"
        self.length_s = max((link.length_s for link in links if link.length_s is not None), default=None)
        self.states_poses = any(link.states_poses for link in links)
        self.sensor_file = SensorFile() if sensor_file is None else sensor_file
        self.rate_hz = rate_hz  # requested of each sensor
        self.overruns = 0  # scans discarded
        self.pace = ReadingPace()  # any thread may set it
        self._stop = threading.Event()
        self._readers = [LinkReader(link, give_up_s, sleep=self._stop.wait) for link in links]
        self.last_ns: int | None = None  # time of the last scan taken of a patient link
        self._opened = self._closed = False
        self._open = ExitStack()
        self._threads: list[threading.Thread] = []
        self._waiting: list[Scan | Notice | TimedPose] = []
        self._lock = threading.Lock()
        # Holds one item while something waits, or no more will come. Unlike a Condition it wakes its reader without
        # running Python on either side: waking was half of the cost of a scan.
        self._bell: SimpleQueue[None] = SimpleQueue()
        self._through = False
        self._reading = len(links)
        self._failed: BaseException | None = None
        self._stream: Callable[[], Any] = lambda: None  # the one that takes; one that was dropped has ended

    def __repr__(self) -> str:
        state = "closed" if self._closed else "open" if self._opened else "not open"
        return f"<Source {self.name}, {state}>"

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def open(self) -> Self:
        """Open the links and begin to read, or raise a BridgeError; `close` or the end of the program ends it."""
        if self._opened or self._closed:
            state = "opened" if self._opened else "closed"
            raise UsageError(f"source {self.name} was {state} before: make another, with open_source")
        with ExitStack() as opening:
            for reader in self._readers:
                opening.enter_context(reader)
            kind = _one_kind([reader.link for reader in self._readers])  # some know their kind only now
            refuse_emulated(self.sensor_file, kind, self.origin)
            if not self.patient:
                opening.callback(self._end_reading)
                self._threads = [self._started(reader) for reader in self._readers]
            self._open = opening.pop_all()
        atexit.register(self.close)
        self._opened = True
        return self

    def close(self) -> None:
        """End its streams, all reading and all threads, and close the links; closing twice does nothing."""
        self._closed = True
        stream = self._stream()
        if stream is not None:
            stream.close()
        atexit.unregister(self.close)
        self._open.close()

    def reserve(self, stream: Any = None) -> None:
        """Let a `Stream` take the scans from now on, or raise a UsageError if another does; None only asks."""
        before = self._stream()
        if before is not None and not before.ended:
            raise UsageError(
                f"source {self.name} has a stream already, and each would get a part of its scans: use that one, or "
                "end it with close()"
            )
        if stream is not None:
            self._stream = weakref.ref(stream)

    @property
    def kind(self) -> SourceKind:
        """Kind of source, or a UsageError before it is open, as some links learn their kind only then."""
        if not self._opened:
            raise self._not_open()
        return self._readers[0].link.kind

    def counters(self) -> dict[str, int]:
        """Return the counts of received, skipped and missed items so far, by name; sums over all links."""
        counters = self._readers[0].counters()
        for reader in self._readers[1:]:
            for name, count in reader.counters().items():
                counters[name] = counters.get(name, 0) + count
        return counters

    @property
    def unix_offset_ns(self) -> int | None:
        """Offset from scan time to [ns] since 1970, 0 if unknown; None for a live source."""
        return (self._readers[0].link.unix_offset_ns or 0) if self.patient else None

    @property
    def origin(self) -> SourceKind | None:
        """Kind of source that the scans of a recording come from; None if unknown, or equal to `kind`."""
        return origin_of(reader.link.origin for reader in self._readers)

    def unix_time_s(self) -> float:
        """Return the time in [s] since 1970: now, or for a patient source that of the last scan taken."""
        offset_ns = self.unix_offset_ns
        return time.time() if offset_ns is None else ((self.last_ns or 0) + offset_ns) / 1e9

    def take(self, timeout_s: float) -> list[Scan | Notice | TimedPose] | None:
        """Return all that waits, after at most `timeout_s`; after all scans None, or raise what ended the reading."""
        if not self._opened or self._closed:
            raise self._not_open()
        if self.patient:
            (reader,) = self._readers
            if reader.link.ended:
                return None
            scans = reader.read(timeout_s)
            self.last_ns = scans[-1].time_ns if scans else self.last_ns
            return [*reader.notices(), *reader.link.poses(), *scans]
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
        if self._failed is not None:
            raise self._failed
        return None

    def wait(self, timeout_s: float) -> None:
        """Return once something waits, or no more will come, or after `timeout_s`."""
        if self.patient or self._through:
            return
        with suppress(Empty):
            self._bell.get(timeout=timeout_s)
            self._bell.put(None)

    def _not_open(self) -> UsageError:
        return UsageError(f"source {self.name} is not open: use it in a with statement, or call open()")

    def _started(self, reader: LinkReader) -> threading.Thread:
        """Return a new thread that reads a link; its error ends all reading, and is raised by `take`."""

        def read() -> None:
            try:
                self._follow(reader)
            except BaseException as error:  # noqa: BLE001 - raised by `take`
                self._failed = self._failed or error
                self._stop.set()
            with self._lock:
                self._reading -= 1
                if not self._reading:
                    self._bell.put(None)

        # A daemon, or a program that forgets to close its source would wait for it for ever.
        thread = threading.Thread(target=read, name="scan-reader", daemon=True)
        thread.start()
        return thread

    def _end_reading(self) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def _follow(self, reader: LinkReader) -> None:
        """Read a link until it has ended, is lost for good, or all reading ends."""
        link = reader.link
        while not (self._stop.is_set() or link.ended):
            scans: Sequence[Scan] = ()
            try:
                # What it receives is taken at this source's pace, where it can wait, until it is made into scans.
                pace = self.pace
                for _ in range(pace.reads if pace.every_s and link.fetches else 0):
                    time.sleep(pace.every_s - time.monotonic() % pace.every_s)  # at the same times for all links
                    link.fetch()
                    if self.pace is not pace:
                        break
                scans = reader.read(POLL_S)
            finally:  # its notices come also before its end
                notices: list[Notice | TimedPose] = [*reader.notices()]
                if link.states_poses:
                    notices += link.poses()
                if notices or scans:
                    self._put(notices, scans)

    def _put(self, notices: Sequence[Notice | TimedPose], scans: Sequence[Scan]) -> None:
        with self._lock:
            if not self._waiting:
                self._bell.put(None)
            self._waiting += notices
            for scan in scans:
                if len(self._waiting) >= CAPACITY_SCANS:
                    self._make_room()
                self._waiting.append(scan)

    def _make_room(self) -> None:
        """Discard the oldest scan; notices keep their place, since they part the scans before from those after."""
        for index, waiting in enumerate(self._waiting):
            if isinstance(waiting, Scan):
                del self._waiting[index]
                self.overruns += 1
                return


def _one_kind(links: Sequence[Link]) -> SourceKind:
    if len({(link.kind, link.origin == "emulated") for link in links}) != 1:
        listed = ", ".join(f"{link.name} is {link.kind}{' (EMULATED)' * (link.origin == 'emulated')}" for link in links)
        raise SourceError(f"sources are of several kinds ({listed}), expected one: run them apart")
    return links[0].kind
