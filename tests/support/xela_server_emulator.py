"""Emulator of the vendor's xela_server on this machine, with sensors that play recordings.

It is as strict as the real one: it sends its readings at its own pace, old or new, queues messages for a slow client
until they are old, and restarts its count after a restart.
"""

import asyncio
import logging
import math
import socket
import struct
import threading
import time
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any, Final, Self

from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.exceptions import ConnectionClosed
from xela_server_model import VendorServer

HOST: Final = "127.0.0.1"
"""Address of this machine alone, so that no other one takes its messages for a sensor's."""
MOST_QUEUED_BYTES: Final = 1 << 20
"""Most unread bytes of a client; messages beyond are lost."""
_RESET: Final = struct.pack("ii", 1, 0)
"""Value of SO_LINGER that resets a connection, as the kernel does for a process that was killed."""
_QUIET: Final = logging.getLogger("xela_server_emulator")
_QUIET.addHandler(logging.NullHandler())
_QUIET.propagate = False


class ServerEmulator:
    """Server of a VendorServer's messages, from the greeting of the first client; hangs up at the end.

    Every fault can be requested from any thread, and has happened when the call returns.

    Attributes:
        url: ws://HOST:PORT, once entered.
        sent_messages: number of messages sent to a client, without greetings.
        lost_messages: number of messages without room at a client.
    """

    def __init__(self, server: VendorServer, *, message_hz: float = 100.0) -> None:
        """Prepare to serve so many messages a second."""
        self.url = ""
        self.sent_messages = self.lost_messages = 0
        self._vendor, self._message_hz = server, message_hz
        self._port = 0
        self._sequence = 0
        self._greeted = asyncio.Event()
        self._clients: set[ServerConnection] = set()
        self._thawed = threading.Event()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="server-emulator", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        self.start_again()
        self.url = f"ws://{HOST}:{self._port}"
        self._playing = asyncio.run_coroutine_threadsafe(self._play(), self._loop)
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.thaw()
        self._playing.cancel()
        self.kill()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def kill(self) -> None:
        """End as a killed process does: connections break, and the port is closed."""
        self._ask(self._die())

    def start_again(self) -> None:
        """Listen again after `kill`, on the same port; messages are counted from 0."""
        self._ask(self._listen())

    def freeze(self) -> None:
        """Stop sending and answering, with every connection open, as when it hangs or the network is gone."""
        frozen = threading.Event()
        self._thawed.clear()
        self._loop.call_soon_threadsafe(lambda: (frozen.set(), self._thawed.wait()))
        frozen.wait()

    def thaw(self) -> None:
        """Go on after `freeze`; the messages of the time between are never sent."""
        self._thawed.set()

    def count_from(self, sequence: int) -> None:
        """Give the next message this number."""
        self._sequence = sequence

    def say(self, text: str | bytes) -> None:
        """Send any text or bytes to every client; bytes as a binary message."""
        self._ask(self._send(text))

    def close_all(self, code: int, reason: str) -> None:
        """Close every connection politely, and go on listening."""
        self._ask(self._close(code, reason))

    def _ask(self, action: Coroutine[Any, Any, object]) -> None:
        asyncio.run_coroutine_threadsafe(action, self._loop).result()

    async def _listen(self) -> None:
        self._sequence = 0
        settings = {"compression": None, "ping_interval": None, "logger": _QUIET}
        self._server = await serve(self._attend, HOST, self._port, **settings)
        self._port = next(iter(self._server.sockets)).getsockname()[1]

    async def _attend(self, client: ServerConnection) -> None:
        """Greet a client, and drop what it sends."""
        with suppress(ConnectionClosed):
            await client.send(self._vendor.welcome(time.time()))
            self._clients.add(client)
            self._greeted.set()
            async for _ in client:
                pass
        self._clients.discard(client)

    async def _send(self, text: str | bytes) -> None:
        for client in list(self._clients):
            if client.transport.get_write_buffer_size() > MOST_QUEUED_BYTES:
                self.lost_messages += 1
            else:
                self.sent_messages += 1
                broadcast([client], text)

    async def _close(self, code: int, reason: str) -> None:
        await asyncio.gather(*(client.close(code, reason) for client in list(self._clients)))

    async def _die(self) -> None:
        self._server.close(close_connections=False)
        for client in list(self._clients):
            with suppress(OSError):  # the client may have gone just now
                client.transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            client.transport.abort()
        await self._server.wait_closed()

    async def _play(self) -> None:
        """Send messages from the first greeting to the end of the recordings, then hang up."""
        await self._greeted.wait()
        start_s, ticks = time.monotonic(), 0
        while not self._vendor.ended(ticks / self._message_hz):
            await asyncio.sleep(max(0.0, start_s + ticks / self._message_hz - time.monotonic()))
            await self._send(self._vendor.message(self._sequence, ticks / self._message_hz, time.time()))
            self._sequence += 1
            behind = math.floor((time.monotonic() - start_s) * self._message_hz) - ticks
            ticks += 1 + (behind if behind > self._message_hz else 0)  # after a freeze it leaves messages out
        await self._close(1001, "")
