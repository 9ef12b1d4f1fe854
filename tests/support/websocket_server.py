"""WebSocket server of poll and sockets, in the thread of its caller, that can also fail as a machine does."""

import logging
import selectors
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from websockets.http11 import Request
from websockets.protocol import OPEN
from websockets.server import ServerProtocol

MOST_QUEUED_BYTES: Final = 1 << 20
"""Most unread bytes of a client; messages beyond are lost."""
_STOP_POLL_S: Final = 0.05
_ABORT: Final = struct.pack("ii", 1, 0)
"""Value of SO_LINGER that resets a connection, as the kernel does for a process that was killed."""
_QUIET: Final = logging.getLogger("websocket_server")
_QUIET.addHandler(logging.NullHandler())
_QUIET.propagate = False


@dataclass(eq=False)
class _Client:
    """One connection, and the bytes without room in it yet."""

    connection: socket.socket
    protocol: ServerProtocol = field(default_factory=lambda: ServerProtocol(logger=_QUIET))
    unsent: bytearray = field(default_factory=bytearray)
    closing: bool = False


class WebSocketServer:
    """Server that greets clients and sends to all of them; their messages are read and dropped.

    Attributes:
        address: host and port.
        sent_messages: number of messages sent to a client, without greetings.
        lost_messages: number of messages without room at a client.
    """

    def __init__(self, host: str, port: int, greeting: Callable[[], str]) -> None:
        """Prepare to listen; nothing is opened yet.

        Args:
            host: address to listen on.
            port: port to listen on, 0 for a free one.
            greeting: returns the first message to a client, called when it has connected.
        """
        self.address: tuple[str, int] = (host, port)
        self.sent_messages = 0
        self.lost_messages = 0
        self._greeting = greeting
        self._clients: list[_Client] = []
        self._selector = selectors.DefaultSelector()
        self._wake, self._woken = socket.socketpair()
        self._selector.register(self._woken, selectors.EVENT_READ, None)
        self._listener: socket.socket | None = None

    def listen(self) -> None:
        """Accept clients, on the former port if there was one; no effect if it already does."""
        if self._listener is not None:
            return
        self._listener = socket.create_server(self.address)
        self._listener.setblocking(False)
        self.address = self._listener.getsockname()[:2]
        self._selector.register(self._listener, selectors.EVENT_READ, None)

    def poll(self, timeout_s: float, *, attend: bool = True) -> None:
        """Wait at most `timeout_s` for events, and handle them if `attend`."""
        for key, events in self._selector.select(timeout_s):
            if key.fileobj is self._woken:
                self._woken.recv(4096)
            elif attend:
                self._attend(key.data, events)

    def wake(self) -> None:
        """End a `poll` that waits; from any thread."""
        self._wake.send(b"x")

    def say(self, text: str | bytes) -> None:
        """Send any text or bytes to every client; bytes as a binary message."""
        for client in list(self._clients):
            if client.protocol.state is not OPEN:
                continue
            if len(client.unsent) > MOST_QUEUED_BYTES:
                self.lost_messages += 1
                continue
            if isinstance(text, str):
                client.protocol.send_text(text.encode())
            else:
                client.protocol.send_binary(text)
            self.sent_messages += 1
            self._flush(client)

    def close_all(self, code: int, reason: str) -> None:
        """Close every connection politely, and go on listening."""
        for client in list(self._clients):
            if client.protocol.state is OPEN:
                client.protocol.send_close(code, reason)
            self._flush(client)

    def hang_up(self, stop: threading.Event) -> None:
        """Close politely, once everything has gone out; at once if `stop` is set."""
        end_s = time.monotonic() + 1
        self.close_all(1001, "")
        while self._clients and time.monotonic() < end_s and not stop.is_set():
            for key, events in self._selector.select(_STOP_POLL_S):
                if isinstance(key.data, _Client):
                    self._attend(key.data, events)

    def drop_dead(self) -> None:
        """Break every connection, and stop listening."""
        if self._listener is not None:
            self._selector.unregister(self._listener)
            self._listener.close()
            self._listener = None
        for client in list(self._clients):
            client.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _ABORT)
            self._drop(client)

    def close(self) -> None:
        """Release the remaining resources, after the last poll."""
        self._wake.close()
        self._woken.close()
        self._selector.close()

    def _attend(self, client: _Client | None, events: int) -> None:
        if client is None:
            self._accept()
            return
        if events & selectors.EVENT_READ:
            try:
                data = client.connection.recv(65536)
            except OSError:
                self._drop(client)
                return
            if data:
                client.protocol.receive_data(data)
            else:
                client.protocol.receive_eof()
            for event in client.protocol.events_received():
                if isinstance(event, Request):
                    client.protocol.send_response(client.protocol.accept(event))
                    if client.protocol.state is OPEN:
                        client.protocol.send_text(self._greeting().encode())
        self._flush(client)

    def _accept(self) -> None:
        if self._listener is None:
            return
        try:
            connection, _ = self._listener.accept()
        except OSError:  # gone before it was accepted
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
        client = _Client(connection)
        self._clients.append(client)
        self._selector.register(connection, selectors.EVENT_READ, client)

    def _flush(self, client: _Client) -> None:
        for data in client.protocol.data_to_send():
            client.unsent += data
            client.closing |= not data  # empty data marks the end
        try:
            if client.unsent:
                del client.unsent[: client.connection.send(client.unsent)]
            if client.closing and not client.unsent:
                self._drop(client)
                return
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
            return
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.unsent else 0)
        self._selector.modify(client.connection, wanted, client)

    def _drop(self, client: _Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self._selector.unregister(client.connection)
            client.connection.close()
