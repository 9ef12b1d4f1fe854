"""Limits of the live page's connections: their number, and the bytes that each may send.

A client that sends more than a person would is cut off: its messages take the loop's time, and answers that it does not
read take memory.
"""

import asyncio
from collections.abc import Callable
from http import HTTPStatus
from typing import ClassVar, Final

from websockets.asyncio.server import ServerConnection

MOST_VIEWERS: Final = 16
MOST_CONNECTIONS: Final = 64
"""Most connections of viewers, of browsers that fetch the page, and of clients that are silent for OPEN_S."""
MOST_BYTES: Final = 1 << 14
"""Most bytes from one connection in PACE_S: a browser's request with its cookies, or some hundred commands."""
PACE_S: Final = 1.0
_GET: Final = b"GET "


class Connections:
    """All connections. Viewers keep their places; of all others the oldest makes room for the newest.

    Attributes:
        gone: connections lost since this was last set to 0.
    """

    def __init__(self, lost: Callable[[], object]) -> None:
        """Begin without a connection; `lost` is called after each that is lost."""
        self.gone = 0
        self._lost = lost
        self._all: dict[Connection, None] = {}  # in order of arrival
        self._granted: set[Connection] = set()

    def grant(self, connection: "Connection") -> bool:
        """Give a connection a viewer's place, if one is free."""
        if len(self._granted) >= MOST_VIEWERS or connection not in self._all:
            return False
        self._granted.add(connection)
        return True

    def abort(self) -> None:
        """End all connections at once, whatever is on its way to them."""
        for connection in tuple(self._all):
            connection.transport.abort()

    def add(self, connection: "Connection") -> None:
        """Count one more connection, from before its first byte."""
        self._all[connection] = None
        if len(self._all) > MOST_CONNECTIONS:
            oldest = next(other for other in self._all if other not in self._granted)
            del self._all[oldest]
            oldest.transport.abort()

    def lose(self, connection: "Connection") -> None:
        """Count one connection less."""
        self._all.pop(connection, None)
        self._granted.discard(connection)
        self.gone += 1
        self._lost()


class Connection(ServerConnection):
    """Connection that is counted by `every`; each server has a subclass of its own."""

    every: ClassVar[Connections]
    _since_s = 0.0
    _taken_bytes = 0
    _head: bytes | None = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Count the connection."""
        super().connection_made(transport)
        self.every.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Count the connection no longer."""
        super().connection_lost(exc)
        self.every.lose(self)

    def data_received(self, data: bytes) -> None:
        """Pass on the data, unless it is too much or no request for a page."""
        now_s = self.loop.time()
        if now_s - self._since_s >= PACE_S:
            self._since_s, self._taken_bytes = now_s, 0
        self._taken_bytes += len(data)
        if self._taken_bytes > MOST_BYTES:
            self.transport.abort()
            return
        if self._head is not None:
            self._look_at(data)
        super().data_received(data)

    def _look_at(self, data: bytes) -> None:
        """Refuse any method but GET here: the library hangs up without an answer on a request with a body."""
        self._head = (self._head or b"") + data[: len(_GET)]
        if not _GET.startswith(self._head[: len(_GET)]):
            self.protocol.send_response(self.protocol.reject(HTTPStatus.METHOD_NOT_ALLOWED, "only GET\n"))
        elif len(self._head) < len(_GET):
            return
        self._head = None
