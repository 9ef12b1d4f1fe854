"""Evaluation of the records of a run among faults against the injector's truth, reading by reading."""

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from fault_log import Told
from fault_records import Seen
from fault_sent import FLIPPED, STUCK, SentTaxel, handed_on

STALE_US: Final = 100_000
"""Longest time on the bus between the readings that a record gives as one scan of the pad."""
HELD_US: Final = 150_000
"""Longest time for which the last reading of a missing taxel is held, by times of arrival."""
READY_US: Final = 150_000
"""Longest time from when the newest reading of a pattern was handed on until the pattern is ready, where no note states
its age: 70 ms unread, which a reader may not notice, and 50 ms in the program, which need no note; the rest is for the
terminal of a busy kernel."""
_SAYS_ITS_AGE: Final = re.compile(r"\d s (old when it|after its newest reading) arrived")
ALL_FRESH: Final = 0xFFFF
"""Mask of a whole scan, in which no taxel is missing."""


@dataclass
class Found:
    """Evaluated records of a run.

    Attributes:
        records: records of scans.
        patterns: records with a pattern.
        whole_patterns: patterns from sixteen readings of one press, all of them sent as they are.
        told_patterns: patterns from fewer, where the record states which are missing, held, dead or not renewed.
        false_patterns: patterns that are neither; the reason and the record of each.
        flipped_patterns: patterns with a reading that a flipped digit changed, which no reader can detect.
        stuck_patterns: patterns with a reading that a stuck taxel sends again, but that was lost when it sent it first.
        whole: records of scans without a missing taxel.
        mixed: whole records with readings of two cycles; the cycles and the record of each.
        flipped_whole: whole records with a changed digit, evaluated by their other readings alone.
        stuck_whole: whole records with a reading that a stuck taxel sent more than once.
        unstamped: whole records without a time stamp of the adapter, which would show a gap that was read late.
        unstamped_mixed: unstamped records with readings of two cycles; not among `mixed`.
        made_up: readings in records that were never sent, or sent before one that was shown already.
        shown: readings in records.
        unshown: readings handed on that are in no record, by sensor; open ones at the end are not among them.
        open_at_end: readings handed on after the last record.
        missing: taxels that records report as missing.
        spread_ms: time from the first to the last of each pattern's fresh readings on the bus, in [ms].
        held_ms: ages of held readings when a pattern was made of them, in [ms].
        ready_ms: ages of the newest readings when their patterns were ready, in [ms].
        left_out: records left out between others, since their reader was too slow.
        arrivals: times of records with a fresh reading: when the newest one was handed on, and its time of arrival by
            the record, in [ns].
        latencies: for each pattern, when the scan's last frame was handed on, in [ns], and how much later its record
            was read, in [us].
        first_us, last_us: times of the first and the last reading shown of each sensor on the bus, in [us].
        last_counters: counters in the last record.
    """

    records: int = 0
    patterns: int = 0
    whole_patterns: int = 0
    told_patterns: int = 0
    false_patterns: list[str] = field(default_factory=list)
    flipped_patterns: int = 0
    stuck_patterns: int = 0
    whole: int = 0
    mixed: list[str] = field(default_factory=list)
    flipped_whole: int = 0
    stuck_whole: int = 0
    unstamped: int = 0
    unstamped_mixed: int = 0
    made_up: int = 0
    shown: int = 0
    unshown: int = 0
    open_at_end: int = 0
    missing: int = 0
    spread_ms: list[float] = field(default_factory=list)
    held_ms: list[float] = field(default_factory=list)
    ready_ms: list[float] = field(default_factory=list)
    left_out: int = 0
    arrivals: list[tuple[int, int]] = field(default_factory=list)
    latencies: list[tuple[int, float]] = field(default_factory=list)
    first_us: dict[str, int] = field(default_factory=dict)
    last_us: dict[str, int] = field(default_factory=dict)
    last_counters: Mapping[str, int] = field(default_factory=dict)


def judge(seen: Sequence[Seen], told: Told) -> Found:
    """Evaluate the records against the truth."""
    taxels = handed_on(told)
    found = Found()
    numbers: dict[str, int] = {}
    for one in seen:
        found.last_counters = one.head.get("counters", found.last_counters)
        if one.counts is None:
            continue
        found.records += 1
        sensor, number = one.head["sensor"], one.head["scan"]
        left_out = number - numbers.get(sensor, -1) - 1
        numbers[sensor] = number
        if left_out:
            found.left_out += left_out
            for (name, _), rows in taxels.items():
                rows.left_out |= name == sensor
        _follow(one, taxels, found)
    for rows in taxels.values():
        found.open_at_end += len(rows.rows) - rows.next
    found.unshown = sum(len(rows.rows) for rows in taxels.values()) - found.shown - found.open_at_end
    return found


def _follow(one: Seen, taxels: Mapping[tuple[str, int], SentTaxel], found: Found) -> None:
    sensor, fresh, renewed = one.head["sensor"], one.head["fresh"], one.head["renewed"]
    counts = [] if one.counts is None else one.counts.tolist()
    trouble: list[str] = []
    fates: Counter[int] = Counter()
    unheard = 0
    shown: dict[int, SentTaxel] = {}
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
        unheard += fate == STUCK and bool(renewed >> taxel & 1) and str(taxel) not in one.head["dead"]
    bus_us = [rows.rows[rows.shown][1] for rows in shown.values()]
    handed = [rows.rows[rows.shown][2] for rows in shown.values()]
    written = [rows.rows[rows.shown][3] for rows in shown.values()]
    if bus_us:
        found.first_us.setdefault(sensor, min(bus_us))
        found.last_us[sensor] = max(bus_us)
        found.arrivals.append((max(handed), one.head["time_ns"]))
    if fresh == ALL_FRESH:
        _count_cycles(one, shown, found)
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
        trouble += _held(one, taxels, (min(bus_us), max(bus_us)), max(handed), found)
        trouble += _ready(one, max(written), found)
    else:
        trouble.append("no reading is fresh")
    found.flipped_patterns += fates[FLIPPED] > 0
    found.stuck_patterns += unheard > 0
    if trouble:
        found.false_patterns.append(f"sensor {sensor}, scan {one.head['scan']}: {'; '.join(trouble)}")
    elif fresh == renewed == ALL_FRESH and not one.head["dead"]:
        found.whole_patterns += 1
    else:
        found.told_patterns += 1


def _count_cycles(one: Seen, shown: Mapping[int, SentTaxel], found: Found) -> None:
    """Count a whole scan, and whether its readings are of one cycle."""
    unstamped = one.head["device_time_ns"] is None
    found.whole += 1
    found.unstamped += unstamped
    found.flipped_whole += any(rows.flipped for rows in shown.values())
    found.stuck_whole += any(rows.stuck for rows in shown.values())
    by_cycle: dict[int, list[int]] = defaultdict(list)
    for taxel, rows in shown.items():
        if rows.cycle is not None:
            by_cycle[rows.cycle].append(taxel)
    if len(by_cycle) > 1 and unstamped:
        found.unstamped_mixed += 1
    elif len(by_cycle) > 1:
        cycles = "; ".join(f"cycle {cycle}: taxels {taxels}" for cycle, taxels in sorted(by_cycle.items()))
        found.mixed.append(f"sensor {one.head['sensor']}, scan {one.head['scan']}: {cycles}")


def _held(
    one: Seen, taxels: Mapping[tuple[str, int], SentTaxel], bus_us: tuple[int, int], newest_ns: int, found: Found
) -> list[str]:
    """Return what is wrong with readings that a pattern was made from although they did not come with its scan.

    `bus_us` are the times of the scan's first and last reading on the bus, and `newest_ns` is when the last was handed
    on.
    """
    oldest_us, newest_us = bus_us
    trouble: list[str] = []
    for taxel in range(16):
        if one.head["fresh"] >> taxel & 1 or str(taxel) in one.head["dead"]:
            continue
        rows = taxels.get((one.head["sensor"], taxel))
        newest = None if rows is None else rows.newest(oldest_us)
        if newest is None:
            trouble.append(f"taxel {taxel} is held, but was never received")
            continue
        # An emulator that does not get the processor between looking at the clock and writing is late itself.
        _, at_us, _, at_ns = newest
        held_us = min(newest_us - at_us, (newest_ns - at_ns) / 1e3)
        found.held_ms.append(held_us / 1e3)
        if held_us > HELD_US:
            trouble.append(f"taxel {taxel} is held for {held_us / 1e3:.0f} ms")
    return trouble


def _ready(one: Seen, newest_ns: int, found: Found) -> list[str]:
    """Return what is wrong with a pattern that was ready long after its newest reading was handed on."""
    ready_ms = (one.head["time_ns"] + 1e3 * one.head["latency_us"] - newest_ns) / 1e6
    found.ready_ms.append(ready_ms)
    if 1e3 * ready_ms <= READY_US or _SAYS_ITS_AGE.search(one.head["note"] or ""):
        return []
    return [f"it was ready {ready_ms:.0f} ms after its newest reading, and no note states that"]
