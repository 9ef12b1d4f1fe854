"""Another link, each sensor's taxels put where they lie on the pad: for links that bring scans whole."""

from collections.abc import Mapping
from typing import Self

from firmware_bridge.links.base import Link, Notice, SourceKind
from firmware_bridge.mounting import Mounting
from firmware_bridge.scan import Scan


class PlacedLink(Link):
    """A link whose scans come in the order of an id map, which no CAN id tells any more.

    Links that sort readings by their id take `placed_map` instead, which costs nothing.
    """

    def __init__(self, link: Link, mountings: Mapping[str, Mounting]) -> None:
        """Prepare a link; `mountings` are by sensor name."""
        self.name = link.name
        self.kind: SourceKind = link.kind
        self.ended = link.ended
        self._link = link
        self._mountings = dict(mountings)

    def __enter__(self) -> Self:
        self._link.__enter__()
        self.kind = self._link.kind
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._link.__exit__(*exc_info)

    def read(self, timeout_s: float) -> list[Scan]:
        """Scans since the last call, in place; waits at most `timeout_s` for the first."""
        scans = self._link.read(timeout_s)
        self.ended, self.trouble = self._link.ended, self._link.trouble
        return [self._mountings[scan.sensor].place(scan) if scan.sensor in self._mountings else scan for scan in scans]

    def notices(self) -> list[Notice]:
        """Those of the other link."""
        return self._link.notices()

    def counters(self) -> dict[str, int]:
        """Those of the other link."""
        return self._link.counters()
