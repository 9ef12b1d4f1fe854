"""Section of the bench on the whole program."""

from itertools import chain
from typing import Final

from edge.bench.live_report import Page, head, line
from edge.bench.system import HAND, HAND_ROWS, ROWS, SystemRow, hand_rows, rows, start_up
from edge.bench.targets import Verdict, verdicts
from edge.bench.timing import Times

COLUMNS: Final = (
    *("played", "scans", "CPU %", "by threads", "MB"),
    *("inference p50 us", "p99", "p99.9", "max"),
    *("last byte to record p50 us", "p99", "p99.9", "max"),
    *("late", "dropped", "overrun", "torn", "preempted", "others %", "host took %"),
)
_TEXT: Final = (
    "edge-sr in a process of its own reads emulated sensors, a process too, over a pseudo-terminal; STSR, on one "
    "thread. CPU is of all its threads, by the scheduler, in % of one core. Times are from the moment the last byte of "
    "a scan is handed on to the moment the bench has read its record, some 25 kB of JSON, from a pipe; rows without "
    "them have the status line alone. The plain loop reads the same bytes by poll and os.read, decodes nothing, and "
    "runs at the same time as the row at rest. Many sensors send on buses of four, which are full to five sixths; with "
    "two cores, the program may use no other. Others: what all else on this machine took, emulator and bench included."
)


def show_system(scans: int, sensors: int | None, page: Page) -> list[SystemRow]:
    """Measure the whole program and show it row by row.

    Args:
        scans: of each sensor, a row.
        sensors: number of sensors, of which alone rows are measured; None for one, two and a hand.
        page: shows it.

    Raises:
        BenchError: a process ended.
    """
    found: list[SystemRow] = []
    page.section("The whole program", _TEXT, head(COLUMNS))
    hand = hand_rows(HAND if sensors is None else sensors, scans, page.progress)
    measured, count = (
        (chain(rows(scans, page.progress), hand), ROWS + HAND_ROWS) if sensors is None else (hand, HAND_ROWS)
    )
    for row in page.tracked(measured, "the program", total=count):
        found.append(row)
        page.say(row_line(row))
    started = None
    if sensors is None:
        page.progress("start-up")
        started = start_up()
        starts = ", ".join(f"{took_s:.2f}" for took_s in started.first_pattern_s)
        page.say(f"\nStart to the record of the first pattern: {starts} s; {started.resident_mb:.0f} MB by then.")
    held = list(verdicts({row.name: row for row in found}, started))
    if held:
        page.section("Targets", "Measured in this run.", head(("target", "measured", "held", "limited by")))
    for verdict in held:
        page.say(verdict_line(verdict))
    return found


def row_line(row: SystemRow) -> str:
    """Return a run as a row of the table."""
    losses = ("-",) * 4
    if row.losses is not None:
        losses = tuple(
            str(count) for count in (row.losses.late, row.losses.dropped, row.losses.overruns, row.losses.torn)
        )
    return line(
        (
            row.name,
            str(row.scans),
            f"{row.cpu_percent:.2f}",
            " + ".join(f"{share:.2f}" for share in row.thread_percent),
            f"{row.resident_mb:.0f}",
            *_times(row.run_time),
            *_times(row.latency),
            *losses,
            str(row.preempted),
            f"{row.others_percent:.0f}",
            f"{row.stolen_percent:.1f}",
        )
    )


def verdict_line(verdict: Verdict) -> str:
    """Return a target as a row of the table."""
    return line((verdict.target, verdict.measured, "yes" if verdict.held else "no", verdict.limited_by))


def _times(times: Times | None) -> tuple[str, ...]:
    if times is None:
        return ("-",) * 4
    return tuple(f"{value:.0f}" for value in (times.p50_us, times.p99_us, times.p999_us, times.max_us))
