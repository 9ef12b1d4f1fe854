"""Ratios of measurements with 95 % intervals, by resampling of blocks that were measured in turn."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

SEED: Final = 0
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


def ratio_of(over: Sequence[float], under: Sequence[float]) -> Ratio:
    """Return the ratio of the medians of two measurements' blocks, of which those of one place belong together.

    Raises:
        ValueError: no blocks, or not as many of both.
    """
    above, below = np.asarray(over, dtype=np.float64), np.asarray(under, dtype=np.float64)
    if not len(above) or len(above) != len(below):
        raise ValueError(f"{len(above)} blocks over {len(below)}, expected some, and as many of both")
    drawn = np.random.default_rng(SEED).integers(len(above), size=(_RESAMPLES, len(above)))
    ratios = np.median(above[drawn], axis=1) / np.median(below[drawn], axis=1)
    low, high = np.quantile(ratios, _QUANTILES)
    return Ratio(float(np.median(above) / np.median(below)), float(low), float(high))
