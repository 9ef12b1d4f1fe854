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
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from firmware_bridge.links.base import Link, Notice, Pace
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.scans.scan import Scan
from firmware_bridge.silence import POLL_S

SHORTEST_POLL_S: Final = 0.001
"""Shortest time that the system's poll can wait, which counts in milliseconds."""
UNASKED_S: Final = 0.01
"""Time between two reads of several links, in [s], until another pace is asked for: while a model loads nobody needs
their scans at once, and reading frame by frame would slow that down until the kernel had no room for more."""
_WAKES: Final = 64

HandOver = Callable[[Sequence[Notice | TimedPose], Sequence[Scan]], None]


@dataclass(slots=True)
class _Shared:
    """Link that is read in the common thread.

    Attributes:
        link: the link.
        due_s: latest time of its next read, on the monotonic clock.
        listens: False where it is not read before.
    """

    link: Link
    due_s: float = 0.0
    listens: bool = True


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
        self._links = links
        if len(links) > 1:
            self.set_pace(Pace(UNASKED_S))
        self._hand_over = hand_over
        self._on_end = on_end
        self._stop = threading.Event()
        self._waking, self._woken = socket.socketpair()
        for end in (self._waking, self._woken):
            end.setblocking(False)
        self._poll = select.poll()
        self._poll.register(self._woken, select.POLLIN)
        self._shared: dict[int, _Shared] = {}
        self._apart: dict[Future[None], tuple[Link, threading.Thread]] = {}
        # A single link may wait without regard to others.
        self._alone = links[0] if len(links) == 1 else None
        for link in links if self._alone is None else ():
            self._place(link)
        self.reading, self._thread = started("scan-reader", self._read)
        threads = [self._thread, *(thread for _, thread in self._apart.values())]
        self.thread_ids = tuple(thread.native_id for thread in threads if thread.native_id is not None)

    def set_pace(self, pace: Pace) -> None:
        """Allow scans to come late."""
        for link in self._links:
            link.set_pace(pace)

    def close(self) -> None:
        """End all reading and all threads."""
        self._stop.set()
        self._wake()
        self._thread.join()
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
            for _, thread in self._apart.values():
                thread.join()
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
            shared = self._shared.get(wait.descriptor)
            if shared is None:
                self._poll.register(wait.descriptor, select.POLLIN)
                shared = self._shared[wait.descriptor] = _Shared(link)
            if wait.listens != shared.listens:
                shared.listens = wait.listens
                self._poll.modify(wait.descriptor, select.POLLIN if wait.listens else 0)
            shared.due_s = time.monotonic() + wait.longest_s
        elif not link.ended:
            reading, thread = started("link-reader", lambda: self._follow(link))
            self._apart[reading] = link, thread
            reading.add_done_callback(lambda _: self._wake())

    def _welcome_back(self) -> None:
        """Move links that can be waited for again back into the common thread.

        Raises:
            LinkLostError: or another error that ended a link.
        """
        with suppress(BlockingIOError):
            self._woken.recv(_WAKES)
        for reading in [reading for reading in self._apart if reading.done()]:
            link, thread = self._apart.pop(reading)
            thread.join()
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
            notices: list[Notice | TimedPose] = [*link.notices()]
            if link.kind != "device":  # recordings hold poses, and the demo's robot states some
                notices += link.poses()
            if notices or scans:
                self._hand_over(notices, scans)

    def _wake(self) -> None:
        with suppress(OSError):  # it is awake already, or has ended
            self._waking.send(b"!")


def started(name: str, read: Callable[[], None]) -> tuple[Future[None], threading.Thread]:
    """Return the end of a function that a new thread runs, and the thread.

    It is a daemon, unlike one of an executor, for which a program that forgets to close its source would wait for ever.
    """
    reading: Future[None] = Future()

    def run() -> None:
        try:
            read()
        except BaseException as error:  # noqa: BLE001 - raised again where the end is awaited
            reading.set_exception(error)
        else:
            reading.set_result(None)

    thread = threading.Thread(target=run, name=name, daemon=True)
    thread.start()
    return reading, thread
