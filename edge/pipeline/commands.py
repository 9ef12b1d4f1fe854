"""What a user may ask of a run, and JSON lines on stdin that ask it, such as {"cmd": "reset"}.

Read between scans, without a thread.
"""

import json
import os
import select
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol

from firmware_bridge.scans.scan import is_sensor_name

READ_BYTES: Final = 4096
LONGEST_LINE_BYTES: Final = 4096


@dataclass(frozen=True, slots=True)
class Command:
    """What a user asks for between two scans.

    Attributes:
        name: "reset" forgets earlier taps, "zero" zeroes again, "record" begins or ends a recording.
        sensor: which one to zero; None for all.
        force: zero it even if it is in contact.
        on: begin a recording, or else end it.
    """

    name: Literal["reset", "zero", "record"]
    sensor: str | None = None
    force: bool = False
    on: bool = False


RESET: Final = Command("reset")
ZERO: Final = Command("zero")


class Commands(Protocol):
    """Where a user's commands come from."""

    @property
    def refused(self) -> int:
        """What came and was no command."""
        ...

    def poll(self) -> Sequence[Command]:
        """What was asked for since the last call; never waits."""
        ...


class Obedient(Protocol):
    """What does as it is told: a runtime."""

    def reset(self) -> None:
        """Forget earlier taps."""
        ...

    def zero(self, name: str | None = None, *, force: bool = False) -> None:
        """Zero a sensor again, or all."""
        ...


def obey(commands: Commands, runtime: Obedient) -> None:
    """Have done what was asked for since the last call."""
    for command in commands.poll():
        if command.name == "reset":
            runtime.reset()
        elif command.name == "zero":
            runtime.zero(command.sensor, force=command.force)


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

    def poll(self) -> list[Command]:
        """The commands that came since the last call."""
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

    def _parse(self, line: bytes) -> Command | None:
        if not line.strip():
            return None
        try:
            parsed = json.loads(line) if len(line) <= LONGEST_LINE_BYTES else None
        except (ValueError, RecursionError):
            parsed = None
        command = runtime_command(parsed) if isinstance(parsed, dict) else None
        self.refused += command is None
        return command


def runtime_command(parsed: Mapping[str, Any]) -> Command | None:
    """The command to the runtime that parsed JSON is; None if it is none."""
    if parsed.get("cmd") == "reset":
        return RESET
    sensor, force = parsed.get("sensor"), parsed.get("force", False)
    # A misspelt key must not turn "zero sensor 4" into "zero all": unlike a reset, a zeroing cannot be undone.
    if parsed.get("cmd") != "zero" or parsed.keys() - {"cmd", "sensor", "force"}:
        return None
    # A name that no sensor can have is not looked for, and not told of, either: who wrote it may be a stranger.
    if not (sensor is None or (isinstance(sensor, str) and is_sensor_name(sensor))) or not isinstance(force, bool):
        return None
    return Command("zero", sensor, force)


class AllCommands:
    """Commands from several places."""

    def __init__(self, places: Sequence[Commands]) -> None:
        self._places = places

    @property
    def refused(self) -> int:
        """What came and was no command."""
        return sum(place.refused for place in self._places)

    def poll(self) -> list[Command]:
        """What was asked for since the last call, place by place."""
        return [command for place in self._places for command in place.poll()]


def stdin_commands() -> LineCommands | None:
    """Commands from stdin; None where there is none, or where it is a terminal.

    A terminal has keys. Elsewhere than on POSIX a pipe cannot be asked whether it has something.
    """
    if os.name != "posix" or sys.stdin is None or sys.stdin.closed or sys.stdin.isatty():
        return None
    try:
        return LineCommands(sys.stdin.fileno())
    except OSError:  # what stands in its place is no file of the system's
        return None
