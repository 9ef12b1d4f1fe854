"""Cost of the whole program: edge-sr in a process of its own, its emulated sensors in another, watched from outside.

    python tests/system/program_cost.py [--sensors N] [--against COMMIT] [--round-s T]

prints processor time of all threads in % of one core, the time from a scan's last byte to its record, what was lost,
and memory: at rest, with the status line alone, and in contact, where a third of the sensors is pressed, at least one,
each scan gets a pattern, and records go to a pipe that is read at once. With another commit, both trees run in turn,
round by round, so that what else the machine does meets both. Lost are scans without a pattern or a record, and frames
that did not arrive, which leave records without their scan.
"""

import argparse
import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import numpy as np

from edge.pipeline.result_stream import uncollected
from edge.terminal.progress_bar import tracked
from firmware_bridge.recording.csv_reader import csv_header
from firmware_bridge.zeroing.baseline import Baseline, save_baselines

ROOT: Final = Path(__file__).parents[2]
ROUNDS: Final = 5
SETTLE_S: Final = 2.0
CONTROLLERS: Final = ("4", "6", "8", "10")  # names of the sensors on a bus: at 1 Mbit/s it carries no more
REST_COUNTS: Final = np.array([16_000, 16_400, 38_600]) + 37 * np.arange(16)[:, None]


class CostError(Exception):
    """A measurement that could not be made."""


class Cost(NamedTuple):
    """Cost of a round; times in [us], None where records are not read or scans were lost."""

    cpu_percent: float | None
    p50_us: float | None
    p99_us: float | None
    lost: float | None
    resident_mb: float | None


class Program:
    """Process that reads emulated sensors, and its records where it writes any."""

    def __init__(self, process: subprocess.Popen[bytes], *, silent: bool) -> None:
        self._process, self._silent = process, silent
        self.folder = Path(f"/proc/{process.pid}")

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
                raise CostError(f"edge-sr ended with {self._process.wait()} while it was measured")
            heads.append((time.monotonic_ns(), text.partition(b',"pattern":')[0]))
        return [(time_ns, json.loads(text if text.endswith(b"\n") else text + b"}")) for time_ns, text in heads]

    def cpu_s(self) -> float:
        """Return the processor time of all its threads, as the scheduler counts it, in [s]."""
        try:
            tasks = list((self.folder / "task").iterdir())
            return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) / 1e9
        except OSError as error:
            raise CostError("edge-sr ended while it was measured") from error


def resident_mb(folder: Path) -> float:
    """Return the resident memory of the process of a folder of /proc, in [MB]."""
    return int((folder / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def tree_of(commit: str, folder: Path) -> Path:
    """Write the runtime of a commit into a folder; raises CostError if there is no such commit here."""
    command = ["git", "-C", str(ROOT), "archive", commit, "edge", "firmware_bridge"]
    archive = subprocess.run(command, capture_output=True, check=False)
    if archive.returncode:
        raise CostError(f"{commit}: {archive.stderr.decode(errors='replace').strip().splitlines()[-1]}")
    with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as files:
        files.extractall(folder, filter="data")
    return folder


def measured(part: str, sensors: int, seconds: float, tree: Path = ROOT) -> Cost:
    """Measure one round of the program as it is in a tree; raises CostError if a process ended."""
    with tempfile.TemporaryDirectory() as name, edge_sr(Path(name), part, sensors, tree) as program:
        settled = program.records(SETTLE_S)
        before_s, start_s = program.cpu_s(), time.monotonic()
        records = program.records(seconds)
        cpu_percent = 100 * (program.cpu_s() - before_s) / (time.monotonic() - start_s)
        resident, stamps = resident_mb(program.folder), (Path(name) / "stamps.txt").read_text()
    times_ns: dict[str, list[int]] = defaultdict(list)
    for stamp in stamps.splitlines():
        sensor, _, time_ns = stamp.partition(" ")
        times_ns[sensor].append(int(time_ns))
    first, last = (_newest_counters(some) for some in (settled, [*settled, *records]))
    # Scans without a pattern or a record, and frames; those of the start do not count.
    counted = ("dropped", "overruns", "unwritten", "missing_taxels", "duplicates")
    lost = sum(last.get(name, 0) - first.get(name, 0) for name in counted)
    beyond = any(record["scan"] >= len(times_ns[record["sensor"]]) for _, record in records)
    # What makes the numbers of scans differ from those of the emulator.
    differ = any(last.get(name, 0) for name in ("missing_taxels", "missed", "resynchronised", "abandoned"))
    if not records or beyond or differ:
        return Cost(cpu_percent, None, None, lost, resident)
    took_us = [(at_ns - times_ns[record["sensor"]][record["scan"]]) / 1e3 for at_ns, record in records]
    p50_us, p99_us = np.percentile(took_us, (50, 99)).tolist()
    return Cost(cpu_percent, p50_us, p99_us, lost, resident)


def _newest_counters(records: Sequence[tuple[int, dict[str, Any]]]) -> dict[str, int]:
    return next((record["counters"] for _, record in reversed(records) if record.get("counters")), {})


@contextmanager
def edge_sr(folder: Path, part: str, sensors: int, tree: Path = ROOT) -> Iterator[Program]:
    """Run `edge-sr` of a tree over emulated sensors, with stored baselines; all files lie in `folder`."""
    buses = -(-sensors // len(CONTROLLERS))
    prefixes = [""] if buses == 1 else [f"bus{bus}/" for bus in range(buses)]
    names = [prefixes[number % buses] + CONTROLLERS[number // buses] for number in range(sensors)]
    rest = REST_COUNTS.reshape(4, 4, 3).transpose(2, 0, 1).astype(np.float32)
    save_baselines(folder / "zero.json", [Baseline.of(name, rest, time.time(), 100, "file") for name in names])
    pressed = -(-sensors // 3) if part == "in contact" else 0
    played = [_recording(folder / f"{number}.csv", number, pressed=number < pressed) for number in range(sensors)]
    command = [str(ROOT / "tests/support/emulated_buses.py"), "--buses", str(buses), "--rate-hz", "100"]
    command += ["--frame-us", str(130 * -(-sensors // buses)), "--stamps", str(folder / "stamps.txt")]
    program = ["-m", "edge.cli.main", "--baseline", str(folder / "zero.json")]
    program += ["--sink", "status"] if part == "at rest" else ["--sink", "jsonl:-", "--every-scan"]
    pipe, null = subprocess.PIPE, subprocess.DEVNULL
    with started([*command, *map(str, played)], ROOT, stdin=pipe, stdout=pipe) as emulators:
        try:
            ports = [emulators.stdout.readline().decode().strip() if emulators.stdout else "" for _ in range(buses)]
            if not all(ports):
                raise CostError("the emulator did not start")
            for prefix, port in zip(prefixes, ports, strict=True):
                program += ["--source", f"{prefix.replace('/', '=')}slcan:{port}"]
            with (
                uncollected(),  # or a pause of our own collector would count as the program's
                started(program, tree, stdin=null, stderr=null, stdout=pipe) as process,
            ):
                try:
                    yield Program(process, silent=part == "at rest")
                finally:
                    process.kill()  # its last records are of no interest
        finally:
            if emulators.stdin:
                emulators.stdin.close()


def started(
    arguments: Sequence[str], tree: Path, *, stdin: int, stdout: int, stderr: int | IO[bytes] | None = None
) -> subprocess.Popen[bytes]:
    """Start Python in the tree; its bytecode is kept, as that of an installed program is."""
    paths = os.pathsep.join([str(tree), os.environ.get("PYTHONPATH", "")])
    variables = os.environ | {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": ""}
    command = [sys.executable, *arguments]
    return subprocess.Popen(command, env=variables, stdin=stdin, stdout=stdout, stderr=stderr, start_new_session=True)


def _recording(path: Path, number: int, *, pressed: bool) -> Path:
    """Write 500 scans of a sensor at rest, or in a contact that moves, so that each differs from the one before."""
    rng = np.random.default_rng([0, number])
    counts = REST_COUNTS + rng.integers(-3, 4, (500, 16, 3))
    if pressed:
        turn = 2 * np.pi * np.arange(500)[:, None] / 100
        taxels = np.arange(16)
        away = (taxels // 4 - 1.5 - np.sin(turn)) ** 2 + (taxels % 4 - 1.5 - np.cos(turn)) ** 2
        counts[:, :, 2] += np.rint(3000 * np.exp(-2 * away)).astype(int)  # local, as no drift is
    np.savetxt(path, counts.reshape(500, -1), "%d", ",", header=",".join(csv_header()), comments="")
    return path


def show(sensors: int, against: str | None, round_s: float) -> None:
    """Measure the program, in turn with another commit where one is named, and print a line for each part of both."""
    with tempfile.TemporaryDirectory() as name:
        trees = {"now": ROOT} | ({} if against is None else {against: tree_of(against, Path(name))})
        for part in ("at rest", "in contact"):
            costs: dict[str, list[Cost]] = defaultdict(list)
            for _ in tracked(range(ROUNDS), part, "round"):
                for tree, folder in trees.items():
                    costs[tree].append(measured(part, sensors, round_s, folder))
            for tree, rounds in costs.items():
                print(f"{part}, {sensors} sensors, {tree}: {_cells(rounds)}")
            if against is not None:
                pairs = zip(costs["now"], costs[against], strict=True)
                print(f"{part}, now over {against}: {_cells([ratio(*pair) for pair in pairs])}")


def ratio(one: Cost, other: Cost) -> Cost:
    """Return the ratios of two rounds, where both have a figure."""
    return Cost(*(above / below if above and below else None for above, below in zip(one, other, strict=True)))


def _cells(rounds: Sequence[Cost]) -> str:
    """Return the medians of all rounds, with the least and the most."""
    cells: list[str] = []
    for name, values in zip(Cost._fields, zip(*rounds, strict=True), strict=True):
        known = sorted(value for value in values if value is not None)
        if known:
            middle, low, high = (f"{value:.4g}" for value in (known[len(known) // 2], known[0], known[-1]))
            cells.append(f"{name} {middle} ({low} to {high})")
    return ", ".join(cells)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", type=int, default=1, metavar="N", help="default: 1")
    parser.add_argument("--against", metavar="COMMIT", help="measure in turn with that of another commit")
    parser.add_argument("--round-s", type=float, default=6.0, metavar="T", help=f"of {ROUNDS} rounds each, default 6")
    options = parser.parse_args(arguments)
    try:
        show(options.sensors, options.against, options.round_s)
    except CostError as error:
        print(f"program cost: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
