"""Another link whose scans are changed on their way; all else is its own."""

from abc import abstractmethod
from typing import Self

from firmware_bridge.links.base import Link, Notice, SerialLine, SourceKind
from firmware_bridge.scans.scan import Scan


class ChangedLink(Link):
    """Wraps a link; inherit it and say how a scan is changed.

    Attributes:
        wrapped: the link.
    """

    def __init__(self, link: Link) -> None:
        """Wrap a link that is not open yet."""
        self.name = link.name
        self.kind: SourceKind = link.kind
        self.ended = link.ended
        self.patient = link.patient
        self.unix_offset_ns = link.unix_offset_ns
        self.origin = link.origin
        self.mountings = link.mountings
        self.wrapped = link

    def __enter__(self) -> Self:
        self.wrapped.__enter__()
        self.kind = self.wrapped.kind  # some know it only now
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.wrapped.__exit__(*exc_info)

    @abstractmethod
    def _change(self, scan: Scan) -> Scan: ...

    def read(self, timeout_s: float) -> list[Scan]:
        """Scans that closed since the last call, changed; waits at most `timeout_s` for the first."""
        scans = self.wrapped.read(timeout_s)
        self.ended, self.trouble = self.wrapped.ended, self.wrapped.trouble
        return [self._change(scan) for scan in scans]

    def notices(self) -> list[Notice]:
        """The link's."""
        return self.wrapped.notices()

    def counters(self) -> dict[str, int]:
        """The link's."""
        return self.wrapped.counters()

    def can_ids(self) -> frozenset[int]:
        """Return the link's."""
        return self.wrapped.can_ids()

    def serial_line(self) -> SerialLine | None:
        """Return the link's."""
        return self.wrapped.serial_line()
