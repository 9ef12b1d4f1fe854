"""Another link, each sensor's taxels put where they lie on the pad: for links that bring scans whole."""

from collections.abc import Mapping

from firmware_bridge.links.base import Link
from firmware_bridge.links.wrapper import ChangedLink
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan


class PlacedLink(ChangedLink):
    """A link whose scans come in the order of an id map, which no CAN id tells any more.

    Links that sort readings by their id take `placed_map` instead, which costs nothing.
    """

    def __init__(self, link: Link, mountings: Mapping[str, Mounting]) -> None:
        """Prepare a link; `mountings` are by sensor name."""
        super().__init__(link)
        self._mountings = dict(mountings)

    def _change(self, scan: Scan) -> Scan:
        mounting = self._mountings.get(scan.sensor)
        return scan if mounting is None else mounting.place(scan)
