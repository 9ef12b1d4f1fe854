"""Guided grips of a flat face: requests, and the readings of each grip. No I/O, no clock."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.doctor.press_guide import FREE_SCANS, TRIES, Dialogue, Guide, Reading, free, wait
from firmware_bridge.pad_geometry import USPA44, SensorGeometry

GRIPS: Final = 3
FIRM_COUNTS: Final = 800.0
"""Mean z at which a grip is firm, about 11 N."""
TOUCHED_COUNTS: Final = 100.0
DRAG_COUNTS: Final = 150.0
"""Least change of mean x and y together that counts as a push sideways, about 2 N."""
ACROSS: Final = 0.85
"""Largest share of the second push along the first one: 30 degrees apart at least."""
LEAST_SHARE: Final = 0.25
"""Least z of a taxel over the mean where a face lies on the whole pad."""
CHANGED_COUNTS: Final = 3.0
"""Least change of a mean of x, y or z from one kept reading to the next: however long a person holds still, it counts
once."""
MOST_READINGS: Final = 4000


class GuidedGrips(Guide):
    """Dialogue that asks for three grips of a flat face, each with two pushes sideways.

    Attributes:
        grips: readings (n, 3, rows, cols) of each grip so far.
        refused: what was wrong with the last grip that is not among them; empty if nothing was.
    """

    def __init__(self, geometry: SensorGeometry = USPA44) -> None:
        self.grips: list[NDArray[np.float32]] = []
        self.refused = ""
        self.enough_counts = FIRM_COUNTS * geometry.taxel_count
        super().__init__(geometry)

    def _all(self) -> Dialogue[None]:
        tries = 0
        say = ""
        while len(self.grips) < GRIPS and tries < GRIPS + TRIES:
            tries += 1
            number = f"Grip {len(self.grips) + 1} of {GRIPS}"
            ask = f"{say}{number}: press something flat, larger than the pad, on it, slowly from light to firm."
            held = yield from _grip(ask)
            if held is None:
                return
            z = np.mean([reading.zeroed[2] for reading in held[-FREE_SCANS:]], axis=0)
            self.refused = "" if (np.abs(z) >= LEAST_SHARE * np.abs(z.mean())).all() else "it did not cover the pad"
            if not self.refused:
                self.grips.append(np.array([reading.zeroed for reading in held]))
            say = f"Once more, {self.refused}. " if self.refused else ""
            last = len(self.grips) == GRIPS
            yield from wait("Thank you. Let go." if last else "Good. Let go.", free, FREE_SCANS)


def _grip(ask: str) -> Dialogue[list[Reading] | None]:
    """Return the readings of a grip from its first touch to its last push; None when patience is at its end.

    A grip that is not pushed is a grip all the same: then its x and y are not separated from the bulge.
    """
    held: list[Reading] = []

    def grown(reading: Reading) -> bool:
        _keep(held, reading)
        return _mean_z(reading) >= FIRM_COUNTS

    if (yield from wait(ask, grown, FREE_SCANS)) is None:
        return None
    first: NDArray[np.float64] | None = None
    for say in ("Hold it firmly, and push it sideways.", "Now push it across that direction, still firmly."):
        start = _shear(held[-1])
        pushed: list[NDArray[np.float64]] = []

        def felt(
            reading: Reading,
            start: NDArray[np.float64] = start,
            first: NDArray[np.float64] | None = first,
            pushed: list[NDArray[np.float64]] = pushed,
        ) -> bool:
            _keep(held, reading)
            push = _shear(reading) - start
            size = float(np.hypot(*push))
            along = 0.0 if first is None else abs(float(push @ first)) / max(size, 1e-9)
            if size >= DRAG_COUNTS and along <= ACROSS:
                pushed.append(push / size)
                return True
            return free(reading)

        if (yield from wait(say, felt, FREE_SCANS)) is None or not pushed:
            return held
        first = pushed[-1]
    return held


def _keep(held: list[Reading], reading: Reading) -> None:
    if _mean_z(reading) < TOUCHED_COUNTS or len(held) >= MOST_READINGS:
        return
    if not held or np.abs((reading.zeroed - held[-1].zeroed).mean(axis=(1, 2))).max() >= CHANGED_COUNTS:
        held.append(reading)


def _mean_z(reading: Reading) -> float:
    return abs(float(reading.zeroed[2].mean()))


def _shear(reading: Reading) -> NDArray[np.float64]:
    return reading.zeroed[:2].mean(axis=(1, 2), dtype=np.float64)
