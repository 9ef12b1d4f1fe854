"""Targets of the whole program, and for each one that is missed a measured reason."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from edge.bench.system import FAST, IDLE, MOVING, PLAIN, TWO, TWO_RECORDED, StartUp, SystemRow

IDLE_PERCENT: Final = 1.5
TWO_SENSORS_PERCENT: Final = 8.0
RUN_TIME_P99_US: Final = 1000.0
LATENCY_P99_US: Final = 3000.0
FIRST_PATTERN_S: Final = 0.7
RESIDENT_MB: Final = 100.0


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
    idle, plain, two, recorded = (rows.get(name) for name in (IDLE, PLAIN, TWO, TWO_RECORDED))
    if idle is not None and plain is not None:
        threads = " + ".join(f"{share:.1f}" for share in idle.thread_percent)
        why = f"the plain loop alone takes {plain.cpu_percent:.1f} %; ours, by threads: {threads} %"
        ratio = f"{idle.cpu_percent:.2f} %, {idle.cpu_percent / plain.cpu_percent:.1f} times the plain loop"
        yield _verdict(f"at rest under {IDLE_PERCENT} % of a core", ratio, idle.cpu_percent < IDLE_PERCENT, why)
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
    if two is not None:
        share = "" if recorded is None or recorded.run_time is None else f"{recorded.run_time.p50_us / 100:.1f} %"
        why = f"inference alone takes {share or 'an unknown part'} at 100 Hz"
        target = f"two sensors under {TWO_SENSORS_PERCENT:g} % of a core"
        yield _verdict(target, f"{two.cpu_percent:.1f} %", two.cpu_percent < TWO_SENSORS_PERCENT, why)
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
        yield _verdict("1000 scans/s without a drop", f"{lost} lost of {fast.scans}", lost == 0, _about(fast))
    if start_up is not None:
        longest_s, middle_s = (
            max(start_up.first_pattern_s),
            sorted(start_up.first_pattern_s)[len(start_up.first_pattern_s) // 2],
        )
        target = f"start to first pattern under {FIRST_PATTERN_S} s"
        yield _verdict(target, f"{middle_s:.2f} s", middle_s < FIRST_PATTERN_S, f"longest of all {longest_s:.2f} s")
    ours = [row.resident_mb for name, row in rows.items() if not name.startswith("plain")]
    if ours:
        most_mb = max(ours)
        yield _verdict(f"under {RESIDENT_MB:.0f} MB resident", f"{most_mb:.0f} MB", most_mb < RESIDENT_MB, "")


def _verdict(target: str, measured: str, held: bool, why: str) -> Verdict:
    return Verdict(target, measured, held, "" if held else why)


def _about(row: SystemRow) -> str:
    return (
        f"everything else took {row.others_percent:.0f} % of a core, the host {row.stolen_percent:.0f} %, and it was "
        f"preempted {row.preempted} times"
    )
