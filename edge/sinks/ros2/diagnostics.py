"""State of a sensor in the terms of ROS's diagnostics: a level, a line of text, and values."""

from collections.abc import Iterable, Iterator, Mapping
from enum import IntEnum
from typing import Any, Final, NamedTuple

from edge.perception.result import Result
from edge.sinks.json_encoding import record
from edge.sinks.ros2.cdr_messages import DIAGNOSTIC_ARRAY, header
from firmware_bridge.schedule import SHOWN_SILENT_S

_LOSSES: Final = ("dropped", "overruns", "missed", "missing_taxels", "unwritten")


class Level(IntEnum):
    """Level of a status, numbered as in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


_STATES: Final = {"incomplete": Level.ERROR, "zeroing": Level.WARN, "baseline_in_doubt": Level.ERROR}


class Diagnosis(NamedTuple):
    """State of a sensor: the worst level of all findings, their text, else the result's state, and values by name."""

    level: Level
    text: str
    values: Mapping[str, str]


def diagnose(
    result: Result, counters: Mapping[str, int], before: Mapping[str, int], silence_s: float | None, trouble: str | None
) -> Diagnosis:
    """Return the state of a sensor by its newest result.

    Losses are those since the counters before; `silence_s` is None where scans are of another time, and `trouble` is
    what the link has reported and not withdrawn.
    """
    losses = {name: counters.get(name, 0) - before.get(name, 0) for name in _LOSSES}
    findings = list(_findings(result, losses, silence_s, trouble))
    level = max((level for level, _ in findings), default=Level.OK)
    text = "; ".join(text for _, text in findings) or result.state
    return Diagnosis(level, text, _values(result, counters, silence_s))


def _findings(
    result: Result, losses: Mapping[str, int], silence_s: float | None, trouble: str | None
) -> Iterator[tuple[Level, str]]:
    if result.source != "device":
        yield Level.WARN, f"{result.source.upper()}, not a sensor"
    if silence_s is not None and silence_s >= SHOWN_SILENT_S:
        yield Level.STALE, f"no scan for {silence_s:.0f} s"
    if trouble is not None:
        yield Level.ERROR, trouble
    if result.state in _STATES:
        yield _STATES[result.state], result.note or result.state.replace("_", " ")
    if result.dead:
        yield Level.WARN, f"without taxel {', '.join(f'{taxel} ({why})' for taxel, why in result.dead.items())}"
    if result.state == "contact" and result.trusted is False:
        yield Level.WARN, f"pattern not to be believed: {result.untrusted_text}"
    if result.drift is not None and result.drift.step_counts:
        yield Level.WARN, f"rest level off by {result.drift.step_counts:.0f} counts"
    yield from ((Level.WARN, f"{count} {name}") for name, count in losses.items() if count > 0)


def _values(result: Result, counters: Mapping[str, int], silence_s: float | None) -> dict[str, str]:
    values = {name: _text(value) for name, value in record(result).items() if isinstance(value, str | float | int)}
    if silence_s is not None:
        values["scan_age_s"] = _text(silence_s)
    values["dead"] = ", ".join(f"{taxel}: {reason}" for taxel, reason in result.dead.items())
    if result.wrench is None and result.scan.vendor_force_n is None:
        known = "counts only" if result.force_n is None else "z alone, which is on force_z_n"
        values["wrench"] = f"not published: of the force there is {known}; a model with traction gives all of it"
    return values | {name: str(count) for name, count in counters.items() if count}


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def diagnostics_message(statuses: Iterable[tuple[str, str, Diagnosis]], unix_ns: int) -> bytes:
    """Return the states of sensors, each with its name and its sensor, as a message."""
    status = [
        {
            "level": said.level,
            "name": name,
            "message": said.text,
            "hardware_id": sensor,
            "values": [{"key": key, "value": value} for key, value in said.values.items()],
        }
        for name, sensor, said in statuses
    ]
    return DIAGNOSTIC_ARRAY.encode({"header": header("", unix_ns), "status": status})
