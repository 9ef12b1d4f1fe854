"""Emulator of the vendor's xela_server on this machine, with sensors that play recordings.

It is as strict as the real one: it sends its readings at its own pace, old or new, queues messages for a slow client
until they are old, and restarts its count after a restart.
"""

import math
import threading
import time
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Final, Self

from websocket_server import WebSocketServer
from xela_server_model import GARBAGE, VendorServer

DEFAULT_MESSAGE_HZ: Final = 100.0
HOST: Final = "127.0.0.1"
"""Address of this machine alone, so that no other one takes its messages for a sensor's."""
_STOP_POLL_S: Final = 0.05


class ServerEmulator:
    """Server of a VendorServer's messages, from the greeting of the first client; hangs up at the end.

    Every fault can be requested from any thread, and has happened when the call returns.

    Attributes:
        url: ws://HOST:PORT, once entered.
    """

    def __init__(
        self,
        server: VendorServer,
        *,
        message_hz: float = DEFAULT_MESSAGE_HZ,
        port: int = 0,
        garbage_every: int = 0,
    ) -> None:
        """Prepare to serve; nothing is opened yet.

        Args:
            server: source of the messages.
            message_hz: messages a second, independent of the sensors.
            port: port to listen on, 0 for a free one.
            garbage_every: number of messages after which an invalid one follows; 0 for never.

        Raises:
            ValueError: an option is out of range.
        """
        if not 0 < message_hz < math.inf:
            raise ValueError(f"messages a second are {message_hz}, expected a positive number")
        self.url = ""
        self._vendor = server
        self._message_hz = message_hz
        self._garbage_every = garbage_every
        self._sequence = 0
        self._ticks = 0
        self._garbage = 0
        self._start_s: float | None = None
        self._frozen = False
        self._asked: SimpleQueue[tuple[Callable[[], None], threading.Event]] = SimpleQueue()
        self._server = WebSocketServer(HOST, port, self._welcome)
        self._stop = threading.Event()
        self._through = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="server-emulator", daemon=True)

    def __enter__(self) -> Self:
        self._server.listen()
        host, port = self._server.address
        self.url = f"ws://{host}:{port}"
        self._thread.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._stop.set()
        self._server.wake()
        self._thread.join()
        self._server.close()

    @property
    def sent_messages(self) -> int:
        """Number of messages sent to a client, without greetings."""
        return self._server.sent_messages

    @property
    def lost_messages(self) -> int:
        """Number of messages without room at a client."""
        return self._server.lost_messages

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it has hung up; return False on time-out."""
        return self._through.wait(timeout_s)

    def kill(self) -> None:
        """End as a killed process does: connections break, and the port is closed."""
        self._ask(self._server.drop_dead)

    def start_again(self) -> None:
        """Listen again after `kill`, on the same port; messages are counted from 0."""
        self._ask(self._begin_anew)

    def freeze(self) -> None:
        """Stop sending and answering, with every connection open, as when it hangs or the network is gone."""
        self._ask(lambda: setattr(self, "_frozen", True))

    def thaw(self) -> None:
        """Go on after `freeze`; the messages of the time between are never sent."""
        self._ask(lambda: setattr(self, "_frozen", False))

    def count_from(self, sequence: int) -> None:
        """Give the next message this number."""
        self._ask(lambda: setattr(self, "_sequence", sequence))

    def say(self, text: str | bytes) -> None:
        """Send any text or bytes to every client; bytes as a binary message."""
        self._ask(lambda: self._server.say(text))

    def close_all(self, code: int = 1001, reason: str = "") -> None:
        """Close every connection politely, and go on listening."""
        self._ask(lambda: self._server.close_all(code, reason))

    def _ask(self, action: Callable[[], None]) -> None:
        done = threading.Event()
        self._asked.put((action, done))
        self._server.wake()
        while not done.wait(_STOP_POLL_S) and not self._through.is_set():
            pass

    def _serve(self) -> None:
        try:
            while not self._stop.is_set():
                self._server.poll(self._time_to_next_s(), attend=not self._frozen)
                self._do_what_is_asked()
                if self._frozen:
                    # A select on unread data would not wait.
                    self._stop.wait(1 / self._message_hz)
                elif self._start_s is not None and self._time_to_next_s() == 0 and not self._tick(self._start_s):
                    break
            if not self._stop.is_set():
                self._server.hang_up(self._stop)
        finally:
            self._server.drop_dead()
            self._do_what_is_asked()
            self._through.set()

    def _do_what_is_asked(self) -> None:
        while True:
            try:
                action, done = self._asked.get_nowait()
            except Empty:
                return
            action()
            done.set()

    def _time_to_next_s(self) -> float:
        if self._start_s is None:
            return _STOP_POLL_S
        return max(0.0, self._start_s + self._ticks / self._message_hz - time.monotonic())

    def _tick(self, start_s: float) -> bool:
        """Send the next message; return False if there is no more to send."""
        elapsed_s = self._ticks / self._message_hz
        if self._vendor.ended(elapsed_s):
            return False
        behind = math.floor((time.monotonic() - start_s) * self._message_hz) - self._ticks
        self._ticks += 1 + (behind if behind > self._message_hz else 0)  # after a freeze it leaves messages out
        text = self._vendor.message(self._sequence, elapsed_s, time.time())
        self._sequence += 1
        self._server.say(text)
        if self._garbage_every and self._sequence % self._garbage_every == 0:
            self._server.say(GARBAGE[self._garbage % len(GARBAGE)])
            self._garbage += 1
        return True

    def _begin_anew(self) -> None:
        self._sequence = 0
        self._server.listen()

    def _welcome(self) -> str:
        self._start_s = time.monotonic() if self._start_s is None else self._start_s
        return self._vendor.welcome(time.time())
