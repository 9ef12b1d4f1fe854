"""Choice of the model of least error whose run time fits a budget."""

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Candidate:
    """Model that may run, with its error and its cost on this machine.

    Attributes:
        name: of the model.
        psnr_db: on the frozen test set with all its taps in the window, in [dB].
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
    """Chosen model, with the reason.

    Attributes:
        name: of the model.
        fits: False if no model fits, and the fastest was taken.
        why: the reason in one line.
    """

    name: str
    fits: bool
    why: str


def choose(candidates: Iterable[Candidate], budget_us: float) -> Choice:
    """Choose the candidate of least error whose 99th percentile is within the budget, else the one of least median.

    Args:
        candidates: at least one.
        budget_us: longest run time of a pattern, in [us].

    Raises:
        ValueError: no candidates.
    """
    candidates = tuple(candidates)
    if not candidates:
        raise ValueError("no candidates, expected at least one")
    best = max(candidates, key=_merit)
    fitting = [candidate for candidate in candidates if candidate.p99_us <= budget_us]
    # The median, since one hiccup of a shared host in a short calibration decides a 99th percentile.
    chosen = max(fitting, key=_merit) if fitting else min(candidates, key=lambda one: (one.p50_us, -one.psnr_db))
    if not fitting:
        why = f"no model fits, {chosen} is the fastest of {len(candidates)}: patterns will be late"
    elif chosen.psnr_db == best.psnr_db:
        why = f"{chosen} fits, the least error of {len(candidates)}"
    else:
        why = f"{chosen} is the least error that fits; {best} does not"
    return Choice(chosen.name, bool(fitting), f"budget {budget_us:g} us: {why}")


def _merit(candidate: Candidate) -> tuple[float, float]:
    return candidate.psnr_db, -candidate.p50_us
