"""Viewers of the live page: what each has seen, is sent and asks for.

A client that sends more than a person would is cut off: its messages take the loop's time, and answers that it does not
read take memory.
"""

import asyncio
import contextlib
import gc
import math
import time
from http import HTTPStatus
from typing import Any, ClassVar, Final

from websockets.asyncio.server import ServerConnection, broadcast
from websockets.exceptions import ConnectionClosed

from edge.mapping.sink import MapState
from edge.pipeline.commands import WAITING, Command, Commands, runtime_command
from edge.pipeline.pose_queue import json_object
from edge.validation import as_float
from edge.view.frames import Frames
from firmware_bridge.links.replay_player import Player

MOST_VIEWERS: Final = 16
MOST_CONNECTIONS: Final = 64
"""Most connections of viewers, of browsers that fetch the page, and of clients that are silent for OPEN_S."""
_GET: Final = b"GET "


TIDY_S: Final = 10.0
_TIDY_CONNECTIONS: Final = 64


class Connections:
    """All connections. Viewers keep their places; of all others the oldest makes room for the newest."""

    def __init__(self) -> None:
        self._gone = 0  # since the last tidying up
        self._due: asyncio.TimerHandle | None = None  # the next one
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
        self._gone += 1
        if self._gone == _TIDY_CONNECTIONS:
            connection.loop.call_soon(self._tidy, connection.loop)
        elif self._due is None:
            self._due = connection.loop.call_later(TIDY_S, self._tidy, connection.loop)

    def _tidy(self, loop: asyncio.AbstractEventLoop) -> None:
        """Collect the garbage of lost connections, since the collector is off while the loop runs.

        Those that are still closing are collected a while later, also where no further one is lost.
        """
        if self._due is not None:
            self._due.cancel()
        self._due = loop.call_later(TIDY_S, self._tidy, loop) if self._gone else None
        self._gone = 0
        if not gc.isenabled():
            gc.collect()


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
        if now_s - self._since_s >= 1.0:
            self._since_s, self._taken_bytes = now_s, 0
        self._taken_bytes += len(data)
        if self._taken_bytes > 1 << 14:  # in a second: a browser's request with its cookies, or some hundred commands
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


LATE_S: Final = 0.5
"""Age of an unanswered ping, in [s], from which nothing more is sent: the frames on their way are old already."""
GONE_S: Final = 10.0
_FORMS: Final = (
    '{"cmd": "zero"} with "sensor" and "force" as wanted, {"cmd": "reset"}, {"cmd": "record", "on": true}, '
    '{"cmd": "pause", "on": true}; of a recording {"cmd": "play", "at_s": 1.5} with "speed" and "on" as wanted'
)


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


class AttendedViewer(Viewer):
    """Viewer at a connection, who is sent no more than it keeps up with: an answered ping shows what it has read."""

    def __init__(self, connection: ServerConnection) -> None:
        super().__init__()
        self._connection = connection
        self._asked_s: float | None = None

    def send(self, frames: Frames, now_s: float) -> None:
        """Send what is due, unless the viewer is too slow."""
        if self._asked_s is None or now_s - self._asked_s < LATE_S:
            for frame in self.due(frames):
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
                await asyncio.sleep(0.25)


def execute(message: str | bytes, viewer: Viewer, commands: Commands, player: Player | None = None) -> str | None:
    """Queue the command in a viewer's message, JSON as on stdin or of the page alone, or steer the player.

    Returns the reason if it is refused.
    """
    why = _refusal(message, viewer, commands, player)
    if why is not None:
        commands.refuse()
    return why


def _refusal(message: str | bytes, viewer: Viewer, commands: Commands, player: Player | None) -> str | None:
    parsed = json_object(message) if isinstance(message, str) else None
    if parsed is None:
        return f"{_shown(message)} is not a JSON object: expected {_FORMS}"
    name = parsed.get("cmd")
    if name == "play":
        return _play(parsed, message, player)
    if name in ("record", "pause"):
        on = parsed.get("on")
        if not isinstance(on, bool) or parsed.keys() != {"cmd", "on"}:
            return f'{_shown(message)} does not state whether to {name}: expected {{"cmd": "{name}", "on": true}}'
        if name == "pause":
            viewer.paused = on
            return None
        command = Command("record", on=on)
    else:
        command = runtime_command(parsed)
    if command is None:
        return f"{_shown(message)} is not a command: expected {_FORMS}"
    if commands.full:
        return f"{WAITING} commands are waiting: repeat it when the run has executed them"
    commands.put(command)
    return None


def _play(parsed: dict[str, Any], message: str | bytes, player: Player | None) -> str | None:
    """Steer the player; returns the reason if it is refused."""
    if player is None:
        return "no recording is played that a page can steer"
    at_s, speed, on = (parsed.get(key) for key in ("at_s", "speed", "on"))
    floats = [as_float(one) for one in (at_s, speed) if one is not None]
    numbers = all(one is not None and math.isfinite(one) for one in floats)
    known = parsed.keys() <= {"cmd", "at_s", "speed", "on"} and (on is None or isinstance(on, bool))
    if not (numbers and known and (speed is None or speed > 0)):
        return f'{_shown(message)}: expected {{"cmd": "play"}} with numbers "at_s", "speed", and "on": true or false'
    if speed is not None:
        player.set_speed(float(speed))
    if on is not None:
        player.pause(on=not on)
    if at_s is not None:
        player.jump(float(at_s))
    return None


def _shown(message: str | bytes) -> str:
    shown = repr(message[:60])
    return shown if len(message) <= 60 else f"{shown[:-1]}...{shown[-1]}"
