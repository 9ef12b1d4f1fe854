"""Connection of one viewer, checked by pings: an answer shows that the viewer has read everything before it."""

import asyncio
import contextlib
import time
from typing import Final

from websockets.asyncio.server import ServerConnection, broadcast
from websockets.exceptions import ConnectionClosed

from edge.view.frames import Frames
from edge.view.viewer_state import Viewer

PING_S: Final = 0.25
LATE_S: Final = 0.5
"""Age of an unanswered ping, in [s], from which nothing more is sent: the frames on their way are old already."""
GONE_S: Final = 10.0


class Attended:
    """Connection that sends no more than its viewer keeps up with.

    Attributes:
        viewer: state of what it has seen.
    """

    def __init__(self, connection: ServerConnection) -> None:
        """Begin with a viewer that has seen nothing."""
        self.viewer = Viewer()
        self._connection = connection
        self._asked_s: float | None = None

    def send(self, frames: Frames, now_s: float) -> None:
        """Send what is due, unless the viewer is too slow."""
        if self._asked_s is None or now_s - self._asked_s < LATE_S:
            for frame in self.viewer.due(frames):
                broadcast([self._connection], frame)

    async def follow(self) -> None:
        """Ping the viewer again and again; end the connection of one that does not answer."""
        with contextlib.suppress(ConnectionClosed):
            while True:
                self._asked_s = time.monotonic()
                try:
                    async with asyncio.timeout(GONE_S):
                        await (await self._connection.ping())
                except TimeoutError:
                    self._connection.transport.abort()  # a regular close would wait for the viewer to read
                    return
                self._asked_s = None
                await asyncio.sleep(PING_S)
