"""Commands of a run from its user: lines on stdin, keys of a terminal, and SIGUSR1."""

import contextlib
import signal
from collections.abc import Iterator

from edge.cli.keyboard import terminal_keys
from edge.pipeline.commands import ZERO, Commands, read_stdin


@contextlib.contextmanager
def user_commands() -> Iterator[Commands]:
    """Yield the queue of commands from lines on stdin, or from keys if it is a terminal, and from SIGUSR1."""
    commands = Commands()
    with zero_on_signal(commands), read_stdin(commands), terminal_keys(commands):
        yield commands


@contextlib.contextmanager
def zero_on_signal(commands: Commands) -> Iterator[None]:
    """Request zeroing on SIGUSR1, where the system has it; like any request it is refused in contact."""
    number = getattr(signal, "SIGUSR1", None)
    if number is None:
        yield
        return
    before = signal.signal(number, lambda *_: commands.signalled.add(ZERO))
    try:
        yield
    finally:
        signal.signal(number, before)
