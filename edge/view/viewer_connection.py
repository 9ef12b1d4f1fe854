"""One viewer's connection, followed by pings: an answer says that all before it was read."""

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
"""Since a ping that a viewer has not answered: what lies on its way is old, and nothing is put behind it."""
GONE_S: Final = 10.0


class Attended:
    """A viewer that is sent what it keeps up with.

    Attributes:
        viewer: what it has seen.
    """

    def __init__(self, connection: ServerConnection) -> None:
        """Begin with a viewer that has seen nothing."""
        self.viewer = Viewer()
        self._connection = connection
        self._asked_s: float | None = None

    def send(self, frames: Frames, now_s: float) -> None:
        """Send what is due, unless the viewer is behind."""
        if self._asked_s is None or now_s - self._asked_s < LATE_S:
            for frame in self.viewer.due(frames):
                broadcast([self._connection], frame)

    async def follow(self) -> None:
        """Ask again and again whether the viewer has read everything; end the connection of one that does not."""
        with contextlib.suppress(ConnectionClosed):
            while True:
                self._asked_s = time.monotonic()
                try:
                    async with asyncio.timeout(GONE_S):
                        await (await self._connection.ping())
                except TimeoutError:
                    self._connection.transport.abort()  # to close it would wait until it has read
                    return
                self._asked_s = None
                await asyncio.sleep(PING_S)
