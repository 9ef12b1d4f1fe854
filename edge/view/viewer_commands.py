"""What viewers ask for: JSON as on stdin, and what belongs to the page alone."""

import json
from collections import deque
from typing import Any, Final

from edge.pipeline.commands import Command, runtime_command
from edge.view.viewer_state import Viewer

LONGEST_BYTES: Final = 4096
WAITING: Final = 64
"""Commands that may wait for the loop to come round, ten times a second at least."""
FORMS: Final = (
    '{"cmd": "zero"} with "sensor" and "force" as wanted, {"cmd": "reset"}, {"cmd": "record", "on": true}, '
    '{"cmd": "pause", "on": true}'
)


class Asked:
    """Commands of all viewers, taken in one thread and polled in another.

    Attributes:
        refused: messages that were no command, or came when too many waited.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._waiting: deque[Command] = deque()

    def poll(self) -> list[Command]:
        """The commands that came since the last call."""
        return [self._waiting.popleft() for _ in range(len(self._waiting))]

    def hear(self, message: str | bytes, viewer: Viewer) -> str | None:
        """Take a viewer's message; returns why it is refused, if it is."""
        why = self._hear(message, viewer)
        self.refused += why is not None
        return why

    def _hear(self, message: str | bytes, viewer: Viewer) -> str | None:
        try:
            parsed = json.loads(message) if isinstance(message, str) else None
        except (ValueError, RecursionError):
            parsed = None
        if not isinstance(parsed, dict):
            return f"{_shown(message)} is no JSON object: expected {FORMS}"
        name = parsed.get("cmd")
        if name in ("record", "pause"):
            on = _switch(parsed)
            if on is None:
                return f'{_shown(message)} does not say whether to {name}: expected {{"cmd": "{name}", "on": true}}'
            if name == "pause":
                viewer.paused = on
                return None
            command = Command("record", on=on)
        else:
            command = runtime_command(parsed)
        if command is None:
            return f"{_shown(message)} is no command: expected {FORMS}"
        if len(self._waiting) >= WAITING:
            return f"{WAITING} commands wait already: ask again when the run has done them"
        self._waiting.append(command)
        return None


def _switch(parsed: dict[str, Any]) -> bool | None:
    on = parsed.get("on")
    return on if isinstance(on, bool) and parsed.keys() == {"cmd", "on"} else None


def _shown(message: str | bytes) -> str:
    shown = repr(message[:60])
    return shown if len(message) <= 60 else f"{shown[:-1]}...{shown[-1]}"
