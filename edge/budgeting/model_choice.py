"""Which model a budget of run time buys, and the ladder of models to step on when it stops fitting."""

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Candidate:
    """A model that may run, and what it costs on this machine.

    Attributes:
        name: of the model.
        psnr_db: on the frozen test set with all its taps given, in [dB].
        p50_us: median run time at the sensor's rate, in [us].
        p99_us: 99th percentile of the same, in [us].
    """

    name: str
    psnr_db: float
    p50_us: float
    p99_us: float

    def __str__(self) -> str:
        return f"{self.name} ({self.psnr_db:.2f} dB, p99 {self.p99_us:.0f} us)"


@dataclass(frozen=True, slots=True)
class Choice:
    """What a budget buys.

    Attributes:
        ladder: fastest first; every rung has less error than those below.
        rung: index of the chosen one.
        fits: False where none fits, and the fastest was taken.
        why: in one line.
    """

    ladder: tuple[Candidate, ...]
    rung: int
    fits: bool
    why: str


def ladder_of(candidates: Iterable[Candidate]) -> tuple[Candidate, ...]:
    """Candidates that none is both faster and no worse than, fastest first.

    The order is that of medians: one hiccup of a shared host in a short calibration makes a 99th percentile, and must
    not take a rung away.
    """
    rungs: list[Candidate] = []
    for candidate in sorted(candidates, key=lambda candidate: (candidate.p50_us, -candidate.psnr_db)):
        if not rungs or candidate.psnr_db > rungs[-1].psnr_db:
            rungs.append(candidate)
    return tuple(rungs)


def choose(candidates: Iterable[Candidate], budget_us: float) -> Choice:
    """The candidate of least error whose 99th percentile is within the budget, else the fastest.

    Args:
        candidates: at least one.
        budget_us: longest run time of a pattern, in [us].

    Raises:
        ValueError: no candidates.
    """
    candidates = tuple(candidates)
    ladder = ladder_of(candidates)
    if not ladder:
        raise ValueError("no candidates, expected at least one")
    fitting = [rung for rung, candidate in enumerate(ladder) if candidate.p99_us <= budget_us]
    rung = fitting[-1] if fitting else 0
    if not fitting:
        why = f"no model fits, {ladder[0]} is the fastest of {len(candidates)}: patterns will be late"
    elif rung == len(ladder) - 1:
        why = f"{ladder[rung]} fits, the least error of {len(candidates)}"
    else:
        why = f"{ladder[rung]} is the least error that fits; {ladder[rung + 1]} does not"
    return Choice(ladder, rung, bool(fitting), f"budget {budget_us:g} us: {why}")
