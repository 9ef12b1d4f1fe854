"""Newest result of each sensor of a stream, for programs that act on the present. No I/O, no clock."""

import math
from dataclasses import dataclass
from typing import Final, Literal

from edge.errors import UsageError
from edge.perception.event import Event
from edge.perception.result import Result

LinkState = Literal["up", "silent", "lost", "ended"]
_DOWN: Final[dict[str, LinkState]] = {"silent": "silent", "lost": "lost"}
"""State of a link by the kind of the event that reports it."""


@dataclass(frozen=True, slots=True)
class Latest:
    """Newest result of a sensor, with all that decides whether it still holds.

    Attributes:
        result: None before the first.
        age_s: time since its reading was taken, at most, in [s]; it grows until the next scan arrives, and is infinite
            before the first result.
        link: "up"; "silent", no scan arrives; "lost", the adapter is gone; "ended", no more will come.
        new: False if an earlier call, or an iteration, returned this result.
        skipped: results of the sensor that nothing returned, since the last one that was.
    """

    result: Result | None
    age_s: float
    link: LinkState
    new: bool
    skipped: int


@dataclass(slots=True)
class _Newest:
    """Newest result of a sensor, and the number of results up to it that nothing returned yet."""

    result: Result
    unseen: int = 1


class NewestResults:
    """Newest results of all sensors, the state of their links, and whether the stream has ended."""

    def __init__(self) -> None:
        """Begin without a result, with links that are up."""
        self.ended = False
        self._sensors: dict[str, _Newest] = {}
        self._sensors_down: dict[str, LinkState] = {}
        self._links_down: dict[str, LinkState] = {}

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors that have a result, in the order of their first ones."""
        return tuple(self._sensors)

    def add(self, result: Result) -> None:
        """Take a result as it was made."""
        name = result.scan.sensor
        newest = self._sensors.get(name)
        if newest is None:
            self._sensors[name] = _Newest(result)
            return
        newest.result = result
        newest.unseen += 1

    def see(self, result: Result) -> None:
        """Count a result that an iteration returns now."""
        self._sensors[result.scan.sensor].unseen -= 1

    def tell(self, event: Event) -> None:
        """Follow the state of the links: an event is of a sensor, or of all whose names begin as it says."""
        down, key = (self._links_down, event.sensors) if event.sensor is None else (self._sensors_down, event.sensor)
        if event.kind in _DOWN:
            down[key] = _DOWN[event.kind]
        elif event.kind == "back":
            down.pop(key, None)

    def has_new(self, sensor: str | None) -> bool:
        """Return True if there is a result of a sensor that nothing returned yet; raises as `take` does."""
        newest = self._of(sensor)
        return newest is not None and newest.unseen > 0

    def take(self, sensor: str | None, now_ns: int) -> Latest:
        """Return the newest result of a sensor at a time in [ns]; None names the only one.

        Raises:
            UsageError: no sensor is named, and there are several.
        """
        newest = self._of(sensor)
        if newest is None:
            return Latest(None, math.inf, self._link(sensor), new=False, skipped=0)
        scan, unseen = newest.result.scan, newest.unseen
        newest.unseen = 0
        age_s = max(now_ns - scan.not_before_ns, 0) / 1e9
        return Latest(newest.result, age_s, self._link(scan.sensor), unseen > 0, max(unseen - 1, 0))

    def why_none(self, sensor: str | None) -> str:
        """Return what is known about a sensor without a new result, in a user's words."""
        names = ", ".join(sorted(self._sensors)) or "none"
        return f"link {self._link(sensor)}, sensors so far: {names}"

    def _of(self, sensor: str | None) -> _Newest | None:
        if sensor is not None:
            return self._sensors.get(sensor)
        if len(self._sensors) > 1:
            raise UsageError(f"there are sensors {', '.join(sorted(self._sensors))}: name one of them")
        return next(iter(self._sensors.values()), None)

    def _link(self, sensor: str | None) -> LinkState:
        if self.ended:
            return "ended"
        down = [state for prefix, state in self._links_down.items() if sensor is None or sensor.startswith(prefix)]
        down += [state for name, state in self._sensors_down.items() if sensor in (None, name)]
        return "lost" if "lost" in down else "silent" if down else "up"
