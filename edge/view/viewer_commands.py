"""Commands of viewers: JSON as on stdin, and commands that belong to the page alone."""

import json
from typing import Any, Final

from edge.pipeline.commands import WAITING, Command, Commands, runtime_command
from edge.view.viewer_state import Viewer

LONGEST_BYTES: Final = 4096
FORMS: Final = (
    '{"cmd": "zero"} with "sensor" and "force" as wanted, {"cmd": "reset"}, {"cmd": "record", "on": true}, '
    '{"cmd": "pause", "on": true}'
)


def execute(message: str | bytes, viewer: Viewer, commands: Commands) -> str | None:
    """Queue the command in a viewer's message; returns the reason if it is refused."""
    why = _refusal(message, viewer, commands)
    if why is not None:
        commands.refuse()
    return why


def _refusal(message: str | bytes, viewer: Viewer, commands: Commands) -> str | None:
    try:
        parsed = json.loads(message) if isinstance(message, str) else None
    except (ValueError, RecursionError):
        parsed = None
    if not isinstance(parsed, dict):
        return f"{_shown(message)} is not a JSON object: expected {FORMS}"
    name = parsed.get("cmd")
    if name in ("record", "pause"):
        on = _switch(parsed)
        if on is None:
            return f'{_shown(message)} does not state whether to {name}: expected {{"cmd": "{name}", "on": true}}'
        if name == "pause":
            viewer.paused = on
            return None
        command = Command("record", on=on)
    else:
        command = runtime_command(parsed)
    if command is None:
        return f"{_shown(message)} is not a command: expected {FORMS}"
    if commands.full:
        return f"{WAITING} commands are waiting: repeat it when the run has executed them"
    commands.put(command)
    return None


def _switch(parsed: dict[str, Any]) -> bool | None:
    on = parsed.get("on")
    return on if isinstance(on, bool) and parsed.keys() == {"cmd", "on"} else None


def _shown(message: str | bytes) -> str:
    shown = repr(message[:60])
    return shown if len(message) <= 60 else f"{shown[:-1]}...{shown[-1]}"
