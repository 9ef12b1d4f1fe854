"""Several links as one: each read in a thread of its own, its sensors named after it."""

import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
from typing import Final

from firmware_bridge.errors import SourceError
from firmware_bridge.links.base import Link, Notice, SourceKind, one_origin
from firmware_bridge.links.wrapper import ChangedLink
from firmware_bridge.scans.scan import Scan

POLL_S: Final = 0.1


class NamedLink(ChangedLink):
    """A link whose sensors bear its name: sensor "4" of "left" is "left/4"."""

    def __init__(self, name: str, link: Link) -> None:
        super().__init__(link)
        self._prefix = name
        self.mountings = {f"{name}/{sensor}": one for sensor, one in link.mountings.items()}

    def _change(self, scan: Scan) -> Scan:
        return replace(scan, sensor=f"{self._prefix}/{scan.sensor}")

    def notices(self) -> list[Notice]:
        """The link's, under the user's name for it."""
        return [
            notice._replace(sensors=f"{self._prefix}/{notice.sensors}", text=f"{self._prefix}: {notice.text}")
            for notice in super().notices()
        ]


class SeveralLinks(Link):
    """Reads links side by side; one that is slow or lost holds up no other."""

    def __init__(self, links: Sequence[Link]) -> None:
        """Wrap links that are not open yet.

        Raises:
            SourceError: some pretend and some do not: results of both kinds must not be taken for one.
        """
        self.name = ", ".join(link.name for link in links)
        self.kind: SourceKind = _one_kind(links)
        self.ended = False
        self.origin = one_origin(link.origin for link in links)
        self.mountings = {name: one for link in links for name, one in link.mountings.items()}
        self._links = links
        self._heard: SimpleQueue[Notice | Scan | None] = SimpleQueue()
        self._open = ExitStack()
        self._stop = threading.Event()
        self._readings: list[Future[None]] = []
        self._notices: list[Notice] = []
        self._put_back: list[Notice | None] = []

    def __enter__(self) -> "SeveralLinks":
        with ExitStack() as opening:
            for link in self._links:
                opening.enter_context(link)
            self.kind = _one_kind(self._links)  # some know it only now
            self._open = opening.pop_all()
        executor = ThreadPoolExecutor(max_workers=len(self._links), thread_name_prefix="link-reader")
        self._open.callback(executor.shutdown)
        self._open.callback(self._stop.set)
        self._readings = [executor.submit(self._read, link) for link in self._links]
        for reading in self._readings:
            # By the reading and not within it: whoever meets the marker must find how the reading ended.
            reading.add_done_callback(lambda _: self._heard.put(None))
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._open.close()

    def read(self, timeout_s: float) -> list[Scan]:
        """Scans that closed since the last call on any link; waits at most `timeout_s` for the first.

        Raises:
            LinkLostError: of the first link that gave up.
        """
        scans: list[Scan] = []
        end_s = time.monotonic() + timeout_s
        with suppress(Empty):
            while True:
                heard = self._next_heard(0 if scans else max(end_s - time.monotonic(), 0))
                if isinstance(heard, Scan):
                    scans.append(heard)
                elif scans:  # what is told comes before the scans that are given with it
                    self._put_back = [heard]
                    break
                elif heard is not None:
                    self._notices.append(heard)
                else:
                    self._raise_what_ended_one()
        self.trouble = "; ".join(link.trouble for link in self._links if link.trouble is not None) or None
        through = all(reading.done() for reading in self._readings)  # asked first: nothing is put behind the markers
        self.ended = through and not scans and not self._put_back and self._heard.empty()
        if self.ended:
            self._raise_what_ended_one()  # its marker may be on its way
        return scans

    def _raise_what_ended_one(self) -> None:
        for reading in self._readings:
            if reading.done():
                reading.result()

    def _next_heard(self, timeout_s: float) -> Notice | Scan | None:
        return self._put_back.pop() if self._put_back else self._heard.get(timeout=timeout_s)

    def notices(self) -> list[Notice]:
        """What happened to any link since the last call."""
        notices, self._notices = self._notices, []
        return notices

    def counters(self) -> dict[str, int]:
        """Sums over all links."""
        sums: dict[str, int] = {}
        for link in self._links:
            for name, count in link.counters().items():
                sums[name] = sums.get(name, 0) + count
        return sums

    def _read(self, link: Link) -> None:
        while not (self._stop.is_set() or link.ended):
            scans = link.read(POLL_S)
            for heard in (*link.notices(), *scans):
                self._heard.put(heard)


def _one_kind(links: Sequence[Link]) -> SourceKind:
    kinds: set[SourceKind] = {link.kind for link in links}
    if len(kinds) != 1:
        listed = ", ".join(f"{link.name} is {link.kind}" for link in links)
        raise SourceError(f"sources are of several kinds ({listed}), expected one: run them apart")
    return kinds.pop()
