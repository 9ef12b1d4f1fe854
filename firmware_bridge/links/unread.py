"""Longest time that data may have waited to be read, by the host's clock."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from firmware_bridge.scans.scan import Scan

LONG_UNREAD_NS: Final = 50_000_000
"""Time without a read from which the process counts as stalled, in [ns]: more than twice the longest wait of a link."""
WAITED_NS: Final = 1_000_000
"""Duration of a read, in [ns], above which no data was waiting when it began."""


class Unread:
    """Tracker of the latest time at which a link was empty.

    Attributes:
        empty_ns: latest monotonic time at which its reader saw it empty, in [ns]; None before that.
    """

    def __init__(self) -> None:
        self.empty_ns: int | None = None
        self._stall_ns = 0, 0

    def found(self, begun_ns: int, ended_ns: int) -> None:
        """Note that data came during a read from `begun_ns` to `ended_ns`, in [ns] of monotonic time."""
        if self.empty_ns is not None and begun_ns - self.empty_ns > LONG_UNREAD_NS:
            return  # the process stalled: until all data is read, the duration of a read is no evidence
        if ended_ns - begun_ns > WAITED_NS:
            self.empty_ns = begun_ns

    def mark(self, scans: Sequence[Scan], time_ns: int, clock_begun_ns: int | None) -> list[Scan]:
        """Return the scans read at `time_ns` [ns], each with the longest time it may have waited, if that is long.

        A clock that was set, at `clock_begun_ns`, by data that may have waited has no reliable times: it gives none.
        """
        if self.empty_ns is not None and time_ns - self.empty_ns > LONG_UNREAD_NS:
            self._stall_ns = self.empty_ns, time_ns
        begun_ns, ended_ns = self._stall_ns
        marked: list[Scan] = []
        for scan in scans:  # one that was read then may come only now
            if begun_ns + LONG_UNREAD_NS < scan.time_ns <= ended_ns:
                no_clock = clock_begun_ns is not None and clock_begun_ns >= begun_ns
                device_ns = None if no_clock else scan.device_ns
                marked.append(replace(scan, unread_ns=scan.time_ns - begun_ns, device_ns=device_ns))
            else:
                marked.append(scan)
        return marked
