"""Viewers of the live page: what each has seen, is sent and asks for."""

from typing import Final

from edge.mapping.sink import MapState
from edge.pipeline.commands import FORMS, WAITING, Commands, runtime_command
from edge.pipeline.pose_queue import json_object
from edge.view.frames import Frames

MOST_VIEWERS: Final = 8
LATE_S: Final = 0.5
"""Age of an unanswered ping, in [s], from which nothing more is sent: the frames on their way are old already."""


class Viewer:
    """Viewer of the page; every frame holds the newest values, however long ago the frame before was sent.

    Attributes:
        paused: no results meanwhile; events go on.
        pinged_s: time since which a ping is unanswered, in [s]; None while none is.
    """

    def __init__(self) -> None:
        self.paused = False
        self.pinged_s: float | None = None
        self._seen: dict[str, int] = {}
        self._sent_number = 0
        self._seen_map: MapState | None = None

    def keeps_up(self, now_s: float) -> bool:
        """Return whether the viewer has read what it was sent, as an answered ping shows."""
        return self.pinged_s is None or now_s - self.pinged_s < LATE_S

    def due(self, frames: Frames) -> list[bytes]:
        """Return the frames that are new since the last call.

        These are events, and unless the viewer has paused one frame a sensor and one of the map.
        """
        due: list[bytes] = []
        for number, frame in frames.events(self._sent_number):
            self._sent_number = number
            due.append(frame)
        if self.paused:
            return due
        for sensor, number in frames.numbers.items():
            seen = self._seen.get(sensor, 0)
            if number > seen:
                due.append(frames.result(sensor, seen))
                self._seen[sensor] = number
        if frames.map is not None and frames.map is not self._seen_map:
            due.append(frames.of_map(frames.map))
            self._seen_map = frames.map
        return due


def execute(message: str | bytes, viewer: Viewer, commands: Commands) -> str | None:
    """Queue the command in a viewer's message, JSON as on stdin, or pause the viewer.

    Returns the reason if it is refused.
    """
    why = _refusal(message, viewer, commands)
    if why is not None:
        commands.refuse()
    return why


def _refusal(message: str | bytes, viewer: Viewer, commands: Commands) -> str | None:
    parsed = json_object(message) if isinstance(message, str) else None
    if parsed is not None and parsed.get("cmd") == "pause" and isinstance(parsed.get("on"), bool):
        viewer.paused = parsed["on"]
        return None
    command = None if parsed is None else runtime_command(parsed)
    if command is None:
        shown = repr(message[:60])
        shown = shown if len(message) <= 60 else f"{shown[:-1]}...{shown[-1]}"
        return f'{shown} is not a command: expected {FORMS}, or {{"cmd": "pause", "on": true}}'
    if commands.full:
        return f"{WAITING} commands are waiting: repeat it when the run has executed them"
    commands.put(command)
    return None
