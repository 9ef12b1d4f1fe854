"""Commands as JSON lines on stdin, such as {"cmd": "reset"}; read between scans, without a thread."""

import json
import os
import select
import sys
from typing import Final

KNOWN: Final = ("reset",)
READ_BYTES: Final = 4096
LONGEST_LINE_BYTES: Final = 4096


class LineCommands:
    """Commands from a file descriptor, which is never waited for.

    Attributes:
        refused: lines that were no command.
    """

    def __init__(self, descriptor: int) -> None:
        self.refused = 0
        self._descriptor = descriptor
        self._open = True
        self._partial = b""

    def poll(self) -> list[str]:
        """Names of the commands that came since the last call."""
        if not self._open or not select.select([self._descriptor], [], [], 0)[0]:
            return []
        try:
            data = os.read(self._descriptor, READ_BYTES)
        except OSError:  # the other end is gone, which stops commands but not the run
            data = b""
        self._open = bool(data)
        *lines, partial = (self._partial + (data or b"\n")).split(b"\n")
        self._partial = partial[: LONGEST_LINE_BYTES + 1]
        return [command for line in lines if (command := self._parse(line)) is not None]

    def _parse(self, line: bytes) -> str | None:
        if not line.strip():
            return None
        try:
            command = json.loads(line) if len(line) <= LONGEST_LINE_BYTES else None
        except (ValueError, RecursionError):
            command = None
        if isinstance(command, dict) and command.get("cmd") in KNOWN:
            return command["cmd"]
        self.refused += 1
        return None


def stdin_commands() -> LineCommands | None:
    """Commands from stdin; None where there is none, or where it is a terminal.

    A terminal is left alone: reading it in the background would stop the program. Elsewhere than on
    POSIX a pipe cannot be asked whether it has something.
    """
    if os.name != "posix" or sys.stdin is None or sys.stdin.closed or sys.stdin.isatty():
        return None
    return LineCommands(sys.stdin.fileno())
