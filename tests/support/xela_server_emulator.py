"""Emulator of the vendor's xela_server on this machine, with sensors that play recordings.

It is as strict as the real one: it sends its readings at its own pace, old or new, and restarts its count after a
restart. Messages made by hand are here as well.
"""

import asyncio
import json
import logging
import math
import socket
import struct
import threading
import time
from collections.abc import Coroutine, Sequence
from contextlib import suppress
from typing import Any, Final, Self

import numpy as np
import pytest
from bridge_samples import REST_COUNTS, make_recording, wait_for
from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.exceptions import ConnectionClosed

from firmware_bridge.emulation.slcan_emulator import playing_rate_hz
from firmware_bridge.errors import LinkLostError
from firmware_bridge.recording.tracks import Recording
from firmware_bridge.scans.xela_server_messages import WELCOME

UNIX_S: Final = 1_768_365_606.25
MS: Final = 1_000_000


class VendorServer:
    """Model of a server with sensors that play recordings: its message at any time."""

    def __init__(
        self, recordings: Sequence[Recording], *, loop: bool = False, others: Sequence[tuple[str, int]] = ()
    ) -> None:
        """Prepare to play each track as a sensor, over and over where it is to loop.

        `others` are model and number of taxels of sensors other than 4x4 ones, after all the others.
        """
        self._loop = loop
        self._others = [sensor_entry(model=model, taxels=taxels) for model, taxels in others]
        self._sensors = [
            (track.counts, playing_rate_hz(recording, track, None))
            for recording in recordings
            for track in recording.tracks
        ]

    def ended(self, elapsed_s: float) -> bool:
        """Return True once every cycle of every sensor could be sent."""
        return not self._loop and all(elapsed_s * rate_hz >= len(counts) for counts, rate_hz in self._sensors)

    def message(self, sequence: int, elapsed_s: float, unix_s: float) -> str:
        """Return the message on all sensors at a time in [s] from its start, `unix_s` [s] on its own clock."""
        entries: list[dict[str, Any]] = []
        for played, rate_hz in self._sensors:
            # A message that is sent at the time of a cycle holds it, however that time was rounded.
            cycle = int(elapsed_s * rate_hz + 1e-6)
            counts = played[cycle % len(played) if self._loop else min(cycle, len(played) - 1)]
            entries.append(sensor_entry(counts, ups=float(rate_hz), time_s=unix_s - elapsed_s % (1 / rate_hz)))
        return message(sequence, *entries, *self._others, time_s=unix_s)


HOST: Final = "127.0.0.1"  # this machine alone, so that no other one takes its messages for a sensor's
_QUIET: Final = logging.getLogger("xela_server_emulator")
_QUIET.addHandler(logging.NullHandler())
_QUIET.propagate = False


class ServerEmulator:
    """Server of a VendorServer's messages, from the greeting of the first client; hangs up at the end.

    Every fault can be requested from any thread, and has happened when the call returns.
    """

    def __init__(self, server: VendorServer, *, message_hz: float = 100.0) -> None:
        """Prepare to serve so many messages a second."""
        self.url = ""  # ws://HOST:PORT, once entered
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
            await client.send(json.dumps({"message": WELCOME, "time": time.time(), "version": "1.8.0b_208601"}))
            self._clients.add(client)
            self._greeted.set()
            async for _ in client:
                pass
        self._clients.discard(client)

    async def _send(self, text: str | bytes) -> None:
        broadcast(self._clients, text)

    async def _close(self, code: int, reason: str) -> None:
        await asyncio.gather(*(client.close(code, reason) for client in list(self._clients)))

    async def _die(self) -> None:
        self._server.close(close_connections=False)
        for client in list(self._clients):
            with suppress(OSError):  # the client may have gone just now
                # As the kernel does for a process that was killed, it resets the connection.
                reset = struct.pack("ii", 1, 0)
                client.transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, reset)
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


def sensor_entry(counts: np.ndarray = REST_COUNTS, *, ups=100.0, time_s=UNIX_S, **changes) -> dict:
    """Return the entry of a server 1.8.0 about one sensor; a change to None leaves the key out."""
    values = np.asarray(counts).reshape(3, 16).T.ravel().tolist()
    entry = {
        "time": time_s,
        "sensor": "1",
        "data": ",".join(f"{value:04X}" for value in values),
        "model": "uSPa44",
        "taxels": 16,
        "calibrated": [0.125] * 48,
        "integer": values,
        "temp": [301.5] * 16,
        "ups": [ups] * 16 if isinstance(ups, float) else ups,
        "extradots": [["1.0", "1.42", "21.62"]],
    }
    return {key: value for key, value in (entry | changes).items() if value is not None}


def message(sequence: object, *entries: dict, time_s: object = UNIX_S, **more) -> str:
    """Return a message about sensors 1, 2, ..."""
    sensors = {str(number): entry for number, entry in enumerate(entries, 1)}
    return json.dumps({"message": sequence, "time": time_s, "version": "1.8.0b_208601", **sensors, **more})


def looping(**options) -> VendorServer:
    return VendorServer([make_recording(50)], loop=True, **options)


def lose(link):
    """Read until the link is lost, and return its error's text."""
    with pytest.raises(LinkLostError) as lost:
        wait_for(lambda: link.read(0.05) and False)
    return str(lost.value)


def read_notices(link, count):
    """Return the first notices, at least `count`."""
    notices = []
    wait_for(lambda: (link.read(0.05), notices.extend(link.notices())) and len(notices) >= count)
    return notices
