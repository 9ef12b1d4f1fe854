"""Commands of viewers: JSON as on stdin, and commands that belong to the page alone."""

import json
import math
from typing import Any, Final

from edge.pipeline.commands import WAITING, Command, Commands, runtime_command
from edge.validation import as_float
from edge.view.viewer_state import Viewer
from firmware_bridge.links.replay_player import Player

LONGEST_BYTES: Final = 4096
FORMS: Final = (
    '{"cmd": "zero"} with "sensor" and "force" as wanted, {"cmd": "reset"}, {"cmd": "record", "on": true}, '
    '{"cmd": "pause", "on": true}; of a recording {"cmd": "play", "at_s": 1.5} with "speed" and "on" as wanted'
)


def execute(message: str | bytes, viewer: Viewer, commands: Commands, player: Player | None = None) -> str | None:
    """Queue the command in a viewer's message, or steer the player; returns the reason if it is refused."""
    why = _refusal(message, viewer, commands, player)
    if why is not None:
        commands.refuse()
    return why


def _refusal(message: str | bytes, viewer: Viewer, commands: Commands, player: Player | None) -> str | None:
    try:
        parsed = json.loads(message) if isinstance(message, str) else None
    except (ValueError, RecursionError):
        parsed = None
    if not isinstance(parsed, dict):
        return f"{_shown(message)} is not a JSON object: expected {FORMS}"
    name = parsed.get("cmd")
    if name == "play":
        return _play(parsed, message, player)
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


def _play(parsed: dict[str, Any], message: str | bytes, player: Player | None) -> str | None:
    """Steer the player; returns the reason if it is refused."""
    if player is None:
        return "no recording is played that a page can steer"
    at_s, speed, on = (parsed.get(key) for key in ("at_s", "speed", "on"))
    floats = [as_float(one) for one in (at_s, speed) if one is not None]
    numbers = all(one is not None and math.isfinite(one) for one in floats)
    known = parsed.keys() <= {"cmd", "at_s", "speed", "on"} and (on is None or isinstance(on, bool))
    if not (numbers and known and (speed is None or speed > 0)):
        return f'{_shown(message)}: expected {{"cmd": "play"}} with numbers "at_s", "speed", and "on": true or false'
    if speed is not None:
        player.set_speed(float(speed))
    if on is not None:
        player.pause(on=not on)
    if at_s is not None:
        player.jump(float(at_s))
    return None


def _switch(parsed: dict[str, Any]) -> bool | None:
    on = parsed.get("on")
    return on if isinstance(on, bool) and parsed.keys() == {"cmd", "on"} else None


def _shown(message: str | bytes) -> str:
    shown = repr(message[:60])
    return shown if len(message) <= 60 else f"{shown[:-1]}...{shown[-1]}"
