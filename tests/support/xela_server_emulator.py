"""Emulator of the vendor's xela_server on this machine, with sensors that play recordings.

It is as strict as the real one: it sends its readings at its own pace, old or new, and restarts its count after a
restart. Messages made by hand are here as well.
"""

import json
import math
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final, Self

import numpy as np
import pytest
from bridge_samples import REST_COUNTS, make_recording, wait_for
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request
from websockets.sync.server import ServerConnection, serve

from firmware_bridge.emulation.slcan_emulator import playing_rate_hz
from firmware_bridge.errors import LinkLostError
from firmware_bridge.recording.tracks import Recording
from firmware_bridge.scans.xela_server_messages import WELCOME

UNIX_S: Final = 1_768_365_606.25
MS: Final = 1_000_000
HOST: Final = "127.0.0.1"  # this machine alone, so that no other one takes its messages for a sensor's


class ServerEmulator:
    """Server of messages on sensors that play recordings, to each client from its greeting on; hangs up at the end."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        *,
        loop: bool = False,
        others: Sequence[tuple[str, int]] = (),
        message_hz: float = 100.0,
    ) -> None:
        """Prepare to play each track as a sensor, over and over where it is to loop, in so many messages a second.

        `others` are model and number of taxels of sensors other than 4x4 ones, after all the others.
        """
        self.url = ""  # ws://HOST:PORT, once entered
        self._loop, self._message_hz = loop, message_hz
        self._others = [sensor_entry(model=model, taxels=taxels) for model, taxels in others]
        self._sensors = [
            (track.counts, playing_rate_hz(recording, track, None))
            for recording in recordings
            for track in recording.tracks
        ]
        self._port = 0
        self.clients: set[ServerConnection] = set()  # that are connected
        self._answers = threading.Event()
        self._answers.set()

    def __enter__(self) -> Self:
        self.start_again()
        self.url = f"ws://{HOST}:{self._port}"
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.thaw()
        self.kill()

    def kill(self) -> None:
        """End as a killed process does: connections break, and the port is closed."""
        self._server.shutdown()
        self._thread.join()
        for client in list(self.clients):
            client.close_socket()
        wait_for(lambda: not self.clients)

    def start_again(self) -> None:
        """Listen again after `kill`, on the same port; messages are counted from 0."""

        def hold(client: ServerConnection, request: Request) -> None:
            self._answers.wait()

        self._server = serve(self._attend, HOST, self._port, compression=None, process_request=hold)
        self._port = self._server.socket.getsockname()[1]
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def freeze(self) -> None:
        """Stop sending and answering, with every connection open, as when it hangs or the network is gone."""
        self._answers.clear()

    def thaw(self) -> None:
        """Go on after `freeze`; the messages of the time between are never sent."""
        self._answers.set()

    def say(self, text: str | bytes) -> None:
        """Send any text or bytes to every client; bytes as a binary message."""
        wait_for(lambda: self.clients)
        for client in list(self.clients):
            client.send(text)

    def close_all(self, code: int, reason: str) -> None:
        """Close every connection politely, and go on listening."""
        for client in list(self.clients):
            client.close(code, reason)
        wait_for(lambda: not self.clients)

    def message(self, sequence: int, elapsed_s: float, unix_s: float) -> str:
        """Return the message on all sensors at a time in [s] from its start, `unix_s` [s] on its own clock."""
        entries: list[dict[str, Any]] = []
        for played, rate_hz in self._sensors:
            # A message that is sent at the time of a cycle holds it, however that time was rounded.
            cycle = int(elapsed_s * rate_hz + 1e-6)
            counts = played[cycle % len(played) if self._loop else min(cycle, len(played) - 1)]
            entries.append(sensor_entry(counts, ups=float(rate_hz), time_s=unix_s - elapsed_s % (1 / rate_hz)))
        return message(sequence, *entries, *self._others, time_s=unix_s)

    def _attend(self, client: ServerConnection) -> None:
        """Greet a client, and send messages to the end of the recordings."""
        start_s, ticks = time.monotonic(), 0
        played_s = math.inf if self._loop else max(len(counts) / rate_hz for counts, rate_hz in self._sensors)
        with suppress(ConnectionClosed):
            client.send(json.dumps({"message": WELCOME, "time": time.time(), "version": "1.8.0b_208601"}))
            self.clients.add(client)
            while ticks / self._message_hz < played_s:
                time.sleep(max(0.0, start_s + ticks / self._message_hz - time.monotonic()))
                self._answers.wait()
                client.send(self.message(ticks, ticks / self._message_hz, time.time()))
                behind = math.floor((time.monotonic() - start_s) * self._message_hz) - ticks
                ticks += 1 + (behind if behind > self._message_hz else 0)  # after a freeze it leaves messages out
        self.clients.discard(client)


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


def looping(**options) -> ServerEmulator:
    return ServerEmulator([make_recording(50)], loop=True, **options)


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
