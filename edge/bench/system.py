"""Cost of the whole program: edge-sr in a process of its own, its emulated sensors in another, watched from outside.

Processor time at rest and in contact, and the time from a scan's last byte to its record. With another commit, both
trees run in turn, round by round, so that what else the machine does meets both.
"""

import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, Final, NamedTuple, TextIO, TypeVar

import numpy as np

from edge.errors import EdgeError
from edge.pipeline.result_stream import uncollected
from edge.terminal.progress_bar import Progress
from firmware_bridge.recording.csv_reader import CSV_HEADER
from firmware_bridge.zeroing.baseline import Baseline, save_baselines

ROOT: Final = Path(__file__).parents[2]
ROUNDS: Final = 5
SETTLE_S: Final = 2.0
RATE_HZ: Final = 100.0
CONTROLLERS: Final = ("4", "6", "8", "10")  # names of the sensors on a bus: at 1 Mbit/s it carries no more
FRAME_US: Final = 130
COLUMNS: Final = ("what", "CPU %", "last byte to record p50 us", "p99 us", "lost", "MB")
_SCANS: Final = 500
_TEXT: Final = """\
edge-sr in a process of its own reads emulated sensors, a process too, over pseudo-terminals, by buses of four. CPU is
of all its threads, by the scheduler, in % of one core. At rest there is the status line alone; in contact a third of
the sensors, at least one, is pressed, each scan gets a pattern, and records of some 25 kB go to a pipe that is read at
once. Lost: scans without a pattern or a record, and frames that did not arrive, which leave records without their scan.
"""


_Thing = TypeVar("_Thing")


def line(cells: Iterable[str]) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


class BenchError(EdgeError, RuntimeError):
    """Error of a measurement that could not be made, or of an earlier bench that cannot be used."""


class Page:
    """Page of `lines` that are shown at once and kept; progress is shown on a terminal alone, and overwritten."""

    def __init__(self, out: TextIO, err: TextIO) -> None:
        self.lines: list[str] = []
        self._out, self._err = out, err
        self._bar: Progress | None = None

    def say(self, text: str) -> None:
        """Show a line, or several, and keep it."""
        self.lines.append(text)
        self._write(self._out, text)

    def section(self, title: str, text: str, columns: Sequence[str]) -> None:
        """Begin a section and its table."""
        self.say(f"\n## {title}\n\n{text}\n\n{line(columns)}\n{'|---' * len(columns)}|")

    def warn(self, text: str) -> None:
        """Show a line on stderr."""
        self._write(self._err, f"edge-sr: {text}")

    def progress(self, text: str) -> None:
        """Show the current step after the bar."""
        if self._bar is not None:
            self._bar.note(text, at_once=True)

    def tracked(self, things: Sequence[_Thing], what: str) -> Iterator[_Thing]:
        """Yield the things, one after the other, with a progress bar that makes room for lines shown meanwhile."""
        with Progress(what, len(things), "row", stream=self._err) as bar:
            self._bar = bar
            try:
                for thing in things:
                    yield thing
                    bar.advance()
            finally:
                self._bar = None

    def _write(self, stream: TextIO, text: str) -> None:
        with nullcontext() if self._bar is None else self._bar.aside():
            stream.write(text + "\n")
            stream.flush()


class Cost(NamedTuple):
    """Cost of a round; times in [us], None where records are not read or scans were lost."""

    cpu_percent: float
    p50_us: float | None
    p99_us: float | None
    lost: int
    resident_mb: float


class Program:
    """Process that reads emulated sensors, and its records where it writes any."""

    def __init__(self, process: subprocess.Popen[bytes], *, silent: bool) -> None:
        self._process, self._silent = process, silent
        self._folder = Path(f"/proc/{process.pid}")

    def records(self, seconds: float) -> list[tuple[int, dict[str, Any]]]:
        """Return the records of so long without their maps, each with its time of arrival in [ns]."""
        if self._silent or self._process.stdout is None:
            time.sleep(seconds)
            return []
        heads: list[tuple[int, bytes]] = []  # parsed later: a pause to parse them would fill the pipe
        end_ns = time.monotonic_ns() + int(seconds * 1e9)
        while not heads or heads[-1][0] < end_ns:
            text = self._process.stdout.readline()
            if not text:
                raise BenchError(f"edge-sr ended with {self._process.wait()} while it was measured")
            heads.append((time.monotonic_ns(), text.partition(b',"pattern":')[0]))
        return [(time_ns, json.loads(text if text.endswith(b"\n") else text + b"}")) for time_ns, text in heads]

    def cpu_s(self) -> float:
        """Return the processor time of all its threads, as the scheduler counts it, in [s]."""
        try:
            tasks = list((self._folder / "task").iterdir())
            return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) / 1e9
        except OSError as error:
            raise BenchError("edge-sr ended while it was measured") from error

    def resident_mb(self) -> float:
        """Return its resident memory, in [MB]."""
        return int((self._folder / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def tree_of(commit: str, folder: Path) -> Path:
    """Write the runtime of a commit into a folder; raises BenchError if there is no such commit here."""
    command = ["git", "-C", str(ROOT), "archive", commit, "edge", "firmware_bridge"]
    archive = subprocess.run(command, capture_output=True, check=False)
    if archive.returncode:
        raise BenchError(f"{commit}: {archive.stderr.decode(errors='replace').strip().splitlines()[-1]}")
    with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as files:
        files.extractall(folder, filter="data")
    return folder


def show_system(scans: int, sensors: int, against: str | None, page: Page) -> list[dict[str, Any]]:
    """Measure the whole program, in turn with another commit where one is named, and show it row by row.

    Each sensor makes so many scans in all rounds of a row. Raises BenchError if a process ended, or there is no such
    commit.
    """
    found: list[dict[str, Any]] = []
    round_s = scans / RATE_HZ / ROUNDS
    medians = f"Medians of {ROUNDS} rounds of {round_s:g} s, least to most in brackets."
    page.section("The whole program", _TEXT + medians, COLUMNS)
    with tempfile.TemporaryDirectory() as name:
        trees = {"": ROOT}
        if against is not None:
            (Path(name) / "tree").mkdir()
            trees[f", {against}"] = tree_of(against, Path(name) / "tree")
        rounds = [(part, number) for part in ("at rest", "in contact") for number in range(ROUNDS)]
        costs: dict[str, list[Cost]] = defaultdict(list)
        for part, number in page.tracked(rounds, "the program"):
            for tree, folder in trees.items():
                page.progress(part + tree)
                costs[part + tree].append(measured(part, sensors, round_s, folder))
            if number == ROUNDS - 1:
                for tree in trees:
                    cells = map(_middle, zip(*costs[part + tree], strict=True))
                    what = f"{part}, {sensors} sensor{'s' * (sensors > 1)}{tree}"
                    found.append({"method": what} | dict(zip(COLUMNS[1:], cells, strict=True)))
                    page.say(line(map(str, found[-1].values())))
                if against is not None:
                    page.say(line(_ratios(f"{part}, ratio", costs[part], costs[f"{part}, {against}"])))
    return found


def measured(part: str, sensors: int, seconds: float, tree: Path = ROOT) -> Cost:
    """Measure one round of the program as it is in a tree; raises as `show_system`."""
    with tempfile.TemporaryDirectory() as name, edge_sr(Path(name), part, sensors, tree) as program:
        settled = program.records(SETTLE_S)
        before_s, start_s = program.cpu_s(), time.monotonic()
        records = program.records(seconds)
        cpu_percent = 100 * (program.cpu_s() - before_s) / (time.monotonic() - start_s)
        resident_mb, stamps = program.resident_mb(), (Path(name) / "stamps.txt").read_text()
    times_ns: dict[str, list[int]] = defaultdict(list)
    for one in stamps.splitlines():
        sensor, _, time_ns = one.partition(" ")
        times_ns[sensor].append(int(time_ns))
    first, last = (_newest_counters(some) for some in (settled, [*settled, *records]))
    # Scans without a pattern or a record, and frames; those of the start do not count.
    counted = ("dropped", "overruns", "unwritten", "missing_taxels", "duplicates")
    lost = sum(last.get(name, 0) - first.get(name, 0) for name in counted)
    beyond = any(record["scan"] >= len(times_ns[record["sensor"]]) for _, record in records)
    # What makes the numbers of scans differ from those of the emulator.
    differ = any(last.get(name, 0) for name in ("missing_taxels", "missed", "resynchronised", "abandoned"))
    if not records or beyond or differ:
        return Cost(cpu_percent, None, None, lost, resident_mb)
    took_us = [(at_ns - times_ns[record["sensor"]][record["scan"]]) / 1e3 for at_ns, record in records]
    p50_us, p99_us = np.percentile(took_us, (50, 99)).tolist()
    return Cost(cpu_percent, p50_us, p99_us, lost, resident_mb)


def _newest_counters(records: Sequence[tuple[int, dict[str, Any]]]) -> dict[str, int]:
    return next((record["counters"] for _, record in reversed(records) if record.get("counters")), {})


@contextmanager
def edge_sr(folder: Path, part: str, sensors: int, tree: Path = ROOT) -> Iterator[Program]:
    """Run `edge-sr` of a tree over emulated sensors, with stored baselines; all files lie in `folder`."""
    buses = -(-sensors // len(CONTROLLERS))
    prefixes = [""] if buses == 1 else [f"bus{bus}/" for bus in range(buses)]
    names = [prefixes[number % buses] + CONTROLLERS[number // buses] for number in range(sensors)]
    rest = _rest_counts().reshape(4, 4, 3).transpose(2, 0, 1).astype(np.float32)
    save_baselines(folder / "zero.json", [Baseline.of(name, rest, time.time(), 100, "file") for name in names])
    pressed = -(-sensors // 3) if part == "in contact" else 0
    played = [write_recording(folder / f"{number}.csv", number, pressed=number < pressed) for number in range(sensors)]
    command = ["-m", "edge.bench.emulated_buses", "--buses", str(buses)]
    command += ["--rate-hz", str(RATE_HZ), "--frame-us", str(FRAME_US * -(-sensors // buses))]
    command += ["--stamps", str(folder / "stamps.txt"), *map(str, played)]
    program = ["-m", "edge.cli.main", "--baseline", str(folder / "zero.json")]
    program += ["--sink", "status"] if part == "at rest" else ["--sink", "jsonl:-", "--every-scan"]
    pipe, null = subprocess.PIPE, subprocess.DEVNULL
    with _started(command, ROOT, stdin=pipe, stdout=pipe) as emulators:
        try:
            ports = [emulators.stdout.readline().decode().strip() if emulators.stdout else "" for _ in range(buses)]
            if not all(ports):
                raise BenchError("the emulator did not start")
            for prefix, port in zip(prefixes, ports, strict=True):
                program += ["--source", f"{prefix.replace('/', '=')}slcan:{port}"]
            with (
                uncollected(),  # or a pause of our own collector would count as the program's
                _started(program, tree, stdin=null, stderr=null, stdout=pipe) as process,
            ):
                try:
                    yield Program(process, silent=part == "at rest")
                finally:
                    process.kill()  # its last records are of no interest
        finally:
            if emulators.stdin:
                emulators.stdin.close()


def _started(
    arguments: Sequence[str], tree: Path, *, stdin: int, stdout: int, stderr: int | None = None
) -> subprocess.Popen[bytes]:
    """Start Python in the tree; its bytecode is kept, as that of an installed program is."""
    paths = os.pathsep.join([str(tree), os.environ.get("PYTHONPATH", "")])
    variables = os.environ | {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": ""}
    command = [sys.executable, *arguments]
    return subprocess.Popen(command, env=variables, stdin=stdin, stdout=stdout, stderr=stderr, start_new_session=True)


def write_recording(path: Path, number: int, *, pressed: bool) -> Path:
    """Write scans of a sensor at rest, or in a contact that moves, so that each scan differs from the one before."""
    rng = np.random.default_rng([0, number])
    counts = _rest_counts() + rng.integers(-3, 4, (_SCANS, 16, 3))
    if pressed:
        turn = 2 * np.pi * np.arange(_SCANS)[:, None] / 100
        taxels = np.arange(16)
        away = (taxels // 4 - 1.5 - np.sin(turn)) ** 2 + (taxels % 4 - 1.5 - np.cos(turn)) ** 2
        counts[:, :, 2] += np.rint(3000 * np.exp(-2 * away)).astype(int)  # local, as no drift is
    np.savetxt(path, counts.reshape(_SCANS, -1), "%d", ",", header=",".join(CSV_HEADER), comments="")
    return path


def _rest_counts() -> Any:
    return np.array([16_000, 16_400, 38_600]) + 37 * np.arange(16)[:, None]


class Ratio(NamedTuple):
    """Ratio of two medians, and its 95 % interval."""

    ratio: float
    low: float
    high: float

    def __str__(self) -> str:
        shown = [f"{float(f'{value:.3g}'):g}" for value in self]
        return f"{shown[0]} ({shown[1]}..{shown[2]})"


def ratio_of(over: Sequence[float], under: Sequence[float]) -> Ratio:
    """Return the ratio of the medians of two measurements' blocks, of which those of one place belong together.

    The interval is that of 2000 resamples of the blocks. Raises ValueError for no blocks, or not as many of both.
    """
    above, below = np.asarray(over, dtype=np.float64), np.asarray(under, dtype=np.float64)
    if not len(above) or len(above) != len(below):
        raise ValueError(f"{len(above)} blocks over {len(below)}, expected some, and as many of both")
    drawn = np.random.default_rng(0).integers(len(above), size=(2000, len(above)))
    ratios = np.median(above[drawn], axis=1) / np.median(below[drawn], axis=1)
    low, high = np.quantile(ratios, (0.025, 0.975)).tolist()
    return Ratio(float(np.median(above) / np.median(below)), low, high)


def _middle(values: Sequence[float | None]) -> str:
    known = sorted(value for value in values if value is not None)
    if not known:
        return "-"
    shown = [f"{value:.4g}" for value in (known[len(known) // 2], known[0], known[-1])]
    return f"{shown[0]} ({shown[1]} to {shown[2]})"


def _ratios(name: str, costs: Sequence[Cost], others: Sequence[Cost]) -> list[str]:
    """Return the ratios of both trees' rounds, where each was measured."""
    cells = [name]
    for ours, theirs in list(zip(zip(*costs, strict=True), zip(*others, strict=True), strict=True))[:3]:
        both = [pair for pair in zip(ours, theirs, strict=True) if None not in pair]
        cells.append(str(ratio_of(*zip(*both, strict=True))) if both else "-")
    return [*cells, "", ""]
