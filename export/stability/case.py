"""One case of the stability table."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from train.report import Row

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Case:
    """One part in one case at one severity.

    Attributes:
        part: which computes.
        case: what is stiff or extreme.
        severity: how much of it, with its unit.
        what: is measured.
        value: of that; None where a case is to be refused and nothing is measured.
        most: that it may be, or None for a limit without.
        run_ms: run time, in [ms].
        guard: the error that refuses the case.
        note: steps, iterations, or why the bound is what it is.
        limit: the value tells where something ends, as the docs say.
        least: that it has to be, of a limit or of how far a refused case has come.
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
        """Within its bounds, and there is one; or refused with nothing to measure."""
        if self.value is None:
            return bool(self.guard)
        if self.most is None and self.least is None:
            return False
        above, below = self.least is None or self.value >= self.least, self.most is None or self.value <= self.most
        return above and below  # neither, if it is not a number

    def cells(self) -> Row:
        """As a table shows it."""
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
    """What some work gives, and its run time in [ms]."""
    start = time.perf_counter()
    given = work()
    return given, 1e3 * (time.perf_counter() - start)


def refused(
    part: str, case: str, severity: str, work: Callable[[], object], by: type[Exception], saying: str = ""
) -> Case:
    """A case that is to end in a clear error, which says something: broken if it does not."""
    try:
        work()
    except by as error:
        if saying in str(error):
            return Case(part, case, severity, "refused", None, None, guard=f"{type(error).__name__}: {error}")
        return Case(
            part, case, severity, "refused", float("nan"), 0.0, note=f"refused, but not for {saying!r}: {error}"
        )
    return Case(part, case, severity, "refused", float("nan"), 0.0, note=f"expected {by.__name__}, but there was none")
