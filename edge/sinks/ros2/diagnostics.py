"""State of each sensor in the terms of ROS's diagnostics: a level, a line of text, and values."""

from collections.abc import Iterator, Mapping
from enum import IntEnum
from typing import Any, Final

from edge.perception.event import Event
from edge.perception.result import Result
from edge.sinks.json_records import record
from edge.sinks.ros2.messages import DIAGNOSTIC_ARRAY, header
from firmware_bridge.schedule import SHOWN_SILENT_S

_LOSSES: Final = ("dropped", "overruns", "missed", "missing_taxels", "unwritten")
OUTAGES: Final = ("lost", "silent")


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Diagnostics:
    """State of each sensor, from which a message is made once a second."""

    def __init__(self, topic: str) -> None:
        """Begin without a sensor; `topic` is the first part of their names."""
        self._topic = topic
        self._last: dict[str, Result] = {}
        self._troubles: dict[tuple[str, str], str] = {}  # of links, not withdrawn, by sensor and kind of event
        self._counters: Mapping[str, int] = {}
        self._counters_before: Mapping[str, int] = {}

    def follow(self, result: Result, counters: Mapping[str, int]) -> None:
        """Take a result: its sensor is there."""
        sensor = result.scan.sensor
        self._last[sensor], self._counters = result, counters
        for kind in OUTAGES if self._troubles else ():
            self._troubles.pop((sensor, kind), None)

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Take an event of some sensors."""
        self._counters = counters
        for sensor in self._last:
            if event.sensor not in (None, sensor) or not sensor.startswith(event.sensors):
                continue
            if event.kind in (*OUTAGES, "trouble"):
                self._troubles[sensor, event.kind] = event.text
            elif event.kind == "well":
                self._troubles.pop((sensor, "trouble"), None)

    def message(self, unix_ns: int, now_ns: int | None, *, ended: bool = False) -> bytes:
        """Return the states as a diagnostic_msgs/DiagnosticArray; losses are those since the message before.

        `now_ns` is the time on the scans' clock, None where they are of another time.
        """
        statuses = []
        for sensor, result in self._last.items():
            silence_s = None if now_ns is None else (now_ns - result.scan.time_ns) / 1e9
            findings = [(Level.STALE, "ended")] if ended else list(self._findings(sensor, result, silence_s))
            values = _values(result, self._counters, silence_s)
            statuses.append(
                {
                    "level": max((level for level, _ in findings), default=Level.OK),
                    "name": f"{self._topic}: {sensor}",
                    "message": "; ".join(text for _, text in findings) or result.state,
                    "hardware_id": sensor,
                    "values": [{"key": key, "value": value} for key, value in values.items()],
                }
            )
        self._counters_before = self._counters
        return DIAGNOSTIC_ARRAY.encode({"header": header("", unix_ns), "status": statuses})

    def _findings(self, sensor: str, result: Result, silence_s: float | None) -> Iterator[tuple[int, str]]:
        if result.source != "device":
            yield Level.WARN, f"{result.source.upper()}, not a sensor"
        if silence_s is not None and silence_s >= SHOWN_SILENT_S:
            yield Level.STALE, f"no scan for {silence_s:.0f} s"
        yield from ((Level.ERROR, text) for (name, _), text in self._troubles.items() if name == sensor)
        if result.state in ("incomplete", "zeroing", "baseline_in_doubt"):
            level = Level.WARN if result.state == "zeroing" else Level.ERROR
            yield level, result.note or result.state.replace("_", " ")
        if result.dead:
            yield Level.WARN, f"without taxel {', '.join(f'{taxel} ({why})' for taxel, why in result.dead.items())}"
        if result.state == "contact" and result.trusted is False:
            yield Level.WARN, f"pattern not to be believed: {result.untrusted_text}"
        if result.drift is not None and result.drift.step_counts:
            yield Level.WARN, f"rest level off by {result.drift.step_counts:.0f} counts"
        for name in _LOSSES:
            count = self._counters.get(name, 0) - self._counters_before.get(name, 0)
            if count > 0:
                yield Level.WARN, f"{count} {name}"


def _values(result: Result, counters: Mapping[str, int], silence_s: float | None) -> dict[str, str]:
    values = {name: _text(value) for name, value in record(result).items() if isinstance(value, str | float | int)}
    if silence_s is not None:
        values["scan_age_s"] = _text(silence_s)
    values["dead"] = ", ".join(f"{taxel}: {reason}" for taxel, reason in result.dead.items())
    return values | {name: str(count) for name, count in counters.items() if count}


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
