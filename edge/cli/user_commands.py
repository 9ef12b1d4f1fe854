"""Commands of a run from its user: lines on stdin, keys of a terminal, and SIGUSR1."""

import os
import select
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, Final

from edge.pipeline.commands import RESET, ZERO, Command, Commands, read_stdin
from edge.terminal.stop_signals import before_force, handled

KEYS: Final = {ord("r"): RESET, ord("z"): ZERO, ord("Z"): Command("zero", force=True)}


class Keys:
    """Producer of commands from keys of a terminal; it never waits, and ignores other keys than KEYS."""

    def __init__(self, commands: Commands, descriptor: int) -> None:
        """Start with the terminal of this descriptor as it is."""
        self._commands, self._descriptor = commands, descriptor
        self._before: list[Any] | None = None
        self._gone = False

    def read(self) -> None:
        """Put the commands of the keys pressed since the last call."""
        if self._gone or not self._foreground():
            return
        if self._before is None:
            self.take()  # in the foreground again
        if not select.select([self._descriptor], [], [], 0)[0]:
            return
        try:
            keys = os.read(self._descriptor, 64)
        except OSError:  # the terminal was closed, which ends keys but not the run
            keys = b""
        self._gone = not keys
        for key in keys:
            if key in KEYS:
                self._commands.put(KEYS[key])

    def take(self) -> None:
        """Set the terminal to pass keys one by one, unseen; Ctrl-C and Ctrl-Z remain signals."""
        import termios
        import tty

        if self._gone or self._before is not None or not self._foreground():
            return
        try:
            before = termios.tcgetattr(self._descriptor)
            tty.setcbreak(self._descriptor, termios.TCSANOW)
            self._before = before
        except termios.error:
            self._gone = True

    def give_back(self, *, for_good: bool = False) -> None:
        """Restore the terminal's settings, unless the program is in the background, where another uses it."""
        import termios

        self._gone = self._gone or for_good
        before, self._before = self._before, None
        if before is not None and self._foreground():
            try:
                termios.tcsetattr(self._descriptor, termios.TCSANOW, before)
            except termios.error:
                self._gone = True

    def _foreground(self) -> bool:
        try:
            return os.tcgetpgrp(self._descriptor) == os.getpgrp()
        except OSError:  # not the terminal of this session, or gone
            return False


@contextmanager
def terminal_keys(commands: Commands) -> Iterator[None]:
    """Take keys as commands within a with statement, if stdin is a terminal."""
    if os.name != "posix" or sys.stdin is None or sys.stdin.closed or not sys.stdin.isatty():
        yield
        return
    keys = Keys(commands, sys.stdin.fileno())
    commands.ask(keys.read)
    with _given_back_on_signals(keys), before_force(partial(keys.give_back, for_good=True)):
        keys.take()
        try:
            yield
        finally:
            keys.give_back()


@contextmanager
def _given_back_on_signals(keys: Keys) -> Iterator[None]:
    """Restore the terminal before a signal that ends or stops the program has its usual effect."""

    def end(number: int, frame: object) -> None:
        keys.give_back(for_good=True)
        earlier = before[number]
        # From now on the signal has its earlier handler: the first one may have set the handler of the second.
        signal.signal(number, earlier)
        if callable(earlier):
            earlier(number, frame)
        elif earlier == signal.SIG_DFL:
            os.kill(os.getpid(), number)

    def stop(number: int, frame: object) -> None:
        keys.give_back()
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTSTP)  # here it stops
        signal.signal(signal.SIGTSTP, stop)
        keys.take()

    with handled(("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT"), end) as before, handled(["SIGTSTP"], stop):
        yield


@contextmanager
def user_commands() -> Iterator[Commands]:
    """Yield the queue of commands from lines on stdin, or from keys if it is a terminal, and from SIGUSR1."""
    commands = Commands()
    zero_on_signal = handled(["SIGUSR1"], lambda *_: commands.signalled.add(ZERO))
    with zero_on_signal, read_stdin(commands), terminal_keys(commands):
        yield commands
