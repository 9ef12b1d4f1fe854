"""Targets of the whole program, and for each one that is missed a measured reason."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from edge.bench.system import FAST, FAST_HZ, HAND, IDLE, MOVING, PLAIN, TWO_RECORDED, StartUp, SystemRow, hand_names

IDLE_LOOPS: Final = 2.5
TWO_SENSORS_PERCENT: Final = 12.0
RUN_TIME_P99_US: Final = 800.0
LATENCY_P99_US: Final = 2000.0
RATE_SHARE: Final = 0.99
"""Share of the played scans that must be read: the adapter waits for a reader that is too slow."""
FIRST_PATTERN_S: Final = 0.3
RESIDENT_MB: Final = 80.0
HAND_REST_PERCENT: Final = 25.0
HAND_PERCENT: Final = 120.0
HAND_LATENCY_P99_US: Final = 8000.0
HAND_RESIDENT_MB: Final = 120.0


_HAND: Final = hand_names(HAND)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on a target: the measurement, whether it is within, and if not a measured reason."""

    target: str
    measured: str
    held: bool
    limited_by: str


def verdicts(rows: Mapping[str, SystemRow], start_up: StartUp | None) -> Iterator[Verdict]:
    """Yield a verdict on every target that has a figure.

    Args:
        rows: as far as they were measured, by name.
        start_up: if it was measured.
    """
    if (idle := rows.get(IDLE)) is not None and (plain := rows.get(PLAIN)) is not None:
        threads = " + ".join(f"{share:.1f}" for share in idle.thread_percent)
        why = f"the plain loop alone takes {plain.cpu_percent:.1f} %; ours, by threads: {threads} %"
        loops = idle.cpu_percent / plain.cpu_percent
        measured = f"{loops:.1f} plain loops, {idle.cpu_percent:.2f} % of a core"
        yield _verdict(f"at rest at most {IDLE_LOOPS} plain loops", measured, loops <= IDLE_LOOPS, why)
    if (two := rows.get(TWO_RECORDED)) is not None and two.run_time is not None and two.losses is not None:
        p99_us, p50_us = two.run_time.p99_us, two.run_time.p50_us
        target, why = f"two sensors, p99 of inference under {RUN_TIME_P99_US:.0f} us", f"p50 is {p50_us:.0f} us"
        yield _verdict(target, f"{p99_us:.0f} us", p99_us < RUN_TIME_P99_US, f"{why}; {_about(two)}")
        late, dropped = two.losses.late, two.losses.dropped
        measured = f"{late} late, {dropped} dropped of {two.scans}"
        yield _verdict("two sensors, no deadline missed", measured, late + dropped == 0, _about(two))
        target = f"two sensors, every scan new, recorded: at most {TWO_SENSORS_PERCENT:g} % of a core"
        held, why = two.cpu_percent <= TWO_SENSORS_PERCENT, f"inference alone takes {p50_us / 100:.1f} % at 100 Hz"
        yield _verdict(target, f"{two.cpu_percent:.1f} %", held, why)
    if (moving := rows.get(MOVING)) is not None and moving.latency is not None:
        p99_us = moving.latency.p99_us
        run_time = "" if moving.run_time is None else f"inference {moving.run_time.p99_us:.0f} us of it (p99); "
        target = f"last byte to record, p99 under {LATENCY_P99_US / 1000:g} ms"
        yield _verdict(target, f"{p99_us / 1000:.2f} ms", p99_us < LATENCY_P99_US, f"{run_time}{_about(moving)}")
    if (fast := rows.get(FAST)) is not None and fast.losses is not None:
        lost = fast.losses.dropped + fast.losses.overruns + fast.losses.torn
        measured = f"{lost} lost of {fast.scans}, {fast.rate_hz:.0f} a second"
        held = lost == 0 and fast.rate_hz >= RATE_SHARE * FAST_HZ
        yield _verdict(f"{FAST_HZ:.0f} scans/s of one sensor, none lost", measured, held, _about(fast))
    if start_up is not None:
        took_s = sorted(start_up.first_pattern_s)
        middle_s, target = took_s[len(took_s) // 2], f"start to first pattern at most {FIRST_PATTERN_S} s"
        yield _verdict(target, f"{middle_s:.2f} s", middle_s <= FIRST_PATTERN_S, f"longest of all {took_s[-1]:.2f} s")
    yield from _verdicts_on_hand(rows)
    few = [row for name, row in rows.items() if not name.startswith("plain") and not name[0].isdigit()]
    yield from _memory("", RESIDENT_MB, few)


def _verdicts_on_hand(rows: Mapping[str, SystemRow]) -> Iterator[Verdict]:
    """Yield a verdict on every target of a hand that has a figure."""
    plain, rest, contact, recorded = (rows.get(name) for name in _HAND)
    if rest is not None and plain is not None:
        measured = f"{rest.cpu_percent:.1f} %, {rest.cpu_percent / plain.cpu_percent:.1f} plain loops"
        target = f"{HAND} sensors at rest: at most {HAND_REST_PERCENT:g} % of a core"
        yield _verdict(target, measured, rest.cpu_percent <= HAND_REST_PERCENT, _about(rest))
    if recorded is not None and recorded.losses is not None:
        target, losses, why = f"{HAND} sensors, a third in contact, recorded:", recorded.losses, _about(recorded)
        lost = losses.dropped + losses.overruns + losses.torn
        measured = f"{losses.dropped} dropped, {losses.overruns} overrun, {losses.torn} torn of {recorded.scans}"
        yield _verdict(f"{target} none dropped", measured, lost == 0, why)
        held = recorded.cpu_percent <= HAND_PERCENT
        yield _verdict(f"{target} at most {HAND_PERCENT:g} % of a core", f"{recorded.cpu_percent:.0f} %", held, why)
        p99_us = math.inf if recorded.latency is None else recorded.latency.p99_us
        measured = "scans were lost" if recorded.latency is None else f"{p99_us / 1000:.1f} ms"
        target = f"{target} last byte to record, p99 under {HAND_LATENCY_P99_US / 1000:g} ms"
        yield _verdict(target, measured, p99_us < HAND_LATENCY_P99_US, why)
    yield from _memory(f"{HAND} sensors: ", HAND_RESIDENT_MB, [row for row in (rest, contact, recorded) if row])


def _memory(whose: str, most_mb: float, rows: Sequence[SystemRow]) -> Iterator[Verdict]:
    if rows:
        found_mb = max(row.resident_mb for row in rows)
        yield _verdict(f"{whose}at most {most_mb:.0f} MB resident", f"{found_mb:.0f} MB", found_mb <= most_mb, "")


def _verdict(target: str, measured: str, held: bool, why: str) -> Verdict:
    return Verdict(target, measured, held, "" if held else why)


def _about(row: SystemRow) -> str:
    return (
        f"everything else took {row.others_percent:.0f} % of a core, the host {row.stolen_percent:.0f} %, and it was "
        f"preempted {row.preempted} times"
    )
