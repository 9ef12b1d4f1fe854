"""Link to the vendor's server, over WebSocket."""

import socket
import threading
import time
from collections.abc import Mapping
from threading import Event
from types import MappingProxyType
from typing import Final, Self
from urllib.parse import urlsplit

from websockets.exceptions import ConnectionClosed, InvalidHandshake, WebSocketException
from websockets.sync.client import ClientConnection, connect

from firmware_bridge.errors import DeviceError, LinkLostError, SourceError
from firmware_bridge.links.base import Link, SourceKind, not_open
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.xela_server_messages import LONGEST_MESSAGE_BYTES, PRETENDED_VERSION
from firmware_bridge.scans.xela_server_scans import ServerScans
from firmware_bridge.schedule import NS_PER_S, SERVER_QUIET_S

OPENING_S: Final = 3.0
REOPENING_S: Final = 1.0  # time-out of a reopening, in [s]: a server that hangs must not delay other sources for longer
ANSWER_S: Final = 1.0
"""Time-out of a ping, in [s]: a link read by itself reports a pulled cable, or a server that hangs, after 1.75 s
without a message. Its reader reopens it before that, and a server that hangs then fails in the handshake."""


class XelaServerLink(Link):
    """Link to the vendor's xela_server, with all its sensors of the right geometry.

    A server does not report its simulation mode: its scans then count as a device's.

    Attributes:
        url: URL of the server.
        version: version that the server reports.
        trouble: sensors that are left out or silent, and readings that are old.
    """

    def __init__(
        self,
        url: str,
        *,
        geometry: SensorGeometry = USPA44,
        prefix: str = "",
        mountings: Mapping[str, Mounting] = MappingProxyType({}),
    ) -> None:
        """Prepare a link to ws://HOST[:PORT], for sensors of this geometry; raises SourceError for another URL.

        `prefix` begins the names of its sensors; `mountings`, by these names, put taxels and the server's forces right.
        """
        self._address = server_address(url)
        self.name = f"xela-server:{url}"
        self.kind: SourceKind = "device"
        self.url = self._address[2]
        self._scans = ServerScans(geometry, prefix, mountings)
        self._counting = threading.Lock()  # counters are of whole pieces, whichever thread asks
        self._received_bytes = 0
        self._connection: ClientConnection | None = None
        self._met = False
        self._received_ns = 0
        self._pong: tuple[Event, int] | None = None
        self._first: list[Scan] = []

    @property
    def version(self) -> str:
        """Version that the server reports; empty until it has."""
        return self._scans.version

    def __enter__(self) -> Self:
        self._scans.begin()
        self._pong = None
        self._connection = self._connect()
        self._received_ns = time.monotonic_ns()
        try:
            self._first = self._take(self._connection, 0.5)  # a server greets at once; no message is no error
        except BaseException:
            self.__exit__()
            raise
        self._met = True
        self.kind = "emulated" if self.version.endswith(PRETENDED_VERSION) else "device"
        return self

    def __exit__(self, *exc_info: object) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; waits at most `timeout_s` for the first message.

        Raises:
            LinkLostError: the server is gone, or fell silent and does not answer.
            DeviceError: it has no sensor that can be used.
        """
        if self._connection is None:
            raise not_open()
        if self._first:
            first, self._first = self._first, []
            return first
        return self._take(self._connection, timeout_s)

    def counters(self) -> dict[str, int]:
        """Return the count of received bytes, and the counters of decoder and scans."""
        with self._counting:
            return {"received_bytes": self._received_bytes} | self._scans.counters()

    def _take(self, connection: ClientConnection, timeout_s: float) -> list[Scan]:
        scans: list[Scan] = []
        try:
            try:
                for _ in range(64):  # later messages wait for the next read
                    message = connection.recv(timeout_s, decode=False)
                    timeout_s = 0
                    self._received_ns, self._pong = time.monotonic_ns(), None
                    with self._counting:
                        self._received_bytes += len(message)
                        scans += self._scans.feed(message, self._received_ns)
            except TimeoutError:
                self._watch(connection)  # raises at times, if the connection has just closed
        except ConnectionClosed as error:
            if scans:  # scans from before the end count; the next read reports the end
                return scans
            raise LinkLostError(f"{self.url}: link lost: {_ending(error)}") from error
        self.trouble = self._scans.trouble
        if not self._scans.usable:
            raise DeviceError(f"{self.url}: no sensor that can be used: {self.trouble}")
        return scans

    def _watch(self, connection: ClientConnection) -> None:
        """Ping a server that sends no message: a connection can be dead without being closed."""
        now_ns = time.monotonic_ns()
        if self._pong is None:
            if now_ns - self._received_ns >= SERVER_QUIET_S * NS_PER_S:
                self._pong = connection.ping(), now_ns
        elif self._pong[0].is_set():
            self._received_ns, self._pong = now_ns, None
        elif now_ns - self._pong[1] >= ANSWER_S * NS_PER_S:
            raise LinkLostError(
                f"{self.url}: link lost: silent, and no answer within {ANSWER_S:g} s: the network or the server hangs"
            )

    def _connect(self) -> ClientConnection:
        host, port, url = self._address
        opening_s = REOPENING_S if self._met else OPENING_S
        try:
            plain = socket.create_connection((host, port), opening_s)
        except (OSError, UnicodeError) as error:
            raise DeviceError(f"{url}: {_unreachable(host, error, opening_s)}") from error
        try:
            # The server is on this machine or near it: no proxy, and no compression, which costs time on both sides.
            # No pings by websockets: it would drop a server that sends messages but answers no ping.
            return connect(
                url,
                sock=plain,
                proxy=None,
                compression=None,
                open_timeout=opening_s,
                close_timeout=0.2,
                ping_interval=None,
                max_size=LONGEST_MESSAGE_BYTES,
            ).__enter__()  # websockets warns of a connection that was not entered
        except (OSError, WebSocketException, ValueError) as error:
            raise DeviceError(f"{url}: {_no_handshake(error, opening_s)}") from error


def server_address(url: str) -> tuple[str, int, str]:
    """Parse ws://HOST[:PORT] into host, port (5000 by default) and URL; raises SourceError on any other form."""
    expected = "expected ws://HOST or ws://HOST:PORT"
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, 5000 if parts.port is None else parts.port
    except ValueError as error:
        raise SourceError(f"address of the xela_server is {url!r}, {expected}: {error}") from error
    if parts.scheme == "wss":
        raise SourceError(f"address of the xela_server is {url!r}: it does not speak TLS, {expected}")
    extra = parts.username is not None or parts.query or parts.fragment or parts.path not in ("", "/")
    if parts.scheme != "ws" or not host or not port or extra or not url.isprintable() or " " in url:
        raise SourceError(f"address of the xela_server is {url!r}, {expected}")
    return host, port, f"ws://{f'[{host}]' if ':' in host else host}:{port}"


def _unreachable(host: str, error: OSError | UnicodeError, opening_s: float) -> str:
    if isinstance(error, ConnectionRefusedError):
        remedy = "start xela_server there, or name its port"
        if host in ("localhost", "::1") or host.startswith("127."):
            remedy += "; some versions (1.7.6) listen on the machine's own address alone: see hostname -I"
        return f"connection refused: {remedy}"
    if isinstance(error, (socket.gaierror, UnicodeError)):  # UnicodeError: a name that is invalid in the DNS
        return "no such host: name it by its IP address, or see that it is in the DNS"
    if isinstance(error, TimeoutError):
        return f"no answer within {opening_s:g} s: is the machine on, on this network, and its firewall open?"
    return f"cannot be reached: {error.strerror or error}"


def _no_handshake(error: Exception, opening_s: float) -> str:
    if isinstance(error, TimeoutError):
        return f"took the connection, and has not answered for {opening_s:g} s: it hangs, or is not an xela_server"
    if isinstance(error, InvalidHandshake):
        return f"is not an xela_server, but another program, or one that expects TLS: {error}"
    return f"the connection broke while it was opened: {error}"


def _ending(error: ConnectionClosed) -> str:
    received = error.rcvd
    if received is not None:
        reason = f", {received.reason!r}" if received.reason else ""
        return f"the server closed it (code {int(received.code)}{reason})"
    sent = error.sent
    if sent is not None:
        return f"the server sent a message that no xela_server sends: {sent.reason or f'code {int(sent.code)}'}"
    return "the server is gone"
