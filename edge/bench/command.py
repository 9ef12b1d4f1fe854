"""Command `edge-sr bench`: its tables, one after the other, and its files."""

import argparse
import csv
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, TextIO

from edge.bench.provenance import provenance, this_machine, with_head
from edge.bench.subjects import (
    FROZEN_FILE,
    Subject,
    chosen,
    error_rows,
    subjects,
)
from edge.errors import EdgeError, UsageError
from edge.evaluation.test_set import FrozenSet, load_frozen_set
from firmware_bridge.schedule import RATE_HZ

_FIGURES: Final = {"p50_us": "p50 us", "p99_us": "p99 us", "p999_us": "p99.9 us", "max_us": "max us"}


class BenchError(EdgeError, RuntimeError):
    """Error of a measurement that could not be made, or of a page that cannot be written."""


class BenchPage:
    """Page of `lines` that are shown at once and kept."""

    def __init__(self, out: TextIO, err: TextIO) -> None:
        self.lines: list[str] = []
        self._out, self._err = out, err

    def say(self, text: str) -> None:
        """Show a line, or several, and keep it."""
        self.lines.append(text)
        print(text, file=self._out, flush=True)

    def row(self, cells: Iterable[str]) -> None:
        """Show a row of the table, and keep it."""
        self.say(f"| {' | '.join(cells)} |")

    def section(self, title: str, text: str, columns: Sequence[str]) -> None:
        """Begin a section and its table."""
        self.say(f"\n## {title}\n\n{text}\n")
        self.row(columns)
        self.say("|---" * len(columns) + "|")

    def warn(self, text: str) -> None:
        """Show a line on stderr."""
        print(f"edge-sr: {text}", file=self._err, flush=True)


def run(options: argparse.Namespace, out: TextIO, err: TextIO) -> int:
    """Measure, show on `out` and write; returns the exit code. Those so far are written before an EdgeError."""
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # Ctrl-C ends its child processes with it
    page, command = BenchPage(out, err), options.typed
    try:
        if options.out is not None:
            options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        where = f"--out {options.out}"
        raise UsageError(f"{where}: cannot be made: {error.strerror}: name a folder to write in") from error
    frozen = load_frozen_set(FROZEN_FILE)
    everyone = chosen(subjects(frozen.scale, options.models, page.warn), options.only)
    date = datetime.now(UTC).isoformat(timespec="seconds")
    page.say(
        f"# Error against run time\n\n{date}, `{command}`\n\n{this_machine()}. {options.ticks} ticks a row at "
        f"{RATE_HZ:g} Hz, on one thread, as the program runs."
    )
    lines: list[dict[str, Any]] = []
    try:
        _errors(everyone, frozen, lines, page)
        _run_times(everyone, options.ticks, lines, page)
    except KeyboardInterrupt:
        kept = f": what was measured is in {options.out}" if options.out else ""
        page.warn(f"bench stopped before its end{kept}")
        return 130  # as a shell's: unlike a run that is stopped, a bench is then not whole
    finally:
        if lines and options.out is not None:  # an earlier bench is not replaced by an empty one
            models = [Path(subject.path) for subject in everyone if subject.path]
            _write(options.out, command, page, lines, models)
    return 0


def _errors(everyone: Sequence[Subject], frozen: FrozenSet, lines: list[dict[str, Any]], page: BenchPage) -> None:
    columns = ("method", "taps given", "PSNR dB", "RMSE %", "SSIM", "global SSIM", "IoU", "edge mm", "covered %")
    page.section("Error", "Frozen test set, means over all frames.", columns)
    for subject in everyone:
        try:
            for row in error_rows(subject, frozen):
                lines.append({"method": row.name, "taps_given": row.given} | row.error)
                page.row((row.name, str(row.given), *_error_cells(row.error)))
        except EdgeError as error:
            page.warn(f"run time only of {subject.name}: {error}")


def _error_cells(error: dict[str, float]) -> tuple[str, ...]:
    return (
        f"{error['psnr_db']:.2f}",
        f"{error['rmse_percent']:.2f}",
        *(f"{error[name]:.3f}" for name in ("ssim", "ssim_global", "contact_iou")),
        f"{error['boundary_mm']:.2f}",
        f"{100 * error['coverage_90']:.1f}" if "coverage_90" in error else "-",
    )


def _run_times(everyone: Sequence[Subject], ticks: int, lines: list[dict[str, Any]], page: BenchPage) -> None:
    columns = ("method", *(f"back to back {figure}" for figure in _FIGURES.values()))
    columns += (*(f"{RATE_HZ:g} Hz {figure}" for figure in _FIGURES.values()), "missed", "CPU %")
    text = (
        "Each row in a process of its own, with all taps that the method takes; only a model that takes poses is "
        "faster with fewer, and not measured so. Missed: ticks whose inference was not done when the next was due."
    )
    page.section("Run time", text, columns)
    for subject in everyone:
        answer = measured({"subject": subject._asdict(), "rate_hz": RATE_HZ, "ticks": ticks})
        paced, both = answer["paced"], {"back_to_back": answer["back_to_back"], "paced": answer["paced"]["times"]}
        cells = [cell for times in both.values() for cell in _percentiles(times)]
        cells += [f"{paced['missed']} of {paced['ticks']}", f"{paced['cpu_percent']:.1f}"]
        page.row((subject.name, *cells))
        figures = {f"{how}_{figure}": times[figure] for how, times in both.items() for figure in _FIGURES}
        figures |= {"missed": paced["missed"], "cpu_percent": paced["cpu_percent"]}
        lines.append({"method": subject.name} | figures)


def measured(job: dict[str, Any]) -> dict[str, Any]:
    """Return a child's run times by `edge.bench.timing`; raises BenchError, with its last line, if it failed."""
    # The child imports the same modules as this process, however they were located.
    script = f"import sys; sys.path[:] = {sys.path!r}; from edge.bench.timing import main; sys.exit(main())"
    libraries = ("OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "BLIS_NUM", "VECLIB_MAXIMUM")
    environment = os.environ | {f"{library}_THREADS": "1" for library in libraries}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, input=json.dumps(job), capture_output=True, text=True, env=environment, check=False)
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or [f"ended with {done.returncode}"])[-1]
        raise BenchError(f"the run time of {job['subject']['name']} was not measured: {last}")
    return json.loads(done.stdout)


def _percentiles(times: dict[str, Any]) -> tuple[str, str, str, str]:
    p999 = "-" if times["runs"] < 1000 else f"{times['p999_us']:.0f}"
    return f"{times['p50_us']:.0f}", f"{times['p99_us']:.0f}", p999, f"{times['max_us']:.0f}"


def _write(
    folder: Path, command: str, page: BenchPage, lines: Sequence[dict[str, Any]], models: Sequence[Path]
) -> None:
    sources = ("edge/bench/subjects.py", "edge/bench/timing.py")
    made = provenance(command, sources, [*models, FROZEN_FILE])
    columns = dict.fromkeys(column for row in lines for column in row)
    try:
        with (folder / "bench.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows(lines)
        (folder / "bench.md").write_text(with_head("\n".join(page.lines) + "\n", made))
    except OSError as error:
        raise BenchError(f"--out {folder}: cannot be written: {error.strerror}") from error
