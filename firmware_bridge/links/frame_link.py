"""Link to an adapter that gives frames one by one, for gs_usb and python-can."""

import threading
from collections.abc import Callable
from typing import Any

from firmware_bridge.links.base import Link, Unread
from firmware_bridge.scans.frame_scans import FrameScans
from firmware_bridge.scans.scan import Scan


class FrameLink(Link):
    """Link to an adapter that gives frames one by one, which is asked for them until a scan closes."""

    def __init__(self, scans: FrameScans, clock_ns: Callable[[], int]) -> None:
        self._stages = scans
        self._clock_ns = clock_ns
        self._unread = Unread()
        self._counting = threading.Lock()  # counters are of whole pieces, whichever thread asks

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; raises LinkLostError if the adapter is gone."""
        now_ns = self._clock_ns()
        end_ns = now_ns + int(timeout_s * 1e9)
        while True:
            begun_ns, scans = self._clock_ns(), list[Scan]()
            piece = self._fetch(max(0.0, (end_ns - now_ns) / 1e9))
            now_ns = self._clock_ns()
            if piece is None:
                self._unread.empty_ns = min(now_ns, end_ns)  # this thread may not have run for long after the wait
            else:
                self._unread.note_data(begun_ns, now_ns)
                with self._counting:
                    fed = self._take(piece, now_ns)
                scans = self._unread.mark(fed, now_ns, self._stages.clock.begun_ns)
            self.trouble = self._stages.errors.trouble(now_ns)
            self.stamps_dropped |= self._stages.clock.dropped
            if scans or now_ns >= end_ns:
                return scans

    def can_ids(self) -> frozenset[int]:
        """Return the standard CAN ids received so far."""
        return self._stages.assembler.can_ids

    def _fetch(self, timeout_s: float) -> Any:
        """Return the next piece, None if none came in time."""
        raise NotImplementedError

    def _take(self, piece: Any, time_ns: int) -> list[Scan]:
        """Return the scans that close within a piece."""
        raise NotImplementedError
