"""Link to the vendor's server, over WebSocket."""

import re
import socket
import threading
import time
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, Self

from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import ClientConnection, connect

from firmware_bridge.errors import DeviceError, LinkLostError, SourceError
from firmware_bridge.links.base import Link, SourceKind, not_open
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.xela_server_messages import LONGEST_MESSAGE_BYTES
from firmware_bridge.scans.xela_server_scans import ServerScans

OPENING_S: Final = 3.0
_ADDRESS: Final = re.compile(r"ws://(\[[0-9a-f:.]+\]|[^\s/:@?#\[\]]+)(?::([0-9]{1,5}))?/?", re.IGNORECASE)


class XelaServerLink(Link):
    """Link to the vendor's xela_server; scans of its simulation mode, which it does not report, count as a device's."""

    def __init__(
        self,
        url: str,
        *,
        geometry: SensorGeometry = USPA44,
        prefix: str = "",
        mountings: Mapping[str, Mounting] = MappingProxyType({}),
    ) -> None:
        """Prepare a link to ws://HOST[:PORT], for sensors of this geometry; raises SourceError for another URL.

        `mountings`, by the names of sensors with `prefix`, put taxels and the server's forces right.
        """
        self._address = server_address(url)
        self.name = f"xela-server:{url}"
        self.kind: SourceKind = "device"
        self.url = self._address[2]
        self._scans = ServerScans(geometry, prefix, mountings)
        self._counting = threading.Lock()  # counters are of whole pieces, whichever thread asks
        self._received_bytes = 0
        self._connection: ClientConnection | None = None

    def __enter__(self) -> Self:
        self._scans.begin()
        self._connection = self._connect()
        return self

    def __exit__(self, *exc_info: object) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; waits at most `timeout_s` for the first message.

        Raises LinkLostError, and DeviceError where it has no sensor that can be used. A server that hangs is silent:
        its reader opens it again, which then fails.
        """
        if self._connection is None:
            raise not_open()
        scans: list[Scan] = []
        try:
            for _ in range(64):  # later messages wait for the next read
                message = self._connection.recv(timeout_s, decode=False)
                timeout_s, time_ns = 0, time.monotonic_ns()
                with self._counting:
                    self._received_bytes += len(message)
                    scans += self._scans.feed(message, time_ns)
        except TimeoutError:
            pass
        except ConnectionClosed as error:
            if scans:  # scans from before the end count; the next read reports the end
                return scans
            raise LinkLostError(f"{self.url}: link lost, the server is gone: {error}") from error
        self.trouble = self._scans.trouble
        if not self._scans.usable:
            raise DeviceError(f"{self.url}: no sensor that can be used: {self.trouble}")
        return scans

    def counters(self) -> dict[str, int]:
        """Return the count of received bytes, and the counters of decoder and scans."""
        with self._counting:
            return {"received_bytes": self._received_bytes} | self._scans.counters()

    def _connect(self) -> ClientConnection:
        host, port, url = self._address
        try:
            plain = socket.create_connection((host, port), OPENING_S)
        except (OSError, UnicodeError) as error:
            raise DeviceError(f"{url}: {_unreachable(error)}") from error
        try:
            # The server is on this machine or near it: no proxy, and no compression, which costs time on both sides.
            # No pings: they would drop a server that sends messages but answers none.
            return connect(
                url,
                sock=plain,
                proxy=None,
                compression=None,
                open_timeout=OPENING_S,
                close_timeout=0.2,
                ping_interval=None,
                max_size=LONGEST_MESSAGE_BYTES,
            ).__enter__()  # websockets warns of a connection that was not entered
        except (OSError, WebSocketException, ValueError) as error:
            what = "is no xela_server, but another program, or one that expects TLS or hangs"
            raise DeviceError(f"{url}: {what}: {error}") from error


def server_address(url: str) -> tuple[str, int, str]:
    """Parse ws://HOST[:PORT] into host, port (5000 by default) and URL; raises SourceError on any other form."""
    match = _ADDRESS.fullmatch(url)
    port = int(match[2] or 5000) if match else 0
    if match is None or not 0 < port < 1 << 16:
        secure = ": it does not speak TLS" if url.lower().startswith("wss:") else ""
        raise SourceError(f"address of the xela_server is {url!r}{secure}, expected ws://HOST or ws://HOST:PORT")
    host = match[1].lower()
    return host.strip("[]"), port, f"ws://{host}:{port}"


def _unreachable(error: OSError | UnicodeError) -> str:
    if isinstance(error, ConnectionRefusedError):
        return (
            "connection refused: start xela_server there, or name its port; some versions (1.7.6) listen on the "
            "machine's own address alone: see hostname -I"
        )
    if isinstance(error, (socket.gaierror, UnicodeError)):  # UnicodeError: a name that is invalid in the DNS
        return "no such host: name it by its IP address, or see that it is in the DNS"
    why = getattr(error, "strerror", None) or error
    return f"cannot be reached: {why}: is the machine on, on this network, and its firewall open?"
