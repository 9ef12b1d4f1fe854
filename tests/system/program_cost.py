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
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.pipeline.result_stream import uncollected
from edge.terminal.progress_bar import tracked
from firmware_bridge.recording.csv_reader import csv_header
from firmware_bridge.zeroing.baseline import Baseline, save_baselines

ROOT: Final = Path(__file__).parents[2]
ROUNDS: Final = 5
SETTLE_S: Final = 2.0
CONTROLLERS: Final = ("4", "6", "8", "10")  # names of the sensors on a bus: at 1 Mbit/s it carries no more
REST_COUNTS: Final = np.array([16_000, 16_400, 38_600]) + 37 * np.arange(16)[:, None]


Stamped = tuple[int, dict[str, Any]]  # time of arrival in [ns], and a record without its maps


def records_of(process: subprocess.Popen[bytes], seconds: float) -> list[Stamped]:
    """Return the records of so long, or end in a line where the process ended."""
    if process.stdout is None:  # nothing is written
        time.sleep(seconds)
        return []
    heads: list[tuple[int, bytes]] = []  # parsed later: a pause to parse them would fill the pipe
    end_ns = time.monotonic_ns() + int(seconds * 1e9)
    while not heads or heads[-1][0] < end_ns:
        text = process.stdout.readline()
        if not text:
            sys.exit(f"edge-sr ended with {process.wait()} while it was measured")
        heads.append((time.monotonic_ns(), text.partition(b',"pattern":')[0]))
    return [(time_ns, json.loads(text if text.endswith(b"\n") else text + b"}")) for time_ns, text in heads]


def cpu_s(folder: Path) -> float:
    """Return the processor time of all threads of a process, as the scheduler counts it, in [s]."""
    return sum(int((task / "schedstat").read_text().split()[0]) for task in (folder / "task").iterdir()) / 1e9


def resident_mb(folder: Path) -> float:
    """Return the resident memory of the process of a folder of /proc, in [MB]."""
    return int((folder / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def tree_of(commit: str, folder: Path) -> Path:
    """Write the runtime of a commit into a folder."""
    command = ["git", "-C", str(ROOT), "archive", commit, "edge", "firmware_bridge"]
    archive = subprocess.run(command, stdout=subprocess.PIPE, check=True)
    with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as files:
        files.extractall(folder, filter="data")
    return folder


def measured(part: str, sensors: int, seconds: float, tree: Path = ROOT) -> dict[str, float]:
    """Measure one round of the program as it is in a tree; times are left out where nothing is read, or scans lost."""
    with tempfile.TemporaryDirectory() as name, edge_sr(Path(name), part, sensors, tree) as process:
        folder = Path(f"/proc/{process.pid}")
        settled = records_of(process, SETTLE_S)
        before_s, start_s = cpu_s(folder), time.monotonic()
        records = records_of(process, seconds)
        found = {"cpu_percent": 100 * (cpu_s(folder) - before_s) / (time.monotonic() - start_s)}
        found["resident_mb"], stamps = resident_mb(folder), (Path(name) / "stamps.txt").read_text()
    times_ns: dict[str, list[int]] = defaultdict(list)
    for stamp in stamps.splitlines():
        sensor, _, time_ns = stamp.partition(" ")
        times_ns[sensor].append(int(time_ns))
    first, last = (_newest_counters(some) for some in (settled, [*settled, *records]))
    # Scans without a pattern or a record, and frames; those of the start do not count.
    counted = ("dropped", "overruns", "unwritten", "missing_taxels", "duplicates")
    found["lost"] = sum(last.get(name, 0) - first.get(name, 0) for name in counted)
    beyond = any(record["scan"] >= len(times_ns[record["sensor"]]) for _, record in records)
    # What makes the numbers of scans differ from those of the emulator.
    differ = any(last.get(name, 0) for name in ("missing_taxels", "missed", "resynchronised", "abandoned"))
    if records and not beyond and not differ:
        took_us = [(at_ns - times_ns[record["sensor"]][record["scan"]]) / 1e3 for at_ns, record in records]
        found["p50_us"], found["p99_us"] = np.percentile(took_us, (50, 99)).tolist()
    return found


def _newest_counters(records: Sequence[Stamped]) -> dict[str, int]:
    return next((record["counters"] for _, record in reversed(records) if record.get("counters")), {})


def prefixes_of(sensors: int) -> list[str]:
    """Return the prefix of each bus that so many sensors need."""
    buses = -(-sensors // len(CONTROLLERS))
    return [""] if buses == 1 else [f"bus{bus}/" for bus in range(buses)]


def typed(folder: Path, names: Sequence[str], prefixes: Iterable[str], ports: Iterable[str]) -> list[str]:
    """Return the words that run the program on these ports, with the sensors' baseline stored in the folder."""
    rest = REST_COUNTS.T.reshape(3, 4, 4).astype(np.float32)
    save_baselines(folder / "zero.json", [Baseline.of(name, rest, time.time(), 100, "file") for name in names])
    sources = [f"{prefix.replace('/', '=')}slcan:{port}" for prefix, port in zip(prefixes, ports, strict=True)]
    words = ["-m", "edge.cli.main", "--baseline", str(folder / "zero.json")]
    return words + [word for source in sources for word in ("--source", source)]


@contextmanager
def edge_sr(folder: Path, part: str, sensors: int, tree: Path = ROOT) -> Iterator[subprocess.Popen[bytes]]:
    """Run `edge-sr` of a tree over emulated sensors, with stored baselines; all files lie in `folder`."""
    prefixes = prefixes_of(sensors)
    buses = len(prefixes)
    names = [prefixes[number % buses] + CONTROLLERS[number // buses] for number in range(sensors)]
    pressed = -(-sensors // 3) if part == "in contact" else 0
    played = [_recording(folder / f"{number}.csv", number, pressed=number < pressed) for number in range(sensors)]
    command = [str(ROOT / "tests/support/emulated_buses.py"), "--buses", str(buses), "--rate-hz", "100"]
    command += ["--frame-us", str(130 * -(-sensors // buses)), "--stamps", str(folder / "stamps.txt")]
    sinks = ["--sink", "status"] if part == "at rest" else ["--sink", "jsonl:-", "--every-scan"]
    pipe, null = subprocess.PIPE, subprocess.DEVNULL
    with started([*command, *map(str, played)], ROOT, stdin=pipe, stdout=pipe) as emulators:
        ports = [emulators.stdout.readline().decode().strip() if emulators.stdout else "" for _ in range(buses)]
        program = [*typed(folder, names, prefixes, ports), *sinks]
        with (
            uncollected(),  # or a pause of our own collector would count as the program's
            started(program, tree, stdin=null, stderr=null, stdout=null if part == "at rest" else pipe) as process,
            ExitStack() as ending,
        ):
            ending.callback(process.kill)  # its last records are of no interest
            yield process


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
    if pressed:  # local, as no drift is
        counts[:, :, 2] += np.rint(3000 * np.exp(-2 * away_from_press(np.arange(500)[:, None]))).astype(int)
    np.savetxt(path, counts.reshape(500, -1), "%d", ",", header=",".join(csv_header()), comments="")
    return path


def away_from_press(cycles: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return squared distances (n, 16) of taxels from a contact that goes round, in pitches, for cycles (n, 1)."""
    turn, taxels = 2 * np.pi * cycles / 100, np.arange(16)
    return (taxels // 4 - 1.5 - np.sin(turn)) ** 2 + (taxels % 4 - 1.5 - np.cos(turn)) ** 2


def _cells(rounds: Sequence[dict[str, float]]) -> str:
    """Return the medians of all rounds, with the least and the most."""
    cells: list[str] = []
    for name in ("cpu_percent", "p50_us", "p99_us", "lost", "resident_mb"):
        known = sorted(found[name] for found in rounds if name in found)
        if known:
            middle, low, high = (f"{value:.4g}" for value in (known[len(known) // 2], known[0], known[-1]))
            cells.append(f"{name} {middle} ({low} to {high})")
    return ", ".join(cells)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line: print a line for each part of the program, and of another commit in turn."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", type=int, default=1, metavar="N", help="default: 1")
    parser.add_argument("--against", metavar="COMMIT", help="measure in turn with that of another commit")
    parser.add_argument("--round-s", type=float, default=6.0, metavar="T", help=f"of {ROUNDS} rounds each, default 6")
    options = parser.parse_args(arguments)
    sensors = options.sensors
    with tempfile.TemporaryDirectory() as name:
        trees = {"now": ROOT} | ({options.against: tree_of(options.against, Path(name))} if options.against else {})
        for part in ("at rest", "in contact"):
            costs: dict[str, list[dict[str, float]]] = defaultdict(list)
            for _ in tracked(range(ROUNDS), part, "round"):
                for tree, folder in trees.items():
                    costs[tree].append(measured(part, sensors, options.round_s, folder))
            for tree, rounds in costs.items():
                print(f"{part}, {sensors} sensors, {tree}: {_cells(rounds)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
