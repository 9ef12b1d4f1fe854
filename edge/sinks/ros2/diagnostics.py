"""State of a sensor in the terms of ROS's diagnostics: a level, a line of text, and values."""

from collections.abc import Mapping
from enum import IntEnum
from typing import Any, Final, NamedTuple

from edge.perception.result import Result
from edge.sinks.json_encoding import record
from firmware_bridge.silence import SHOWN_SILENT_S

_LOSSES: Final = ("dropped", "overruns", "missed", "missing_taxels", "unwritten")


class Level(IntEnum):
    """Level of a status, numbered as in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Diagnosis(NamedTuple):
    """State of a sensor.

    Attributes:
        level: the worst of all findings.
        text: every finding, or the state of the result where there is no finding.
        values: by name, with their units in the names.
    """

    level: Level
    text: str
    values: Mapping[str, str]


def diagnose(
    result: Result, counters: Mapping[str, int], before: Mapping[str, int], silence_s: float | None, trouble: str | None
) -> Diagnosis:
    """Return the state of a sensor.

    Args:
        result: newest result of the sensor.
        counters: up to now, of the whole run.
        before: counters at the previous diagnosis; losses since then are reported.
        silence_s: time since its last scan, in [s]; None where scans are of another time.
        trouble: what the link has reported and not withdrawn.
    """
    findings = list(_findings(result, silence_s, trouble))
    lost = {name: counters.get(name, 0) - before.get(name, 0) for name in _LOSSES}
    findings += [(Level.WARN, f"{count} {name}") for name, count in lost.items() if count > 0]
    level = max((level for level, _ in findings), default=Level.OK)
    text = "; ".join(text for _, text in findings) or result.state
    return Diagnosis(level, text, _values(result, counters, silence_s))


def _findings(result: Result, silence_s: float | None, trouble: str | None) -> list[tuple[Level, str]]:
    found: list[tuple[Level, str]] = []
    if result.source != "device":
        found.append((Level.WARN, f"{result.source.upper()}, not a sensor"))
    if silence_s is not None and silence_s >= SHOWN_SILENT_S:
        found.append((Level.STALE, f"no scan for {silence_s:.0f} s"))
    if trouble is not None:
        found.append((Level.ERROR, trouble))
    if result.state == "incomplete":
        found.append((Level.ERROR, result.note or "incomplete"))
    if result.state == "zeroing":
        found.append((Level.WARN, result.note or "zeroing"))
    if result.state == "baseline_in_doubt":
        found.append((Level.ERROR, result.note or "baseline in doubt"))
    if result.dead:
        dead = ", ".join(f"{taxel} ({reason})" for taxel, reason in result.dead.items())
        found.append((Level.WARN, f"without taxel {dead}"))
    if result.state == "contact" and result.trusted is False:
        found.append((Level.WARN, f"pattern not to be believed: {result.untrusted_text}"))
    if result.drift is not None and result.drift.step_counts:
        found.append((Level.WARN, f"rest level off by {result.drift.step_counts:.0f} counts"))
    return found


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
