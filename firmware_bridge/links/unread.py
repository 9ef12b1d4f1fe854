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
    """Tracker of the latest time at which a link was empty."""

    def __init__(self) -> None:
        self._empty_ns: int | None = None

    def found_empty(self, time_ns: int) -> None:
        """Note that the link was empty at `time_ns` [ns] of monotonic time."""
        self._empty_ns = time_ns

    def found(self, begun_ns: int, ended_ns: int) -> None:
        """Note that data came during a read from `begun_ns` to `ended_ns`, in [ns] of monotonic time."""
        if self._empty_ns is not None and begun_ns - self._empty_ns > LONG_UNREAD_NS:
            return  # the process stalled: until all data is read, the duration of a read is no evidence
        if ended_ns - begun_ns > WAITED_NS:
            self._empty_ns = begun_ns

    def mark(self, scans: Sequence[Scan], time_ns: int) -> list[Scan]:
        """Return the scans read at `time_ns`, each with the longest time it may have waited, if that is long."""
        unread_ns = 0 if self._empty_ns is None else time_ns - self._empty_ns
        if unread_ns <= LONG_UNREAD_NS:
            return list(scans)
        return [replace(scan, unread_ns=unread_ns) for scan in scans]
