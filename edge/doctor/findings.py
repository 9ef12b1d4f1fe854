"""Findings of the doctor: what was measured, expected and is to be done, and all of them as text."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from edge.terminal.argument_types import wrapped

Verdict = Literal["ok", "look", "wrong", "not known"]


@dataclass(frozen=True, slots=True)
class Finding:
    """Finding on one thing that was examined; "look" is for what works but may not for long."""

    name: str
    verdict: Verdict
    measured: str  # with its unit
    norm: str = ""  # expected range; empty where that goes without saying
    remedy: str = ""  # in plain words; empty where there is nothing to do
    sensor: str | None = None  # its name; None for the link


def judged(name: str, verdict: Verdict, measured: str, norm: str, remedy: str) -> Finding:
    """Return a finding, which has a remedy unless all is well."""
    return Finding(name, verdict, measured, norm, "" if verdict == "ok" else remedy)


def graded(value: float, look: float, wrong: float) -> Verdict:
    """Return the verdict on a value of which less is better, by the largest values that are "ok" and "look"."""
    return "ok" if value <= look else "look" if value <= wrong else "wrong"


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the gravest verdict; "not known" counts as ok."""
    present = set(verdicts)
    return "wrong" if "wrong" in present else "look" if "look" in present else "ok"


def summary(findings: Iterable[Finding]) -> str:
    """Return a short count of the findings that are not ok; "not known" is neither well nor wrong."""
    count = Counter(finding.verdict for finding in findings)
    unknown = [f"{count['not known']} not known"] if count["not known"] else []
    if count["wrong"] or count["look"]:
        return ", ".join([f"{count['wrong']} wrong", f"{count['look']} to look at", *unknown])
    return ", ".join(["nothing wrong", *unknown]) if unknown else "all well"


def page(findings: Sequence[Finding], columns: int) -> str:
    """Return all findings as text, those of the link first, in lines of `columns` at most unless a word is wider."""
    marks = {"ok": "ok", "look": "LOOK", "wrong": "WRONG", "not known": "?"}
    lines: list[str] = []
    indent = " " * 8
    for sensor in dict.fromkeys(finding.sensor for finding in findings):
        lines.append("link" if sensor is None else f"sensor {sensor}")
        of_sensor = [finding for finding in findings if finding.sensor == sensor]
        for finding in of_sensor:
            norm = f" (norm: {finding.norm})" if finding.norm else ""
            text = f"{finding.name}: {finding.measured}{norm}"
            lines += wrapped(text, columns, f"  {marks[finding.verdict]:6}", indent)
            lines += wrapped(finding.remedy, columns, f"{indent}-> ", f"{indent}   ")
    return "\n".join(lines)
