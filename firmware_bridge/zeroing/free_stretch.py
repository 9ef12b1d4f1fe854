"""Search of a recording for the scans during which its pad is free and still."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.errors import BaselineRefusedError
from firmware_bridge.scans.scan import ABSENT
from firmware_bridge.zeroing.baseline import (
    FEWEST_RECORDED,
    FEWEST_SCANS,
    Baseline,
    refuse_load,
    refuse_motion,
    unwrapped,
)


class Stretch(NamedTuple):
    """Scans during which a pad is free and still: their rows (n,) in the recording, and counts (n, 3, rows, cols)."""

    rows: NDArray[np.intp]
    counts: NDArray[np.int32]
    # True if something touches the pad elsewhere in the recording. Without it, a pad that holds something all the time
    # cannot be distinguished from a free one.
    touched: bool
    within_counts: float | None = None  # how far a taxel may be off where the pad still recovers

    @property
    def opens(self) -> bool:
        """True if a live run would zero from it: it begins the recording, and is as long as a zeroing."""
        return self.within_counts is None and len(self.rows) >= FEWEST_SCANS and bool(self.rows[0] == 0)

    def baseline(self, sensor: str, created_unix_s: float) -> Baseline:
        """Return the baseline of these scans, taken at a time in [s] since 1970, NaN if that is unknown."""
        taken = Baseline.from_counts(sensor, self.counts, created_unix_s)
        return replace(taken, origin="recording" if self.touched else "unsure")


def free_stretch(counts: NDArray[np.int32]) -> Stretch:
    """Return the FEWEST_RECORDED scans with the lowest z in which the pad is still, or the first FEWEST_SCANS.

    A grip can be as still as a free pad for half a second. So the stretch has to be the freest one, and no taxel of it
    may lie above the freest scans of the whole recording, as with an earlier baseline. Where the pad is still nowhere,
    but was let go of, these are the freest scans. Raw counts (n, 3, rows, cols) are of all scans of a sensor. Raises
    BaselineRefusedError, with the reason at the freest place.
    """
    whole = (counts != ABSENT).all(axis=(1, 2, 3))
    whole[1:] &= (counts[1:] != counts[:-1]).any(axis=(1, 2, 3))  # a repeated scan is no second sample
    rows = np.flatnonzero(whole)
    taken = counts[rows]
    if len(rows) < FEWEST_RECORDED:
        raise BaselineRefusedError(f"{len(rows)} whole new scans, expected at least {FEWEST_RECORDED} of a free pad")
    z = unwrapped(taken)[:, 2].sum(axis=(1, 2), dtype=np.int64)
    freest = np.argsort(z, kind="stable")[: max(FEWEST_RECORDED, round(0.01 * len(rows)))]
    reference = Baseline.from_counts("freest", taken[freest], 1.0)
    if len(rows) >= FEWEST_SCANS and _fault(taken[:FEWEST_SCANS], reference) is None:
        return Stretch(rows[:FEWEST_SCANS], taken[:FEWEST_SCANS], _touched(z, z[:FEWEST_SCANS]))
    level = np.convolve(z, np.ones(FEWEST_RECORDED), "valid")
    begins = np.arange(0, len(level), max(1, len(level) // 2000))  # so that the search ends within a second or two
    least: BaselineRefusedError | None = None
    freest_first = begins[np.argsort(level[begins], kind="stable")].tolist()
    for begin in freest_first:
        fault = _fault(taken[begin : begin + FEWEST_RECORDED], reference)
        if fault is None:
            free = slice(begin, begin + FEWEST_RECORDED)
            return Stretch(rows[free], taken[free], _touched(z, z[free]))
        least = least or fault
    lowest = slice(freest_first[0], freest_first[0] + FEWEST_RECORDED)
    spread = float(np.ptp(np.percentile(unwrapped(taken[lowest]), (5, 95), axis=0), axis=0).max())
    # Real pads recover by some tens of counts in the second after a grip.
    if spread <= 60 and _touched(z, z[lowest]):
        return Stretch(rows[lowest], taken[lowest], touched=True, within_counts=spread / 2)
    raise BaselineRefusedError(f"nowhere free and still for {FEWEST_RECORDED} scans; where it is freest, {least}")


def _touched(z: NDArray[np.int64], free: NDArray[np.int64]) -> bool:
    """Return True if some scans are as far above those of a stretch as a contact; a few may be damaged."""
    # A contact of 1.3 N raises the summed z by 1500 counts; a free pad warms by less within a recording.
    return bool((z > np.median(free) + 1500).sum() >= 5)


def _fault(counts: NDArray[np.int32], reference: Baseline) -> BaselineRefusedError | None:
    """Return the reason for which these scans are none of a free and still pad."""
    try:
        refuse_motion(counts)
        refuse_load(Baseline.from_counts("freest", counts, 1.0), reference)
    except BaselineRefusedError as refusal:
        return refusal
    return None
