"""Ratios of run times with 95 % intervals, by resampling of whole blocks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

SEED: Final = 0
MOST_BLOCKS: Final = 10_000
"""Most blocks that resampling can hold: each is drawn a thousand times."""
LONGEST_US: Final = 1e12
_RESAMPLES: Final = 2000
_QUANTILES: Final = (0.025, 0.975)


@dataclass(frozen=True, slots=True)
class Ratio:
    """Ratio of two medians, and its 95 % interval."""

    ratio: float
    low: float
    high: float

    def __str__(self) -> str:
        shown = [f"{float(f'{value:.3g}'):g}" for value in (self.ratio, self.low, self.high)]
        return f"{shown[0]} ({shown[1]}..{shown[2]})"

    @property
    def differs(self) -> bool:
        """True where 1 lies outside the interval."""
        return not self.low <= 1 <= self.high


def ratio_of(over: Sequence[float], under: Sequence[float], *, paired: bool) -> Ratio:
    """Return the ratio of the medians of two measurements' blocks.

    Args:
        over: median run time of each block.
        under: the other's.
        paired: True where blocks of one place were measured together, and are drawn together.

    Raises:
        ValueError: a measurement without blocks, with one that is no run time, or pairs that do not match.
    """
    above, below = np.asarray(over, dtype=np.float64), np.asarray(under, dtype=np.float64)
    if not len(above) or not len(below) or (paired and len(above) != len(below)):
        raise ValueError(f"{len(above)} blocks over {len(below)}, expected some, and as many where they are paired")
    for blocks in (above, below):
        if blocks.ndim != 1 or len(blocks) > MOST_BLOCKS or not ((blocks > 0) & (blocks < LONGEST_US)).all():
            raise ValueError(f"blocks {str(blocks[:4])[:60]}, expected at most {MOST_BLOCKS} run times in us")
    rng = np.random.default_rng(SEED)
    drawn_above = rng.integers(len(above), size=(_RESAMPLES, len(above)))
    drawn_below = drawn_above if paired else rng.integers(len(below), size=(_RESAMPLES, len(below)))
    ratios = _medians(above[drawn_above]) / _medians(below[drawn_below])
    low, high = np.quantile(ratios, _QUANTILES)
    return Ratio(float(np.median(above) / np.median(below)), float(low), float(high))


def _medians(drawn: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.median(drawn, axis=1)
