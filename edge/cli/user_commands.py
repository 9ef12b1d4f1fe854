"""Commands of a run from its user: lines on stdin, keys of a terminal, and SIGUSR1."""

import contextlib
import signal
import threading
from collections.abc import Iterator

from edge.cli.keyboard import terminal_keys
from edge.pipeline.commands import ZERO, Commands, read_stdin


@contextlib.contextmanager
def user_commands() -> Iterator[Commands]:
    """Yield the queue of commands from lines on stdin, or from keys if it is a terminal, and from SIGUSR1."""
    commands = Commands()
    with zero_on_signal(commands):
        read_stdin(commands)
        with terminal_keys(commands):
            yield commands


@contextlib.contextmanager
def zero_on_signal(commands: Commands) -> Iterator[None]:
    """Request zeroing on SIGUSR1, where the system has it; like any request it is refused in contact."""
    number = getattr(signal, "SIGUSR1", None)
    if number is None:
        yield
        return
    asked = threading.Event()

    def put() -> None:
        if asked.is_set():  # two signals meanwhile count as one
            asked.clear()
            commands.put(ZERO)

    commands.ask(put)
    before = signal.signal(number, lambda *_: asked.set())
    try:
        yield
    finally:
        signal.signal(number, before)
