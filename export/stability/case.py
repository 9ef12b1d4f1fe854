"""One case of the stability table."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from train.report import Row

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Case:
    """Result of one part in one case at one severity.

    Attributes:
        part: part of the code that computes.
        case: description of the stiff or extreme input.
        severity: its amount, with its unit.
        what: measured quantity.
        value: its value; None if the case must be refused and nothing is measured.
        most: upper bound, or None for a limit without one.
        run_ms: run time, in [ms].
        guard: error that refuses the case.
        note: steps, iterations, or the reason for the bound.
        limit: True where the value shows a limit that the docs state.
        least: lower bound, of a limit or of the progress before a refusal.
    """

    part: str
    case: str
    severity: str
    what: str
    value: float | None
    most: float | None
    run_ms: float | None = None
    guard: str = ""
    note: str = ""
    limit: bool = False
    least: float | None = None

    @property
    def holds(self) -> bool:
        """True within its bounds, of which there is at least one, or if refused without a measurement."""
        if self.value is None:
            return bool(self.guard)
        if self.most is None and self.least is None:
            return False
        above, below = self.least is None or self.value >= self.least, self.most is None or self.value <= self.most
        return above and below  # neither holds for NaN

    def cells(self) -> Row:
        """Return the case as cells of a table."""
        verdict = "refused" if self.guard else "limit" if self.limit else "holds"
        return {
            "case": self.case,
            "severity": self.severity,
            "what": self.what,
            "value": self.value,
            "at least": self.least,
            "at most": self.most,
            "run time ms": self.run_ms,
            "verdict": verdict if self.holds else "BROKEN",
            "note": self.guard or self.note,
        }


def timed(work: Callable[[], _T]) -> tuple[_T, float]:
    """Return the result of some work, and its run time in [ms]."""
    start = time.perf_counter()
    given = work()
    return given, 1e3 * (time.perf_counter() - start)


def refused(
    part: str, case: str, severity: str, work: Callable[[], object], by: type[Exception], saying: str = ""
) -> Case:
    """Return a case that must end in an error whose message contains a text; broken if it does not."""
    try:
        work()
    except by as error:
        if saying in str(error):
            return Case(part, case, severity, "refused", None, None, guard=f"{type(error).__name__}: {error}")
        return Case(
            part, case, severity, "refused", float("nan"), 0.0, note=f"refused, but not for {saying!r}: {error}"
        )
    return Case(part, case, severity, "refused", float("nan"), 0.0, note=f"expected {by.__name__}, but there was none")
