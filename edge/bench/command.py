"""Command `edge-sr bench`: its sections, one after the other, and its files."""

import contextlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, TextIO

from edge.bench import contenders as subjects
from edge.bench import peak
from edge.bench import peer_ratios as against
from edge.bench import ratios as intervals
from edge.bench import report as tables
from edge.bench.accuracy import error_rows, force_floor_percent
from edge.bench.compare import compared
from edge.bench.contenders import Subject
from edge.bench.errors import BenchError
from edge.bench.gate_section import show_savings
from edge.bench.live_report import Page
from edge.bench.machine import this_machine
from edge.bench.macs import macs_of
from edge.bench.plot import draw
from edge.bench.processes import busy_core, measured, start_up
from edge.bench.program import PROGRAM_SOURCES
from edge.bench.provenance import provenance, with_head
from edge.bench.record import Facts, Record, RunTimeRow, read_record
from edge.bench.system_section import show_system
from edge.bench.timing import Pace, Times
from edge.errors import EdgeError, UsageError
from edge.evaluation.classical_methods import method_macs
from edge.evaluation.test_set import FrozenSet, load_frozen_set

INTERRUPTED: Final = 130
"""Exit code that a shell gives for Ctrl-C: unlike a run that is stopped, a bench is then not whole."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of a bench.

    Attributes:
        out: folder for bench.json, .csv, .md and .png, or None for no files.
        rate_hz: of the paced runs, in [Hz].
        ticks: of the paced runs.
        threads: numbers of threads to measure on.
        load: True to measure with the other core busy, too.
        models: folder of the user's own models, or None.
        peers: ONNX files of peers.
        earlier: bench.json of an earlier bench, or None.
        by_surface: True to show PSNR by surface.
        only: names of the subjects to measure, or None for all.
        system: True to measure the whole program, and nothing else.
        sensors: number of sensors with which alone it is measured, or None.
        soak_minutes: of the whole program afterwards, in [min], or None.
        command: command line of the bench.
    """

    out: Path | None
    rate_hz: float
    ticks: int
    threads: tuple[int, ...]
    load: bool
    models: Path | None
    peers: tuple[Path, ...]
    earlier: Path | None
    by_surface: bool
    only: list[str] | None
    system: bool
    sensors: int | None
    soak_minutes: float | None
    command: str


def run(settings: Settings, out: TextIO, err: TextIO) -> int:
    """Measure, show and write; returns the exit code.

    Raises:
        EdgeError: an input cannot be used, or a measurement failed; the measurements so far are written first.
    """
    page = Page(out, err)
    earlier = None if settings.earlier is None else read_record(settings.earlier)
    _make_folder(settings.out)
    frozen = load_frozen_set(subjects.FROZEN_FILE)
    everyone = [*subjects.classical_subjects(frozen.scale), *subjects.bundled_subjects()]
    if settings.models is not None:
        everyone += subjects.models_in(settings.models, page.warn)
    everyone = subjects.chosen(everyone, settings.only)
    peers = [subjects.peer_subject(path) for path in settings.peers]
    measured_ones = [*everyone, *peers]
    record = Record(
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        command=settings.command,
        machine=this_machine(),
        settings={
            "rate_hz": settings.rate_hz,
            "ticks": settings.ticks,
            "threads": list(settings.threads),
            "load": _tried_load() if settings.load else "",
            "seeds": {"peer": subjects.PEER_SEED, "peak": peak.SEED, "intervals": intervals.SEED},
            "test_set_sha256": frozen.sha256(),
        },
    )
    page.say(f"# Error against run time\n\n{tables.about(record)}")
    try:
        if settings.system:
            show_system(settings.ticks, settings.sensors, settings.soak_minutes, record, page)
        else:
            record.facts += [_facts(subject) for subject in measured_ones]
            _errors(everyone, frozen, record, page, by_surface=settings.by_surface)
            _run_times(measured_ones, frozen, settings, record, page)
            _front(record, page)
            show_savings(everyone, frozen, record, page)
            for peer in peers:
                _against(everyone, peer, record, page)
            if earlier is not None and settings.earlier is not None:
                _compare(record, earlier, settings.earlier, page)
        record.complete = True
    except KeyboardInterrupt:
        kept = f": what was measured is in {settings.out}" if settings.out else ""
        page.warn(f"bench stopped before its end{kept}")
        return INTERRUPTED
    finally:
        if record.errors or record.run_times or record.system:  # an earlier bench is not replaced by an empty one
            _write(record, page, settings.out, [Path(subject.path) for subject in measured_ones if subject.path])
    return 0


def _tried_load() -> str:
    """Return the description of the load, tried before minutes are spent; later it runs only next to its own rows."""
    with busy_core() as answer:
        return answer


def _make_folder(folder: Path | None) -> None:
    try:
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {folder}: cannot be made: {error.strerror}: name a folder to write in") from error


def _facts(subject: Subject) -> Facts:
    if subject.path is None:
        return Facts(subject.name, subject.kind, method_macs(subject.name, subject.scale))
    macs = macs_of(Path(subject.path), subjects.taps_of(subject))
    weights = subjects.peer_weights(Path(subject.path)) if subject.kind == "peer" else None
    return Facts(subject.name, subject.kind, macs.count, macs.uncounted, weights)


def _errors(everyone: Sequence[Subject], frozen: FrozenSet, record: Record, page: Page, *, by_surface: bool) -> None:
    record.force_floor_percent = round(force_floor_percent(frozen), 4)
    page.section("Error", tables.error_text(record.force_floor_percent), tables.head(tables.ERROR_COLUMNS))
    for subject in page.tracked(everyone, "error"):
        page.progress(f"error of {subject.name}")
        try:
            for row in error_rows(subject, frozen):
                record.errors.append(row)
                page.say(tables.error_line(row))
        except EdgeError as error:
            page.warn(f"run time only of {subject.name}: {error}")
    if by_surface and record.errors:
        page.say(f"\n{tables.surface_table(record.errors)}")


def _run_times(everyone: Sequence[Subject], frozen: FrozenSet, settings: Settings, record: Record, page: Page) -> None:
    for threads in settings.threads:
        page.progress(f"the machine's peak on {threads}")
        record.peak_gmac_s[threads] = measured({"do": "peak", "threads": threads}, threads)["gmac_s"]
    columns = tables.run_time_columns(settings.rate_hz)
    page.section("Run time", tables.run_time_text(record.peak_gmac_s), tables.head(columns))
    window = frozen.windows(1 + frozen.earlier.shape[1])[0].tolist()
    rows = [
        (subject, threads, load)
        for load in ((False, True) if settings.load else (False,))
        for threads in settings.threads
        for subject in everyone
    ]
    for subject, threads, load in page.tracked(rows, "run times"):
        page.progress(tables.progress_text(subject.name, threads, load))
        fact = record.fact(subject.name)
        with busy_core() if load else contextlib.nullcontext():
            row = _run_time(subject, fact, threads, load, window, settings, record.peak_gmac_s[threads])
        record.run_times.append(row)
        page.say(tables.run_time_line(row, fact))


def _run_time(
    subject: Subject,
    fact: Facts,
    threads: int,
    load: bool,
    window: list[Any],
    settings: Settings,
    peak_gmac_s: float,
) -> RunTimeRow:
    job = {"subject": asdict(subject), "threads": threads}
    start_up_ms, resident_mb = start_up(job | {"do": "first", "window": window}, threads)
    answer = measured(job | {"do": "time", "rate_hz": settings.rate_hz, "ticks": settings.ticks}, threads)
    back_to_back = _times(answer["back_to_back"])
    gmac_s = fact.macs / (back_to_back.p50_us * 1e3)
    return RunTimeRow(
        name=subject.name,
        threads=threads,
        load=load,
        back_to_back=back_to_back,
        paced=Pace(**(answer["paced"] | {"times": _times(answer["paced"]["times"])})),
        gmac_s=gmac_s,
        peak_percent=100 * gmac_s / peak_gmac_s,
        start_up_ms=start_up_ms,
        resident_mb=resident_mb,
    )


def _times(answer: dict[str, Any]) -> Times:
    figures: dict[str, Any] = answer | {"block_p50_us": tuple(answer["block_p50_us"])}
    return Times(**figures)


def _front(record: Record, page: Page) -> None:
    rows = record.front_rows()
    if rows:
        page.section("Pareto front", tables.front_text(record.run_times), tables.head(tables.FRONT_COLUMNS))
        for row in rows:
            page.say(tables.front_line(row))


def _against(everyone: Sequence[Subject], peer: Subject, record: Record, page: Page) -> None:
    text = tables.against_text(peer.name, record.fact(peer.name).weights)
    page.section("Against a peer", text, tables.head(tables.AGAINST_COLUMNS))
    for subject in page.tracked(everyone, "against"):
        page.progress(f"{subject.name} against {peer.name}")
        answer = measured(against.job(asdict(subject), asdict(peer)))
        ratio = intervals.ratio_of(answer["subject_us"], answer["peer_us"], paired=True)
        record.against.setdefault(peer.name, {})[subject.name] = ratio
        page.say(tables.against_line(subject.name, ratio))


def _compare(record: Record, earlier: dict[str, Any], path: Path, page: Page) -> None:
    comparison = compared(record, earlier, path)
    page.section("Compared", tables.compare_text(str(path), comparison), tables.head(tables.COMPARE_COLUMNS))
    for row in comparison.rows:
        page.say(tables.compare_line(row))


def _write(record: Record, page: Page, folder: Path | None, models: Sequence[Path]) -> None:
    if folder is None:
        return
    sources = ["edge/bench/command.py", "edge/bench/worker.py", *(PROGRAM_SOURCES if record.system else [])]
    made = provenance(record.command, sources, [*models, subjects.FROZEN_FILE])
    try:
        (folder / "bench.json").write_text(record.to_json())
        (folder / "bench.csv").write_text(record.to_csv())
        (folder / "bench.md").write_text(with_head("\n".join(page.lines) + "\n", made))
        rows = record.front_rows()
        if rows:
            draw(rows, folder / "bench.png", f"{record.date}, {record.machine}")
    except OSError as error:
        raise BenchError(f"--out {folder}: cannot be written: {error.strerror}") from error
    except BenchError as error:
        page.warn(str(error))
