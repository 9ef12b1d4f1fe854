"""Commands of a run from where a user gives them: lines on stdin, keys of a terminal, and SIGUSR1."""

import contextlib
import signal
from collections.abc import Iterator

from edge.cli.keyboard import terminal_keys
from edge.pipeline.commands import ZERO, AllCommands, Command, Commands, stdin_commands


@contextlib.contextmanager
def user_commands() -> Iterator[Commands]:
    """Commands from lines on stdin, or from keys where it is a terminal, and from SIGUSR1."""
    with contextlib.ExitStack() as closing:
        places: list[Commands] = [closing.enter_context(zero_on_signal())]
        lines = stdin_commands()
        if lines is not None:
            places.append(lines)
        keys = closing.enter_context(terminal_keys())
        if keys is not None:
            places.append(keys)
        yield AllCommands(places)


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
