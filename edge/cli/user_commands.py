"""Commands of a run from its user: lines on stdin, keys of a terminal, and SIGUSR1."""

import contextlib
from collections.abc import Iterator

from edge.cli.keyboard import terminal_keys
from edge.pipeline.commands import ZERO, Commands, read_stdin
from edge.terminal.stop_signals import handled


@contextlib.contextmanager
def user_commands() -> Iterator[Commands]:
    """Yield the queue of commands from lines on stdin, or from keys if it is a terminal, and from SIGUSR1."""
    commands = Commands()
    zero_on_signal = handled(["SIGUSR1"], lambda *_: commands.signalled.add(ZERO))
    with zero_on_signal, read_stdin(commands), terminal_keys(commands):
        yield commands
