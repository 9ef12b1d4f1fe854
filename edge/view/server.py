"""Server of the live page: one thread, whose steps are short, since the loop cannot run meanwhile."""

import asyncio
import base64
import contextlib
import gc
import hashlib
import socket
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import ClassVar, Final, Self

from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response
from websockets.protocol import State

from edge.errors import SinkError
from edge.inference.contract import Contract
from edge.mapping.sink import MapState
from edge.perception.event import Event
from edge.pipeline.commands import Commands
from edge.pipeline.pose_queue import LONGEST_BYTES
from edge.pipeline.scan_reader import Source
from edge.pipeline.sink import Sink
from edge.view.access import SOCKET, grant, is_everything, own_addresses
from edge.view.frames import MOST_VIEWERS, Frames, RunSnapshot, Truth, Viewer, execute, hello, refused, state
from firmware_bridge.links.base import SourceKind

FOLDER: Final = Path(__file__).with_name("page")
SCRIPTS: Final = (
    *("drawing.js", "numbers.js", "link.js", "traces.js"),
    *("sensor.js", "map.js", "page.js"),
)
"""Files of the script in the order in which they are joined, so that they share one scope."""


def load_page() -> Response:
    """Return the page, with its style and its script inside: nothing else is fetched."""
    style = (FOLDER / "page.css").read_bytes()
    script = b"\n".join((FOLDER / name).read_bytes() for name in SCRIPTS)
    body = (FOLDER / "page.html").read_bytes()
    body = body.replace(b'<link rel="stylesheet" href="page.css">', b"<style>\n%s</style>" % style)
    body = body.replace(b' src="page.js"></script>', b">%s</script>" % script)
    headers = {
        "Content-Type": "text/html; charset=utf-8",
        "Content-Length": str(len(body)),
        "Content-Security-Policy": _policy(script),
        "Cache-Control": "no-store",
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",  # the address may hold the token
        "X-Frame-Options": "DENY",  # or a stranger's page could make a user press a button unseen
    }
    return Response(HTTPStatus.OK, HTTPStatus.OK.phrase, Headers(headers), body)


def _policy(script: bytes) -> str:
    """Return a policy that lets the page run its own script, by its hash, and talk to this server."""
    digest = base64.b64encode(hashlib.sha256(script).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


LOOPBACK: Final = "127.0.0.1"
STATE_S: Final = 1.0
OPEN_S: Final = 5.0
GONE_S: Final = 10.0  # longest time for which a viewer reads nothing until it is disconnected
TIDY_CONNECTIONS: Final = 64


class Connection(ServerConnection):
    """Connection from its first byte on.

    Lost ones are collected as garbage now and then, since the collector is off while the loop runs.
    """

    alive: ClassVar[set["Connection"]] = set()
    lost: ClassVar[int] = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Count the connection."""
        super().connection_made(transport)
        Connection.alive.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Count it no longer."""
        super().connection_lost(exc)
        Connection.alive.discard(self)
        Connection.lost += 1
        if Connection.lost % TIDY_CONNECTIONS == 0 and not gc.isenabled():
            self.loop.call_soon(gc.collect)


class LiveView:
    """Live page of a run; the port is taken at once, and pages are answered from `begin` on."""

    def __init__(self, host: str, port: int, token: str | None, contract: Contract, commands: Commands) -> None:
        """Take the port, 0 for any free one; without a token one is made where other machines can reach `host`.

        Raises a UsageError for a token that cannot be one, a SinkError where the port cannot be taken.
        """
        self._access = grant(host, socket.gethostname(), token)
        self._contract, self._commands = contract, commands
        self._messages: Callable[[Event], object] = lambda event: None
        self._page = load_page()
        self._socket = listen(host, port)
        self._thread: threading.Thread | None = None
        self._viewers: dict[ServerConnection, Viewer] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._news = asyncio.Event()
        self._ending = False
        self._source: SourceKind | None = None
        self._looked_at = threading.Event()
        self._snapshot = RunSnapshot()
        self._snapshot.wake = self._wake_if_watched
        self.sinks: list[Sink] = [self._snapshot]  # which the loop writes to; they never fail
        addresses = own_addresses() if is_everything(host) and ":" not in host else []
        self.url, *self.other_urls = self._access.urls(self._socket.getsockname()[1], addresses)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Inform viewers that the run has ended, and free the port."""
        self._ending = True
        self._wake()
        if self._thread is not None:
            self._thread.join()
        self._socket.close()

    def begin(
        self,
        source: Source,
        model: str,
        messages: Callable[[Event], object],
        looked_at: threading.Event | None = None,
    ) -> None:
        """Answer requests from now on, about an open source and the model that the run begins with.

        If the page ends early its thread calls `messages`; `looked_at` is set with the first viewer.
        """
        self._messages, self._source = messages, source.kind
        self._looked_at = looked_at or self._looked_at
        ready = threading.Event()
        first = hello(source, model, self._contract)
        self._thread = threading.Thread(target=self._serve, args=(first, ready), name="live-view")
        self._thread.start()
        ready.wait()

    def show_map(self, state: MapState) -> None:
        """Show a state of the map. Never waits."""
        self._snapshot.map = state
        self._wake_if_watched()

    def show_truth(self, truth_of: Truth) -> None:
        """Show the true pattern (H, W) of each result that has one, as a simulation states it."""
        self._snapshot.truth_of = truth_of

    def _wake_if_watched(self) -> None:
        if self._viewers:
            self._wake()

    def _wake(self) -> None:
        loop = self._loop
        if loop is not None:
            with contextlib.suppress(RuntimeError):  # it has ended at that moment
                loop.call_soon_threadsafe(self._news.set)

    def _serve(self, first: bytes, ready: threading.Event) -> None:
        try:
            asyncio.run(self._show(first, ready))
        finally:  # also after an unforeseen error, which ends this thread and not the run
            self._loop = None
            ready.set()
            if not self._ending:
                why = f"the live page has ended: {sys.exception()!r}; the run continues"
                self._messages(Event(time.monotonic_ns(), "trouble", None, why))

    async def _show(self, first: bytes, ready: threading.Event) -> None:
        self._loop = asyncio.get_running_loop()
        async with serve(
            partial(self._attend, first),
            sock=self._socket,
            process_request=self._answer,
            create_connection=Connection,
            compression=None,  # it would cost time 25 times a second, for a reader close by
            server_header=None,
            open_timeout=OPEN_S,
            ping_interval=None,  # a viewer is pinged more often
            close_timeout=1.0,
            max_size=LONGEST_BYTES,
        ) as server:
            ready.set()
            sent: tuple[object, ...] = ()
            sent_s = 0.0
            while not self._ending:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(STATE_S if self._viewers else None):
                        await self._news.wait()
                self._news.clear()
                frames = Frames(self._snapshot, time.monotonic_ns(), self._source)
                silent, now_s = frames.silent(), time.monotonic()
                new_state = len(self._viewers), tuple(silent)
                if new_state != sent or now_s - sent_s >= STATE_S:
                    sent, sent_s = new_state, now_s
                    broadcast(self._viewers, state(len(self._viewers), silent))
                for connection, viewer in self._viewers.items():
                    for frame in viewer.due(frames) if viewer.keeps_up(now_s) else ():
                        broadcast([connection], frame)
            server.close(code=CloseCode.GOING_AWAY, reason="the run has ended")
            # Of clients that say nothing, and viewers that do not read that the run has ended.
            for connection in tuple(Connection.alive):
                if connection.server is server:
                    self._loop.call_later(0.5, connection.transport.abort)

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        headers = request.headers
        refusal = self._access.refusal(request.path, headers.get_all("Host"), headers.get_all("Origin"))
        if refusal is not None:
            status, why = refusal
            return connection.respond(status, f"{why}\n")
        return None if request.path.partition("?")[0] == SOCKET else self._page

    async def _attend(self, first: bytes, connection: ServerConnection) -> None:
        if len(self._viewers) >= MOST_VIEWERS:
            await connection.close(CloseCode.TRY_AGAIN_LATER, f"too many viewers ({MOST_VIEWERS}): close one")
            return
        viewer = self._viewers[connection] = Viewer()
        self._looked_at.set()
        broadcast([connection], first)
        self._news.set()
        pinging = asyncio.create_task(_follow(connection, viewer))
        try:
            async for message in connection:
                if connection.state is not State.OPEN:
                    break  # many commands may wait from before it closed, and each takes its time
                why = execute(message, self._commands)
                if why is not None:
                    broadcast([connection], refused(time.monotonic_ns(), why, self._source))
                await asyncio.sleep(0.02)  # so that who never stops asking does not delay the loop
        except ConnectionClosed:
            pass
        finally:
            del self._viewers[connection]
            pinging.cancel()
            self._news.set()


async def _follow(connection: ServerConnection, viewer: Viewer) -> None:
    """Ping a viewer again and again; end the connection of one that does not answer."""
    with contextlib.suppress(ConnectionClosed):
        while True:
            viewer.pinged_s = time.monotonic()
            try:
                async with asyncio.timeout(GONE_S):
                    await (await connection.ping())
            except TimeoutError:
                connection.transport.abort()  # a regular close would wait for the viewer to read
                return
            viewer.pinged_s = None
            await asyncio.sleep(0.25)


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens there; SinkError if it cannot."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.create_server((str(address[0]), port), family=family)
        # Inherited by connections: else a small frame waits 40 ms for the one before it to be acknowledged.
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return listening
    except OSError as error:
        remedy = "name another port with --view, 0 for any free one, or an address of this machine with --view-host"
        why = str(error.strerror).partition(" (while")[0]  # Python adds the address again
        raise SinkError(f"no live page: cannot listen on {host}:{port}: {why}; {remedy}") from error
