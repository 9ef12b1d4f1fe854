"""Targets of the whole program, and for each one that is missed a measured reason."""

import math
from collections.abc import Iterator, Mapping
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
    idle, plain, recorded = (rows.get(name) for name in (IDLE, PLAIN, TWO_RECORDED))
    if idle is not None and plain is not None:
        threads = " + ".join(f"{share:.1f}" for share in idle.thread_percent)
        why = f"the plain loop alone takes {plain.cpu_percent:.1f} %; ours, by threads: {threads} %"
        loops = idle.cpu_percent / plain.cpu_percent
        measured = f"{loops:.1f} plain loops, {idle.cpu_percent:.2f} % of a core"
        yield _verdict(f"at rest at most {IDLE_LOOPS} plain loops", measured, loops <= IDLE_LOOPS, why)
    if recorded is not None and recorded.run_time is not None:
        p99_us, p50_us = recorded.run_time.p99_us, recorded.run_time.p50_us
        target = f"two sensors, p99 of inference under {RUN_TIME_P99_US:.0f} us"
        yield _verdict(
            target, f"{p99_us:.0f} us", p99_us < RUN_TIME_P99_US, f"p50 is {p50_us:.0f} us; {_about(recorded)}"
        )
    if recorded is not None and recorded.losses is not None:
        late, dropped = recorded.losses.late, recorded.losses.dropped
        measured = f"{late} late, {dropped} dropped of {recorded.scans}"
        yield _verdict("two sensors, no deadline missed", measured, late + dropped == 0, _about(recorded))
    if recorded is not None:
        share = "" if recorded.run_time is None else f"{recorded.run_time.p50_us / 100:.1f} %"
        why = f"inference alone takes {share or 'an unknown part'} at 100 Hz"
        target = f"two sensors, every scan new, recorded: at most {TWO_SENSORS_PERCENT:g} % of a core"
        held = recorded.cpu_percent <= TWO_SENSORS_PERCENT
        yield _verdict(target, f"{recorded.cpu_percent:.1f} %", held, why)
    moving = rows.get(MOVING)
    if moving is not None and moving.latency is not None:
        p99_us = moving.latency.p99_us
        run_time = "" if moving.run_time is None else f"inference {moving.run_time.p99_us:.0f} us of it (p99); "
        target = f"last byte to record, p99 under {LATENCY_P99_US / 1000:g} ms"
        measured = f"{p99_us / 1000:.2f} ms"
        yield _verdict(target, measured, p99_us < LATENCY_P99_US, f"{run_time}{_about(moving)}")
    fast = rows.get(FAST)
    if fast is not None and fast.losses is not None:
        lost = fast.losses.dropped + fast.losses.overruns + fast.losses.torn
        measured = f"{lost} lost of {fast.scans}, {fast.rate_hz:.0f} a second"
        held = lost == 0 and fast.rate_hz >= RATE_SHARE * FAST_HZ
        yield _verdict(f"{FAST_HZ:.0f} scans/s of one sensor, none lost", measured, held, _about(fast))
    if start_up is not None:
        longest_s, middle_s = (
            max(start_up.first_pattern_s),
            sorted(start_up.first_pattern_s)[len(start_up.first_pattern_s) // 2],
        )
        target = f"start to first pattern at most {FIRST_PATTERN_S} s"
        yield _verdict(target, f"{middle_s:.2f} s", middle_s <= FIRST_PATTERN_S, f"longest of all {longest_s:.2f} s")
    yield from _verdicts_on_hand(rows)
    few = [name for name in rows if not name.startswith("plain") and not name[0].isdigit()]
    ours = [rows[name].resident_mb for name in few]
    if ours:
        most_mb = max(ours)
        yield _verdict(f"at most {RESIDENT_MB:.0f} MB resident", f"{most_mb:.0f} MB", most_mb <= RESIDENT_MB, "")


def _verdicts_on_hand(rows: Mapping[str, SystemRow]) -> Iterator[Verdict]:
    """Yield a verdict on every target of a hand that has a figure."""
    plain, rest, contact, recorded = (rows.get(name) for name in _HAND)
    if rest is not None and plain is not None:
        loops = rest.cpu_percent / plain.cpu_percent
        measured = f"{rest.cpu_percent:.1f} %, {loops:.1f} plain loops"
        target = f"{HAND} sensors at rest: at most {HAND_REST_PERCENT:g} % of a core"
        yield _verdict(target, measured, rest.cpu_percent <= HAND_REST_PERCENT, _about(rest))
    if recorded is not None and recorded.losses is not None:
        target = f"{HAND} sensors, a third in contact, recorded:"
        losses = recorded.losses
        lost = losses.dropped + losses.overruns + losses.torn
        measured = f"{losses.dropped} dropped, {losses.overruns} overrun, {losses.torn} torn of {recorded.scans}"
        yield _verdict(f"{target} none dropped", measured, lost == 0, _about(recorded))
        held = recorded.cpu_percent <= HAND_PERCENT
        measured = f"{recorded.cpu_percent:.0f} %"
        yield _verdict(f"{target} at most {HAND_PERCENT:g} % of a core", measured, held, _about(recorded))
        p99_us = math.inf if recorded.latency is None else recorded.latency.p99_us
        measured = "scans were lost" if recorded.latency is None else f"{p99_us / 1000:.1f} ms"
        target = f"{target} last byte to record, p99 under {HAND_LATENCY_P99_US / 1000:g} ms"
        yield _verdict(target, measured, p99_us < HAND_LATENCY_P99_US, _about(recorded))
    ours = [row.resident_mb for row in (rest, contact, recorded) if row is not None]
    if ours:
        target = f"{HAND} sensors: at most {HAND_RESIDENT_MB:.0f} MB resident"
        yield _verdict(target, f"{max(ours):.0f} MB", max(ours) <= HAND_RESIDENT_MB, "")


def _verdict(target: str, measured: str, held: bool, why: str) -> Verdict:
    return Verdict(target, measured, held, "" if held else why)


def _about(row: SystemRow) -> str:
    return (
        f"everything else took {row.others_percent:.0f} % of a core, the host {row.stolen_percent:.0f} %, and it was "
        f"preempted {row.preempted} times"
    )
