"""State of one viewer: what it has seen, and the frames that are due. No I/O, no clock."""

from edge.mapping.live_map import MapState
from edge.view.frames import Frames


class Viewer:
    """Viewer of the page; every frame holds the newest values, however long ago the frame before was sent.

    Attributes:
        paused: no results meanwhile; events go on.
    """

    def __init__(self) -> None:
        self.paused = False
        self._seen: dict[str, int] = {}
        self._sent_number = 0
        self._seen_map: MapState | None = None

    def due(self, frames: Frames) -> list[bytes]:
        """Return the frames that are new since the last call.

        These are events, and unless the viewer has paused one frame a sensor and one of the map.
        """
        due: list[bytes] = []
        for number, frame in frames.events(self._sent_number):
            self._sent_number = number
            due.append(frame)
        if self.paused:
            return due
        for sensor, number in frames.numbers.items():
            seen = self._seen.get(sensor, 0)
            if number > seen:
                due.append(frames.result(sensor, seen))
                self._seen[sensor] = number
        if frames.map is not None and frames.map is not self._seen_map:
            due.append(frames.map_since(self._seen_map))
            self._seen_map = frames.map
        return due
