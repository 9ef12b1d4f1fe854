"""Readings of each taxel that reached the reader of a run among faults, by the injector's truth."""

from bisect import bisect_left
from collections import defaultdict
from typing import Final

import numpy as np
from fault_frames import READ
from fault_log import Told
from fault_truth import FATES

from firmware_bridge.scans.can_id_maps import USPA44_MAP

FLIPPED: Final = FATES.index("flipped")
STUCK: Final = FATES.index("stuck")


class SentTaxel:
    """The readings of one taxel that were handed on, in order, and how far records have shown them.

    Attributes:
        rows: fate, time on the bus in [us], times before and after handing on in [ns].
        next: the first row that no record can have shown yet.
        shown: the row that was shown last; -1 before.
        left_out: a record that may have shown a later one was left out, since its reader was too slow.
    """

    def __init__(self) -> None:
        """Begin without readings."""
        self.rows: list[tuple[int, int, int, int]] = []
        self._cycles: list[int] = []
        self._readings: list[tuple[int, int, int]] = []
        self.next = 0
        self.shown = -1
        self.left_out = False
        self._places: dict[tuple[int, int, int], list[int]] = defaultdict(list)

    def add(
        self, reading: tuple[int, int, int], fate: int, bus_us: int, handed_ns: int, written_ns: int, cycle: int
    ) -> None:
        """Append one: as `rows`, and the number of the sensor's cycle."""
        self._cycles.append(cycle)
        self._places[reading].append(len(self.rows))
        self._readings.append(reading)
        self.rows.append((fate, bus_us, handed_ns, written_ns))

    def show(self, reading: tuple[int, int, int]) -> bool:
        """Go on to the next row of this reading; False if there is none."""
        places = self._places.get(reading, [])
        at = bisect_left(places, self.next)
        if at == len(places):
            return False
        self.shown, self.next, self.left_out = places[at], places[at] + 1, False
        return True

    def newest(self, bus_us: int) -> tuple[int, int, int, int] | None:
        """Return the row that was received last; None before the first.

        Of the rows that a record which was left out may have shown, it is the newest before a time on the bus in [us]:
        the reading is at least that old.
        """
        at = self.shown
        while self.left_out and at + 1 < len(self.rows) and self.rows[at + 1][1] < bus_us:
            at += 1
        return None if at < 0 else self.rows[at]

    def catch_up(self, bus_us: int) -> None:
        """Skip readings of a stuck taxel that are alike, since one that an outage lost looks like the next.

        Args:
            bus_us: time up to which equal readings are skipped: the next one was not on the bus before, in [us].
        """
        while self.rows[self.shown][1] < bus_us and self._sent_again:
            self.shown, self.next = self.next, self.next + 1

    @property
    def flipped(self) -> bool:
        """True where a digit of the shown reading was changed, so that it may look like another cycle's."""
        return self.rows[self.shown][0] == FLIPPED

    @property
    def stuck(self) -> bool:
        """True where the taxel sent the shown reading in more than one cycle, so that its cycle is unknown."""
        if self.rows[self.shown][0] == STUCK:
            return True
        # A stuck frame may have been repeated or held back as well, and then that is its fate.
        around = range(max(self.shown - 1, 0), min(self.shown + 2, len(self.rows)))
        reading, cycle = self._readings[self.shown], self._cycles[self.shown]
        return any(self._readings[at] == reading and self._cycles[at] != cycle for at in around)

    @property
    def cycle(self) -> int | None:
        """Number of the sensor's cycle that is shown; None where it is unknown."""
        return None if self.flipped or self.stuck else self._cycles[self.shown]

    @property
    def _sent_again(self) -> bool:
        if self.next >= len(self.rows):
            return False
        return self.rows[self.next][0] == STUCK and self._readings[self.next] == self._readings[self.shown]


def handed_on(told: Told) -> dict[tuple[str, int], SentTaxel]:
    """Return what reached the reader, by sensor and taxel."""
    frames = told.frames[told.frames["fate"] < len(READ)]
    frames = frames[np.isin(frames["can_id"], list(USPA44_MAP.taxels))]
    taxels: dict[tuple[str, int], SentTaxel] = defaultdict(SentTaxel)
    names = ("can_id", "xyz", "fate", "bus_us", "handed_ns", "written_ns", "cycle")
    columns = (frames[name].tolist() for name in names)
    for can_id, (x, y, z), *row in zip(*columns, strict=True):
        taxels[USPA44_MAP.taxels[can_id]].add((x, y, z), *row)
    return taxels
