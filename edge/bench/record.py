"""Record of a bench: one JSON file, which a later bench can be compared with."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from edge.bench.accuracy import ErrorRow
from edge.bench.errors import BenchError
from edge.bench.gate_savings import Saving
from edge.bench.machine import Machine
from edge.bench.ratios import Ratio
from edge.bench.soak import Soak
from edge.bench.system import StartUp, SystemRow
from edge.bench.targets import Verdict
from edge.bench.timing import Pace, Times
from firmware_bridge.bounded_read import read_bounded

FORMAT: Final = "tactile bench"
VERSION: Final = 1
MOST_FILE_BYTES: Final = 1 << 26
"""Largest size of a record's file, in bytes: a hundred times a bench of all models."""


@dataclass(frozen=True, slots=True)
class Facts:
    """Facts on a subject that do not depend on the machine.

    Attributes:
        name: of the subject.
        kind: "classical", "model" or "peer".
        macs: multiply-accumulates of one window.
        uncounted: operators whose multiply-accumulates are not counted.
        weights: a peer's own note that its weights are untrained, or None.
    """

    name: str
    kind: str
    macs: int
    uncounted: tuple[str, ...] = ()
    weights: str | None = None


@dataclass(frozen=True, slots=True)
class RunTimeRow:
    """Run time of a subject on some threads.

    Attributes:
        name: of the subject.
        threads: of one run.
        load: True where the other core was kept busy.
        back_to_back: without a pause.
        paced: at the rate.
        gmac_s: back to back, in [10^9 multiply-accumulates per second].
        peak_percent: of the machine's peak on as many threads, in [%].
        start_up_ms: from the process's spawn to its first pattern, in [ms].
        resident_mb: most memory resident until then, in [MB]; None where the system does not show it.
    """

    name: str
    threads: int
    load: bool
    back_to_back: Times
    paced: Pace
    gmac_s: float
    peak_percent: float
    start_up_ms: float
    resident_mb: float | None


@dataclass(frozen=True, slots=True)
class FrontRow:
    """Error of a subject against its run time, and its place on the Pareto front of the two."""

    name: str
    given: int
    rmse_percent: float
    psnr_db: float
    paced_p50_us: float
    back_to_back_p50_us: float
    on_front: bool


@dataclass(slots=True)
class SystemRecord:
    """Measurements of the whole program so far: its rows, its starts, the verdicts on its targets, and a soak."""

    rows: list[SystemRow] = field(default_factory=list[SystemRow])
    start_up: StartUp | None = None
    verdicts: list[Verdict] = field(default_factory=list[Verdict])
    soak: Soak | None = None


@dataclass(slots=True)
class Record:
    """Record of a bench, complete or up to where it stopped.

    Attributes:
        date: of its begin, ISO 8601 in UTC.
        command: command line of the bench.
        machine: machine that it ran on.
        settings: rate, ticks, threads, load, seeds.
        complete: True if it came to its end.
        peak_gmac_s: threads to the machine's peak.
        force_floor_percent: force error of true patterns.
        facts: of each subject.
        errors: on the frozen test set.
        run_times: of each subject, on each number of threads, alone and under load.
        against: peer to subject to the ratio of the subject's run time to the peer's.
        savings: inference that a scene makes unnecessary.
        system: the whole program, if that was asked for.
    """

    date: str
    command: str
    machine: Machine
    settings: dict[str, Any]
    complete: bool = False
    peak_gmac_s: dict[int, float] = field(default_factory=dict[int, float])
    force_floor_percent: float | None = None
    facts: list[Facts] = field(default_factory=list[Facts])
    errors: list[ErrorRow] = field(default_factory=list[ErrorRow])
    run_times: list[RunTimeRow] = field(default_factory=list[RunTimeRow])
    against: dict[str, dict[str, Ratio]] = field(default_factory=dict[str, dict[str, Ratio]])
    savings: list[Saving] = field(default_factory=list[Saving])
    system: SystemRecord | None = None

    def fact(self, name: str) -> Facts:
        """Return the facts of the subject of this name."""
        return next(fact for fact in self.facts if fact.name == name)

    def front_rows(self) -> list[FrontRow]:
        """Return every error with a run time on the fewest threads, alone; the fastest at the rate first."""
        if not self.run_times:
            return []
        fewest = min(row.threads for row in self.run_times)
        times = {row.name: row for row in self.run_times if row.threads == fewest and not row.load}
        timed = [row for row in self.errors if row.name in times]
        points = [(row.error["rmse_percent"], times[row.name].paced.times.p50_us) for row in timed]
        rows = [
            FrontRow(
                name=row.name,
                given=row.given,
                rmse_percent=row.error["rmse_percent"],
                psnr_db=row.error["psnr_db"],
                paced_p50_us=times[row.name].paced.times.p50_us,
                back_to_back_p50_us=times[row.name].back_to_back.p50_us,
                on_front=on_front,
            )
            for row, on_front in zip(timed, front(points), strict=True)
        ]
        return sorted(rows, key=lambda row: row.paced_p50_us)

    def to_json(self) -> str:
        """Return the record as JSON, with the front in it."""
        content = {"format": FORMAT, "version": VERSION} | asdict(self)
        content["front"] = [asdict(row) for row in self.front_rows()]
        return json.dumps(content, indent=1) + "\n"

    def to_csv(self) -> str:
        """Return a flat line for each error and run time, each row of the whole program and each saving.

        A cell is empty where there is no figure.
        """
        lines: list[dict[str, Any]] = []
        columns: dict[str, None] = {}
        on_front = {(row.name, row.given) for row in self.front_rows() if row.on_front}
        for fact in self.facts:
            errors = [row for row in self.errors if row.name == fact.name] or [None]
            times = [row for row in self.run_times if row.name == fact.name] or [None]
            for error in errors:
                about = {"method": fact.name, "kind": fact.kind, "weights": fact.weights, "macs": fact.macs}
                if error is not None:
                    about |= {"taps_given": error.given, **error.error}
                    about["on_front"] = (fact.name, error.given) in on_front
                columns |= dict.fromkeys(about)
                lines += [about | ({} if row is None else _time_cells(row)) for row in times]
        lines += [{"method": row.model, "kind": "scene"} | asdict(row) for row in self.savings]
        lines += (
            [{"method": row.name, "kind": "system"} | _system_cells(row) for row in self.system.rows]
            if self.system
            else []
        )
        columns |= dict.fromkeys(column for line in lines for column in line)
        text = io.StringIO()
        writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)
        return text.getvalue()


def _time_cells(row: RunTimeRow) -> dict[str, Any]:
    cells: dict[str, Any] = {"threads": row.threads, "load": row.load}
    for name, times in (("back_to_back", row.back_to_back), ("paced", row.paced.times)):
        for figure in ("runs", "p50_us", "p99_us", "p999_us", "max_us"):
            cells[f"{name}_{figure}"] = getattr(times, figure)
    cells |= {"ticks": row.paced.ticks, "missed": row.paced.missed, "cpu_percent": row.paced.cpu_percent}
    for figure in ("gmac_s", "peak_percent", "start_up_ms", "resident_mb"):
        cells[figure] = getattr(row, figure)
    return cells


def _system_cells(row: SystemRow) -> dict[str, Any]:
    cells: dict[str, Any] = {"scans": row.scans, "cpu_percent": row.cpu_percent, "resident_mb": row.resident_mb}
    for name, times in (("run_time", row.run_time), ("latency", row.latency)):
        if times is not None:
            cells |= {
                f"{name}_{figure}": getattr(times, figure) for figure in ("p50_us", "p99_us", "p999_us", "max_us")
            }
    return cells | ({} if row.losses is None else asdict(row.losses))


def read_record(path: Path) -> dict[str, Any]:
    """Read an earlier bench's JSON.

    Raises:
        BenchError: no such file, no bench, or one of another version.
    """
    try:
        content = json.loads(read_bounded(path, MOST_FILE_BYTES))
    except (OSError, ValueError, RecursionError) as error:
        raise BenchError(
            f"{path} cannot be read ({error}): expected the bench.json of 'edge-sr bench --out'"
        ) from error
    kind: Sequence[object] = (
        (content.get("format"), content.get("version")) if isinstance(content, dict) else (None, None)
    )
    if kind[0] != FORMAT:
        raise BenchError(f"{path} is not a bench: expected the bench.json of 'edge-sr bench --out'")
    if kind[1] != VERSION:
        raise BenchError(
            f"{path} is of version {repr(kind[1])[:40]}, expected {VERSION}: run that bench again with this release"
        )
    return content


def front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Return, for each point, True if no other point is at least as small in both numbers and smaller in one."""
    return [not any(_beats(other, point) for other in points) for point in points]


def _beats(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return one != other and one[0] <= other[0] and one[1] <= other[1]
