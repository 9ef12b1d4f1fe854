"""Reader of links, next to the user of their scans: in one thread, however many links there are.

The system reports which link has something to read. Where it cannot (gs_usb, python-can, the vendor's server, a
recording, the demo), each of several links has a thread of its own, and so has a link that is away, until it is back:
opening one may take seconds and must not hold up the others.
"""

import math
import select
import socket
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from firmware_bridge.links.base import Link, Notice
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.scans.scan import Scan
from firmware_bridge.silence import POLL_S

SHORTEST_POLL_S: Final = 0.001
"""Shortest time that the system's poll can wait, which counts in milliseconds."""
_WAKES: Final = 64

HandOver = Callable[[Sequence[Notice | TimedPose], Sequence[Scan]], None]


@dataclass(slots=True)
class _Shared:
    """Link that is read in the common thread, and the latest time of its next read on the monotonic clock."""

    link: Link
    due_s: float


class LinkReader:
    """Reader of open links until all have ended, one is lost for good, or it is closed.

    Attributes:
        thread_ids: system's numbers of the threads that it begins with.
        reading: done when all is handed over; its exception is that of the first link that failed.
    """

    def __init__(self, links: Sequence[Link], hand_over: HandOver, on_end: Callable[[], object]) -> None:
        """Begin to read.

        Args:
            links: open.
            hand_over: takes the notices and poses of one link and then its scans; called from several threads.
            on_end: called when all is handed over, just before `reading` is done.
        """
        self._hand_over = hand_over
        self._on_end = on_end
        self._stop = threading.Event()
        self._waking, self._woken = socket.socketpair()
        for end in (self._waking, self._woken):
            end.setblocking(False)
        self._poll = select.poll()
        self._poll.register(self._woken, select.POLLIN)
        self._shared: dict[int, _Shared] = {}
        self._apart: dict[Future[None], tuple[Link, ThreadPoolExecutor, int]] = {}
        # A single link may wait without regard to others.
        self._alone = links[0] if len(links) == 1 else None
        self._executor, thread_id = _new_thread("scan-reader")
        for link in links if self._alone is None else ():
            self._place(link)
        self.thread_ids = (thread_id, *(apart_id for _, _, apart_id in self._apart.values()))
        self.reading = self._executor.submit(self._read)

    def close(self) -> None:
        """End all reading and all threads."""
        self._stop.set()
        self._wake()
        self._executor.shutdown()
        self._waking.close()
        self._woken.close()

    def _read(self) -> None:
        try:
            if self._alone is not None:
                self._follow(self._alone)
            while not self._stop.is_set() and (self._shared or self._apart):
                self._take_turns()
        finally:
            self._stop.set()
            for _, executor, _ in self._apart.values():
                executor.shutdown()
            self._on_end()

    def _take_turns(self) -> None:
        """Wait until links have something to read, and read them."""
        due_s = min((shared.due_s for shared in self._shared.values()), default=math.inf)
        left_s = min(max(due_s - time.monotonic(), 0.0), POLL_S)
        if 0 < left_s < SHORTEST_POLL_S:
            time.sleep(left_s)
            left_s = 0
        ready = {descriptor for descriptor, _ in self._poll.poll(1000 * left_s)}
        if self._woken.fileno() in ready:
            self._welcome_back()
        now_s = time.monotonic()
        for descriptor, shared in list(self._shared.items()):
            if descriptor in ready or shared.due_s <= now_s:
                self._take(shared.link, 0)
                self._place(shared.link, descriptor)

    def _place(self, link: Link, before: int | None = None) -> None:
        """Assign a link to the thread that can wait for it; `before` is its earlier descriptor in the common thread."""
        wait = None if link.ended else link.wait_on()
        if before is not None and (wait is None or wait.descriptor != before):
            self._poll.unregister(before)
            del self._shared[before]
        if wait is not None:
            if wait.descriptor not in self._shared:
                self._poll.register(wait.descriptor, select.POLLIN)
            self._shared[wait.descriptor] = _Shared(link, time.monotonic() + wait.longest_s)
        elif not link.ended:
            executor, thread_id = _new_thread("link-reader")
            reading = executor.submit(self._follow, link)
            self._apart[reading] = link, executor, thread_id
            reading.add_done_callback(lambda _: self._wake())

    def _welcome_back(self) -> None:
        """Move links that can be waited for again back into the common thread.

        Raises:
            LinkLostError: or another error that ended a link.
        """
        with suppress(BlockingIOError):
            self._woken.recv(_WAKES)
        for reading in [reading for reading in self._apart if reading.done()]:
            link, executor, _ = self._apart.pop(reading)
            executor.shutdown()
            reading.result()
            self._place(link)

    def _follow(self, link: Link) -> None:
        """Read one link until it has ended, or can be waited for together with others."""
        while not (self._stop.is_set() or link.ended):
            self._take(link, POLL_S)
            if self._alone is None and link.wait_on() is not None:
                return

    def _take(self, link: Link, timeout_s: float) -> None:
        scans: Sequence[Scan] = ()
        try:
            scans = link.read(timeout_s)
        finally:  # its notices come also before its end
            notices = [*link.notices(), *link.poses()]
            if notices or scans:
                self._hand_over(notices, scans)

    def _wake(self) -> None:
        with suppress(OSError):  # it is awake already, or has ended
            self._waking.send(b"!")


def _new_thread(name: str) -> tuple[ThreadPoolExecutor, int]:
    """Return an executor of one thread, and the system's number of the thread."""
    executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix=name)
    return executor, executor.submit(threading.get_native_id).result()
