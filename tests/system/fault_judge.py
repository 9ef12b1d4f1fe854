"""Holds the records of a run among faults against the injector's truth, reading by reading."""

from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from fault_records import Seen

from firmware_bridge.emulation.fault_log import Told
from firmware_bridge.emulation.faults.frames import READ
from firmware_bridge.emulation.faults.truth import FATES
from firmware_bridge.scans.can_id_maps import USPA44_MAP

STALE_US: Final = 100_000
"""What a record gives as one reading of the pad was on the bus within this time."""
HELD_US: Final = 150_000
"""Of a taxel that did not come, the last reading is held for as long as that, by times of arrival."""
_FLIPPED, _STUCK = (FATES.index(name) for name in ("flipped", "stuck"))


@dataclass
class Found:
    """What the records of a run are worth.

    Attributes:
        records: of scans.
        patterns: of these, with a pattern.
        whole_patterns: of these, from sixteen readings of one press, all of them sent as they are.
        told_patterns: of these, from fewer, and the record says which are missing, held, dead or not renewed.
        false_patterns: neither; why, and of which record.
        flipped_patterns: with a reading in it that a flipped digit changed, which no reader can know.
        stuck_patterns: with a reading in it that a stuck taxel sends again, but that was lost when it sent it first.
        made_up: readings in records that were never sent, or sent before one that was shown already.
        shown: readings in records.
        unshown: readings handed on that are in no record, by sensor; open ones at the end are not among them.
        open_at_end: readings handed on after the last record.
        missing: taxels that records say did not come.
        spread_ms: of each pattern's fresh readings, from the first on the bus to the last, in [ms].
        held_ms: how old held readings were, when a pattern was made of them, in [ms].
        arrivals: of records with a fresh reading: when the newest one was handed on, and when the record says that it
            arrived, in [ns].
        latencies: of patterns: when the scan's last frame was handed on, in [ns]; and how much later its record was
            read, in [us].
        first_us, last_us: of each sensor, when the first and the last reading shown were on the bus, in [us].
        last_counters: in the last record.
    """

    records: int = 0
    patterns: int = 0
    whole_patterns: int = 0
    told_patterns: int = 0
    false_patterns: list[str] = field(default_factory=list)
    flipped_patterns: int = 0
    stuck_patterns: int = 0
    made_up: int = 0
    shown: int = 0
    unshown: int = 0
    open_at_end: int = 0
    missing: int = 0
    spread_ms: list[float] = field(default_factory=list)
    held_ms: list[float] = field(default_factory=list)
    arrivals: list[tuple[int, int]] = field(default_factory=list)
    latencies: list[tuple[int, float]] = field(default_factory=list)
    first_us: dict[str, int] = field(default_factory=dict)
    last_us: dict[str, int] = field(default_factory=dict)
    last_counters: Mapping[str, int] = field(default_factory=dict)


class _Taxel:
    """The readings of one taxel that were handed on, in order, and how far records have shown them."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, int, int]] = []  # fate, time on the bus in [us], time of handing on in [ns]
        self._readings: list[tuple[int, int, int]] = []
        self.next = 0
        self.shown = -1
        self._places: dict[tuple[int, int, int], list[int]] = defaultdict(list)

    def add(self, reading: tuple[int, int, int], fate: int, bus_us: int, handed_ns: int) -> None:
        self._places[reading].append(len(self.rows))
        self._readings.append(reading)
        self.rows.append((fate, bus_us, handed_ns))

    def show(self, reading: tuple[int, int, int]) -> bool:
        """Go on to the next row of this reading; False if there is none."""
        places = self._places.get(reading, [])
        at = bisect_left(places, self.next)
        if at == len(places):
            return False
        self.shown, self.next = places[at], places[at] + 1
        return True

    def catch_up(self, bus_us: int) -> None:
        """A stuck taxel's readings are all alike, and one that an outage swallowed is not told from the next.

        Args:
            bus_us: go on, as far as it sent the same again, to the first that was not on the bus before, in [us].
        """
        while self.rows[self.shown][1] < bus_us and self.next < len(self.rows) and self._sent_again:
            self.shown, self.next = self.next, self.next + 1

    @property
    def _sent_again(self) -> bool:
        return self.rows[self.next][0] == _STUCK and self._readings[self.next] == self._readings[self.shown]


def judge(seen: Sequence[Seen], told: Told) -> Found:
    """What the records are worth, held against the truth."""
    taxels = _handed_on(told)
    found = Found()
    for one in seen:
        found.last_counters = one.head["counters"]
        if one.counts is None:
            continue
        found.records += 1
        _follow(one, taxels, found)
    for rows in taxels.values():
        found.open_at_end += len(rows.rows) - rows.next
    handed_on = sum(len(rows.rows) for rows in taxels.values())
    found.unshown = handed_on - found.shown - found.open_at_end
    return found


def _handed_on(told: Told) -> dict[tuple[str, int], _Taxel]:
    frames = told.frames[told.frames["fate"] < len(READ)]
    frames = frames[np.isin(frames["can_id"], list(USPA44_MAP.taxels))]
    taxels: dict[tuple[str, int], _Taxel] = defaultdict(_Taxel)
    columns = (frames[name].tolist() for name in ("can_id", "xyz", "fate", "bus_us", "handed_ns"))
    for can_id, (x, y, z), fate, bus_us, handed_ns in zip(*columns, strict=True):
        taxels[USPA44_MAP.taxels[can_id]].add((x, y, z), fate, bus_us, handed_ns)
    return taxels


def _follow(one: Seen, taxels: Mapping[tuple[str, int], _Taxel], found: Found) -> None:
    sensor, fresh, renewed = one.head["sensor"], one.head["fresh"], one.head["renewed"]
    counts = [] if one.counts is None else one.counts.tolist()
    trouble: list[str] = []
    fates: Counter[int] = Counter()
    unheard = 0
    shown: dict[int, _Taxel] = {}
    for taxel in range(16):
        if not fresh >> taxel & 1:
            found.missing += 1
            continue
        rows = taxels.get((sensor, taxel))
        x, y, z = counts[taxel]
        if rows is None or not rows.show((x, y, z)):
            found.made_up += 1
            trouble.append(f"taxel {taxel} reads {x}, {y}, {z}, which it never sent")
            continue
        found.shown += 1
        shown[taxel] = rows
    newest_us = max((rows.rows[rows.shown][1] for rows in shown.values()), default=0)
    for taxel, rows in shown.items():
        rows.catch_up(newest_us - STALE_US)
        fate = rows.rows[rows.shown][0]
        fates[fate] += 1
        unheard += fate == _STUCK and bool(renewed >> taxel & 1) and str(taxel) not in one.head["dead"]
    bus_us = [rows.rows[rows.shown][1] for rows in shown.values()]
    handed = [rows.rows[rows.shown][2] for rows in shown.values()]
    if bus_us:
        found.first_us.setdefault(sensor, min(bus_us))
        found.last_us[sensor] = max(bus_us)
        found.arrivals.append((max(handed), one.head["time_ns"]))
    if not one.drawn:
        return
    found.patterns += 1
    if handed:
        found.latencies.append((max(handed), (one.read_ns - max(handed)) / 1e3))
    if bus_us:
        # Where the emulator itself is late, and makes up for it, nobody can see what lay between.
        spread_us = min(max(bus_us) - min(bus_us), (max(handed) - min(handed)) / 1e3)
        found.spread_ms.append(spread_us / 1e3)
        if spread_us > STALE_US:
            trouble.append(f"its readings are {found.spread_ms[-1]:.0f} ms apart")
        trouble += _held(one, taxels, max(bus_us), max(handed), found)
    else:
        trouble.append("no reading is fresh")
    found.flipped_patterns += fates[_FLIPPED] > 0
    found.stuck_patterns += unheard > 0
    if trouble:
        found.false_patterns.append(f"sensor {sensor}, scan {one.head['scan']}: {'; '.join(trouble)}")
    elif fresh == renewed == 0xFFFF and not one.head["dead"]:
        found.whole_patterns += 1
    else:
        found.told_patterns += 1


def _held(
    one: Seen, taxels: Mapping[tuple[str, int], _Taxel], newest_us: int, newest_ns: int, found: Found
) -> list[str]:
    """What is wrong with readings that a pattern was made from although they did not come with its scan."""
    trouble: list[str] = []
    for taxel in range(16):
        if one.head["fresh"] >> taxel & 1 or str(taxel) in one.head["dead"]:
            continue
        rows = taxels.get((one.head["sensor"], taxel))
        if rows is None or rows.shown < 0:
            trouble.append(f"taxel {taxel} is held, but was never heard")
            continue
        _, at_us, at_ns = rows.rows[rows.shown]
        held_us = min(newest_us - at_us, (newest_ns - at_ns) / 1e3)
        found.held_ms.append(held_us / 1e3)
        if held_us > HELD_US:
            trouble.append(f"taxel {taxel} is held for {held_us / 1e3:.0f} ms")
    return trouble
