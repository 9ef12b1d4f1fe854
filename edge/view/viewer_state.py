"""State of one viewer: what it has seen, and the frames that are due. No I/O, no clock."""

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

    def due(self, frames: Frames) -> list[bytes]:
        """Return the frames that are new since the last call: events, and unless paused one frame a sensor."""
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
        return due
