"""Measurement of the whole program, row by row: processor time, latency, losses, start-up and memory."""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np

from edge.bench.processes import STARTS, usable_cores
from edge.bench.program import Line, Play, Program, edge_sr, parsed, plain_loop
from edge.bench.timing import Times, summary

SETTLE_S: Final = 2.0
ALL: Final = 500
PLAIN, IDLE, IDLE_RECORDED = "plain loop", "at rest", "at rest, recorded"
FAST_HZ: Final = 5000.0
FAST: Final = f"at rest, {FAST_HZ:g} Hz"
HELD, MOVING, FEW = "held still", "every scan new", "every scan new, pattern alone"
TWO, TWO_RECORDED = "two sensors, every scan new", "two sensors, every scan new, recorded"
HAND: Final = 16
"""Sensors of a hand."""


@dataclass(frozen=True, slots=True)
class Losses:
    """Numbers of scans, or taxels, that were late or lost in a row.

    Attributes:
        late: patterns later than one period after their scan.
        dropped: overtaken by a newer scan before the inference.
        overruns: scans thrown away unseen.
        torn: taxels missing on the wire.
    """

    late: int
    dropped: int
    overruns: int
    torn: int


@dataclass(frozen=True, slots=True)
class Used:
    """Usage of the machine by a program during a row.

    Attributes:
        seconds: length of the row, in [s].
        cpu_percent: processor time of all its threads, in [% of one core].
        thread_percent: the same of each thread that takes any, the most first.
        resident_mb: memory at the end, in [MB].
        preempted: number of times a thread lost its processor against its will.
        others_percent: processor time of everything else on the machine, in [% of one core].
        stolen_percent: processor time that the host took away from all cores, in [% of one core].
    """

    seconds: float
    cpu_percent: float
    thread_percent: tuple[float, ...]
    resident_mb: float
    preempted: int
    others_percent: float
    stolen_percent: float


@dataclass(frozen=True, slots=True)
class SystemRow(Used):
    """Measurement of one run of the whole program.

    Attributes:
        name: of the row.
        scans: number of scans in the run.
        run_time: of the inference; None where there was none.
        latency: from the last byte of a scan to its record read by the bench; None where no records are read, or scans
            were lost, so that records cannot be matched.
        losses: None where no records are read.
    """

    name: str
    scans: int
    run_time: Times | None = None
    latency: Times | None = None
    losses: Losses | None = None

    @property
    def rate_hz(self) -> float:
        """Scans a second, of all sensors together, in [Hz]."""
        return self.scans / self.seconds


@dataclass(frozen=True, slots=True)
class StartUp:
    """Starts of the program: each from its spawn to the record of its first pattern, in [s], and the memory then."""

    first_pattern_s: tuple[float, ...]
    resident_mb: float


ROWS: Final = 9
"""Number of rows that `rows` yields."""
HAND_ROWS: Final = 4
"""Number of rows that `hand_rows` yields."""


def hand_names(sensors: int) -> tuple[str, str, str, str]:
    """Return the names of the rows of many sensors: the plain loop, at rest, a third in contact, and recorded."""
    contact = f"{sensors} sensors, a third in contact, two cores"
    return f"plain loop of {sensors} sensors", f"{sensors} sensors at rest", contact, f"{contact}, recorded"


def rows(scans: int, tell: Callable[[str], None]) -> Iterator[SystemRow]:
    """Yield every row, of so many scans at 100 Hz and as much time at 5000; `tell` gets the name of each row first.

    Raises:
        BenchError: a process ended.
    """
    seconds = scans / 100
    moving, two = Play(pressed=ALL, moving=True), Play(sensors=2, pressed=ALL, moving=True)
    with tempfile.TemporaryDirectory() as folder_name:
        folder = Path(folder_name)
        yield from _at_rest(folder, (PLAIN, IDLE), Play(), scans, tell)
        tell(TWO)
        yield _unrecorded(folder, TWO, two, scans)
        for name, play, options in (
            (IDLE_RECORDED, Play(), ()),
            (HELD, Play(pressed=ALL), ()),
            (MOVING, moving, ("--every-scan",)),
            (FEW, moving, ("--every-scan", "--fields", "run_time_us,pattern")),
            (TWO_RECORDED, two, ("--every-scan",)),
            (FAST, Play(rate_hz=FAST_HZ, waits=True), ()),
        ):
            tell(name)
            yield _measured(folder, name, play, seconds, *options)


def hand_rows(sensors: int, scans: int, tell: Callable[[str], None]) -> Iterator[SystemRow]:
    """Yield the rows of many sensors, of so many scans of each; `tell` gets the name of each row first.

    Raises:
        BenchError: a process ended.
    """
    plain, rest, contact, recorded = hand_names(sensors)
    third = Play(sensors=sensors, pressed=ALL, moving=True, touched=-(-sensors // 3))
    cores = usable_cores()[-2:]
    with tempfile.TemporaryDirectory() as folder_name:
        folder = Path(folder_name)
        yield from _at_rest(folder, (plain, rest), Play(sensors=sensors), scans, tell)
        tell(contact)
        yield _unrecorded(folder, contact, third, scans, cores)
        tell(recorded)
        yield _measured(folder, recorded, third, scans / third.rate_hz, "--every-scan", cores=cores)


def _at_rest(
    folder: Path, names: tuple[str, str], play: Play, scans: int, tell: Callable[[str], None]
) -> Iterator[SystemRow]:
    """Yield the rows of a plain loop and of the program, with the status line alone."""
    tell(" and ".join(names))
    apart = [folder / "plain", folder / "idle"]
    for one in apart:
        one.mkdir()
    # At the same time, since what else runs on the machine moves both, and their ratio is the target.
    with plain_loop(apart[0], play) as plain, edge_sr(apart[1], play, sink="status") as idle:
        time.sleep(SETTLE_S)
        usages = [_Usage(plain), _Usage(idle)]
        time.sleep(scans / play.rate_hz)
        used = [usage.since() for usage in usages]
    for name, one in zip(names, used, strict=True):
        yield SystemRow(**asdict(one), name=name, scans=scans * play.sensors)


def _unrecorded(folder: Path, name: str, play: Play, scans: int, cores: Sequence[int] = ()) -> SystemRow:
    with edge_sr(folder, play, "--every-scan", sink="status", cores=cores) as program:
        time.sleep(SETTLE_S)
        usage = _Usage(program)
        time.sleep(scans / play.rate_hz)
        return SystemRow(**asdict(usage.since()), name=name, scans=scans * play.sensors)


def _measured(
    folder: Path, name: str, play: Play, seconds: float, *options: str, cores: Sequence[int] = ()
) -> SystemRow:
    with edge_sr(folder, play, *options, cores=cores) as program:
        program.lines(60.0, most=1)
        program.skip(SETTLE_S)
        usage, heads = _Usage(program), program.heads(seconds)
        since = usage.since()
    return _recorded(name, parsed(heads), since, program.stamps_ns())


def start_up() -> StartUp:
    """Return several starts, one after the other, and the median of their memory."""
    took_s: list[float] = []
    resident_mb: list[float] = []
    with tempfile.TemporaryDirectory() as folder_name:
        for _ in range(STARTS):
            with edge_sr(Path(folder_name), Play(pressed=ALL)) as program:
                took_s.append(program.first_pattern_s())
                resident_mb.append(program.resident_mb())
    return StartUp(tuple(took_s), float(np.median(resident_mb)))


class _Usage:
    """Usage of a process from now on."""

    def __init__(self, program: Program) -> None:
        self._program = program
        self._threads, self._preempted, self._machine = program.thread_cpu_s(), program.preemptions(), _machine_s()
        self._start_s = time.monotonic()

    def since(self) -> Used:
        """Return the usage until now."""
        took_s = time.monotonic() - self._start_s
        now = self._program.thread_cpu_s()
        percent = sorted((100 * (cpu_s - self._threads.get(task, 0.0)) / took_s for task, cpu_s in now.items()))[::-1]
        busy, stolen = (
            100 * (after - before) / took_s for after, before in zip(_machine_s(), self._machine, strict=True)
        )
        return Used(
            took_s,
            sum(percent),
            tuple(share for share in percent if share >= 0.01),
            self._program.resident_mb(),
            self._program.preemptions() - self._preempted,
            max(busy - sum(percent), 0.0),
            stolen,
        )


def _machine_s() -> tuple[float, float]:
    """Return the time that all cores were busy for this machine, and that the host took away, in [s]."""
    ticks = [int(text) for text in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]]
    user, nice, system, _, _, interrupts, soft_interrupts, stolen = (tick / 100 for tick in ticks[:8])
    return user + nice + system + interrupts + soft_interrupts, stolen


def _recorded(name: str, lines: list[Line], used: Used, stamps_ns: dict[str, list[int]]) -> SystemRow:
    first, last = lines[0].record["counters"], lines[-1].record["counters"]
    lost = {key: last[key] - first[key] for key in ("late", "dropped", "overruns", "torn_wire")}
    run_times_us = [line.record["run_time_us"] for line in lines if line.record["run_time_us"] is not None]
    distinguishable = not (last["overruns"] or last["missing_taxels"] or last["duplicates"])
    return SystemRow(
        **asdict(used),
        name=name,
        scans=len(lines),
        run_time=summary([round(1e3 * run_time_us) for run_time_us in run_times_us]) if run_times_us else None,
        latency=summary(latencies_ns(lines, stamps_ns)) if distinguishable else None,
        losses=Losses(lost["late"], lost["dropped"], lost["overruns"], lost["torn_wire"]),
    )


def latencies_ns(lines: list[Line], stamps_ns: dict[str, list[int]]) -> list[int]:
    """Return the time from each scan's last byte to its record, in [ns]; matched by number, so no scan may be lost."""
    return [line.time_ns - stamps_ns[line.record["sensor"]][line.record["scan"]] for line in lines]
