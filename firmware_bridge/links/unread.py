"""How long what comes may have lain unread, by our own clock: it knows when nobody looked."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from firmware_bridge.scans.scan import Scan

LONG_UNREAD_NS: Final = 50_000_000
"""More than twice what a link waits for at once: whoever was away for longer did not run."""
WAITED_NS: Final = 1_000_000
"""Where reading took longer than this, nothing lay there when it began."""


class Unread:
    """Follows when a link was last found empty.

    Attributes:
        empty_ns: monotonic time at which nothing lay there, as its reader last saw, in [ns]; None before.
    """

    def __init__(self) -> None:
        self.empty_ns: int | None = None

    def found(self, begun_ns: int, ended_ns: int) -> None:
        """Take it that something came while it was read from `begun_ns` to `ended_ns`."""
        if self.empty_ns is not None and begun_ns - self.empty_ns > LONG_UNREAD_NS:
            return  # nobody ran: how long this took says nothing before all of it is fetched
        if ended_ns - begun_ns > WAITED_NS:
            self.empty_ns = begun_ns

    def mark(self, scans: Sequence[Scan], time_ns: int, clock_begun_ns: int | None) -> list[Scan]:
        """Return scans, each with how long it may have lain there, where that is long.

        Args:
            scans: read at `time_ns`.
            time_ns: monotonic, in [ns].
            clock_begun_ns: as in `DeviceClock`. A clock that was set by what lay there does not know how old that is:
                its times are left out.
        """
        unread_ns = 0 if self.empty_ns is None else time_ns - self.empty_ns
        if unread_ns <= LONG_UNREAD_NS:
            return list(scans)
        if clock_begun_ns is not None and self.empty_ns is not None and clock_begun_ns >= self.empty_ns:
            return [replace(scan, unread_ns=unread_ns, device_ns=None) for scan in scans]
        return [replace(scan, unread_ns=unread_ns) for scan in scans]
