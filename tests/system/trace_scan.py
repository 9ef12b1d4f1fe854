"""Count the project's own calls on a scan's way from byte to JSON line, and the threads that links take.

    python -m tests.system.trace_scan

An emulated adapter, in a process of its own, plays a press that goes on; `edge-sr` runs in this one, with Python's
profiling hook in every thread. A call is one that enters a function, a generator or a comprehension of the project; of
scans that got a pattern, and of what the reader did between two of them, the median is printed.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, Final

import numpy as np

from edge.api import open_source
from edge.cli.main import main as edge_sr

ROOT: Final = Path(__file__).parents[2]
ROOMS: Final = ("edge", "firmware_bridge")
REST_SCANS: Final = 220
PRESS_SCANS: Final = 200
RATE_HZ: Final = 100.0
RUN_S: Final = 3.5
LINKS: Final = (1, 2, 4)


class Trace:
    """Calls of project functions, cut where a scan's work ends: in the loop its record, in the reader its hand-over.

    Attributes:
        scans: of each pressed scan's way through the loop, calls by function.
        readings: of each scan's way through the reader, the same.
    """

    def __init__(self) -> None:
        self.scans: list[Counter[str]] = []
        self.readings: list[Counter[str]] = []
        self._names: dict[Any, str] = {}
        self._open: dict[int, Counter[str]] = {}
        self._line: dict[int, bool] = {}

    def hook(self, frame: FrameType, event: str, argument: object) -> None:
        """Count one call; the hook of `sys.setprofile` and `threading.setprofile`."""
        code = frame.f_code
        name = self._names.get(code)
        if name is None:
            name = self._names[code] = _name(code)
        if not name:
            return
        calls = self._open.setdefault(threading.get_ident(), Counter())
        if event == "call":
            calls[name] += 1
        elif event == "return" and name == "edge.sinks.jsonl.JsonLinesSink.write":
            if frame.f_locals["result"].run_time_us is not None:
                self.scans.append(calls)
            self._open[threading.get_ident()] = Counter()
        elif event == "return" and name == "edge.pipeline.scan_reader.Source._put":
            if frame.f_locals["scans"]:
                self.readings.append(calls)
            self._open[threading.get_ident()] = Counter()


def _name(code: Any) -> str:
    path = Path(code.co_filename)
    if not path.is_relative_to(ROOT):
        return ""
    place = path.relative_to(ROOT).with_suffix("")
    return f"{'.'.join(place.parts)}.{code.co_qualname}" if place.parts[0] in ROOMS else ""


@contextmanager
def emulated(recording: Path) -> Iterator[str]:
    """Yield the port of an emulated adapter that plays this in a process of its own."""
    command = [sys.executable, "-m", "edge.bench.emulated_buses"]
    command += ["--rate-hz", f"{RATE_HZ:g}", "--jitter-ms", "0", str(recording)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        if process.stdin is None or process.stdout is None:
            raise RuntimeError("the emulator has no pipes")
        yield process.stdout.readline().strip()
        process.stdin.close()


def write_press(path: Path) -> Path:
    """Write a recording of a free pad, then of a press that never holds still, as a CSV."""
    noise = np.random.default_rng(0)
    counts = np.full((REST_SCANS + PRESS_SCANS, 16, 3), (16_000, 16_400, 38_600))
    counts[:, :, 2] += np.arange(16) * 37
    growing = np.linspace(4_000, 9_000, PRESS_SCANS)[:, None]
    counts[REST_SCANS:, 4:12, 2] += growing.astype(int)
    counts += noise.integers(-2, 3, counts.shape)
    head = ",".join(f"txl{taxel}_{axis}" for taxel in range(1, 17) for axis in "xyz")
    np.savetxt(path, counts.reshape(len(counts), -1), fmt="%d", delimiter=",", header=head, comments="")
    return path


def trace_run(links: int = 1) -> Trace:
    """Run `edge-sr` over emulated adapters with a press on each, and count."""
    trace = Trace()
    with ExitStack() as closing:
        folder = Path(closing.enter_context(tempfile.TemporaryDirectory()))
        recording = write_press(folder / "4.csv")
        ports = [closing.enter_context(emulated(recording)) for _ in range(links)]
        sources = [part for port in ports for part in ("--source", f"slcan:{port}")]
        arguments = [*sources, "--duration-s", f"{RUN_S + REST_SCANS / RATE_HZ:g}", "--sink", f"jsonl:{folder}/out"]
        threading.setprofile(trace.hook)
        sys.setprofile(trace.hook)
        try:
            if edge_sr(arguments):
                raise RuntimeError("the run failed")
        finally:
            sys.setprofile(None)
            threading.setprofile(None)  # pyright: ignore[reportArgumentType]
    return trace


def threads_of(links: int) -> list[str]:
    """Return the names of the threads of a source of so many emulated adapters, that of its user included."""
    before = set(threading.enumerate()) - {threading.current_thread()}
    with ExitStack() as closing:
        folder = Path(closing.enter_context(tempfile.TemporaryDirectory()))
        recording = write_press(folder / "4.csv")
        ports = [closing.enter_context(emulated(recording)) for _ in range(links)]
        with open_source(*(f"slcan:{port}" for port in ports)) as source:
            end_s, heard = time.monotonic() + 5, 0
            while heard < 20 * links and time.monotonic() < end_s:
                heard += len(source.take(0.1) or ())
            return sorted(thread.name for thread in set(threading.enumerate()) - before)


def _median(calls: Sequence[Counter[str]]) -> Counter[str]:
    """Return the calls of the scan that had the median number of them."""
    middle = statistics.median_low(one.total() for one in calls)
    return next(one for one in calls if one.total() == middle)


def main() -> int:
    """Print the figures."""
    trace = trace_run()
    scan, reading = _median(trace.scans), _median(trace.readings)
    together = scan + reading
    modules = Counter[str]()
    for name, count in together.items():
        modules[_module(name)] += count
    for name, count in sorted(together.items(), key=lambda called: (-called[1], called[0])):
        print(f"{count:4d} {name}")
    print(
        f"\n{together.total()} calls in {len(modules)} modules at a pressed scan, of {len(trace.scans)}: "
        f"{reading.total()} in the reader, {scan.total()} in the loop"
    )
    for module, count in modules.most_common():
        print(f"{count:4d} {module}")
    for links in LINKS:
        names = threads_of(links)
        print(f"{links} links: {len(names)} threads ({', '.join(names)})")
    return 0


def _module(name: str) -> str:
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        if (ROOT / "/".join(parts[:length])).with_suffix(".py").exists():
            return ".".join(parts[:length])
    return name


if __name__ == "__main__":
    sys.exit(os.EX_OK if main() == 0 else 1)
