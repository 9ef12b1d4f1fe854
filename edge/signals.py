"""Signals: Ctrl-C and its like as an event, so that a run ends after the scans in hand; SIGUSR1 as a command."""

import contextlib
import signal
import threading
from collections.abc import Iterator

from edge.commands import ZERO, Command
from edge.ending import ended_in_time


@contextlib.contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that the first signal sets; what is within has END_S to end then. A second signal ends it at once."""
    stop = threading.Event()

    def handle(number: int, frame: object) -> None:
        stop.set()
        signal.signal(number, signal.SIG_DFL)

    names = [name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {getattr(signal, name): signal.signal(getattr(signal, name), handle) for name in names}
    try:
        with ended_in_time(before):
            yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class SignalCommands:
    """Commands that signals stand for.

    Attributes:
        refused: always 0.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._asked = False

    def ask(self, number: int, frame: object) -> None:
        """The handler: zero all sensors again."""
        self._asked = True

    def poll(self) -> list[Command]:
        """What was asked for since the last call; asked twice meanwhile is asked once."""
        if not self._asked:
            return []
        self._asked = False
        return [ZERO]


@contextlib.contextmanager
def zero_on_signal() -> Iterator[SignalCommands]:
    """SIGUSR1, where there is one, asks for zeroing again; as any request it is refused in contact."""
    commands = SignalCommands()
    number = getattr(signal, "SIGUSR1", None)
    if number is None:
        yield commands
        return
    before = signal.signal(number, commands.ask)
    try:
        yield commands
    finally:
        signal.signal(number, before)
