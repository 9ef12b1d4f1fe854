"""Commands of a run from its user: lines on stdin, keys of a terminal, and SIGUSR1."""

import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Final

from edge.pipeline.commands import RESET, ZERO, Command, Commands, read_stdin
from edge.terminal.stop_signals import handled

KEYS: Final = {ord("r"): RESET, ord("z"): ZERO, ord("Z"): Command("zero", force=True)}


@contextmanager
def terminal_keys(commands: Commands) -> Iterator[None]:
    """Take keys as commands within a with statement, if stdin is a terminal; Ctrl-C and Ctrl-Z remain signals.

    A shell restores the terminal itself after a program that a signal has ended or stopped.
    """
    if os.name != "posix" or sys.stdin is None or sys.stdin.closed or not sys.stdin.isatty():
        yield
        return
    import termios
    import tty

    descriptor = sys.stdin.fileno()
    commands.ask(partial(_read_keys, commands, descriptor))

    def pass_keys(*_: object) -> None:
        with suppress(termios.error):  # the terminal was closed, which ends keys but not the run
            if _in_front(descriptor):
                tty.setcbreak(descriptor, termios.TCSANOW)

    with handled(["SIGCONT"], pass_keys):
        try:
            before = termios.tcgetattr(descriptor)
        except termios.error:
            yield
            return
        pass_keys()
        try:
            yield
        finally:
            with suppress(termios.error):
                if _in_front(descriptor):
                    termios.tcsetattr(descriptor, termios.TCSANOW, before)


def _read_keys(commands: Commands, descriptor: int) -> None:
    """Put the commands of the keys pressed since the last call; never waits, and ignores other keys than KEYS."""
    with suppress(OSError):  # the terminal was closed
        if _in_front(descriptor) and select.select([descriptor], [], [], 0)[0]:
            for key in os.read(descriptor, 64):
                if key in KEYS:
                    commands.put(KEYS[key])


def _in_front(descriptor: int) -> bool:
    """Return whether this program is the one that its terminal listens to; another uses it else."""
    with suppress(OSError):  # not the terminal of this session, or closed
        return os.tcgetpgrp(descriptor) == os.getpgrp()
    return False


@contextmanager
def user_commands() -> Iterator[Commands]:
    """Yield the queue of commands from lines on stdin, or from keys if it is a terminal, and from SIGUSR1."""
    commands = Commands()
    zero_on_signal = handled(["SIGUSR1"], lambda *_: commands.put(ZERO))
    with zero_on_signal, read_stdin(commands), terminal_keys(commands):
        yield commands
