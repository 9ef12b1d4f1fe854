"""The whole program for minutes, taking turns between rest and contact, for growth of memory and drift of latency.

    python tests/system/soak.py MINUTES [SENSORS]

writes the result as JSON.
"""

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from edge.bench.errors import BenchError
from edge.bench.program import Play, Program, edge_sr
from edge.terminal.argument_types import whole
from edge.terminal.progress_bar import tracked

WARM_UP_S: Final = 6.0
"""Length of both phases, in [s], so that everything has been used once."""
WINDOW_S: Final = 5.0
"""Length of one turn of rest and contact, in [s], so that windows can be compared."""
_PLAY: Final = Play(pressed=250, moving=True)
THIRD_FROM: Final = 3
"""Number of sensors from which a third of them is touched; all of fewer are."""


@dataclass(frozen=True, slots=True)
class Window:
    """Measurement of some seconds of a soak.

    Attributes:
        end_s: since the first began, in [s].
        resident_mb: memory at its end, in [MB].
        quiet_us: lower quartile of the latency from scan to pattern, in [us]: it depends least on other work of the
            machine.
        threads: at its end.
        descriptors: open ones, at its end.
        overruns: scans thrown away unseen, so far.
    """

    end_s: float
    resident_mb: float
    quiet_us: float
    threads: int
    descriptors: int
    overruns: int


@dataclass(frozen=True, slots=True)
class Soak:
    """Result of a soak.

    Attributes:
        minutes: its length.
        memory_mb_per_minute: least-squares slope of the memory.
        memory_half: half of that slope's 95 % interval, in [MB per minute].
        latency_ratio: of quiet latencies, last third to first, medians of windows.
        windows: measurements that it is computed from.
    """

    minutes: float
    memory_mb_per_minute: float
    memory_half: float
    latency_ratio: float
    windows: tuple[Window, ...]


def soak(minutes: float, sensors: int = 1) -> Soak:
    """Run the program for so long with so many sensors, with a progress bar; at least three windows.

    Raises:
        BenchError: the program ended early.
    """
    play = replace(_PLAY, sensors=sensors, touched=-(-sensors // 3) if sensors >= THIRD_FROM else None)
    with tempfile.TemporaryDirectory() as folder, edge_sr(Path(folder), play) as program:
        program.skip(WARM_UP_S)
        count = max(3, round(60 * minutes / WINDOW_S))
        windows = list(tracked(_windows(program, count), "soak", "window", count))
    return evaluated(windows)


def evaluated(windows: Sequence[Window]) -> Soak:
    """Compute the result of a soak from its windows, three at least; the latency is NaN where no pattern was made."""
    third = len(windows) // 3
    first, last = (np.nanmedian([w.quiet_us for w in part]) for part in (windows[:third], windows[-third:]))
    growth, half = slope([w.end_s / 60 for w in windows], [w.resident_mb for w in windows])
    return Soak(windows[-1].end_s / 60, growth, half, float(last / first), tuple(windows))


def _windows(program: Program, count: int) -> Iterator[Window]:
    start_s = time.monotonic()
    for _ in range(count):
        lines = program.lines(WINDOW_S)
        latencies_us = [line.record["latency_us"] for line in lines if line.record["latency_us"] is not None]
        threads, descriptors = program.threads_and_descriptors()
        overruns = lines[-1].record["counters"]["overruns"]
        quiet_us = float(np.percentile(latencies_us, 25))
        end_s = time.monotonic() - start_s
        yield Window(end_s, program.resident_mb(), quiet_us, threads, descriptors, overruns)


def slope(times: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """Return the least-squares slope, and half of its 95 % interval."""
    centred = np.asarray(times) - np.mean(times)
    steepness = float(centred @ np.asarray(values) / (centred @ centred))
    rest = np.asarray(values) - np.mean(values) - steepness * centred
    return steepness, float(1.96 * np.sqrt(rest @ rest / (len(times) - 2) / (centred @ centred)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0 when done, 1 on a clear error."""
    parser = argparse.ArgumentParser(prog="python tests/system/soak.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("minutes", type=float, metavar="MINUTES", help="length of the run, .25 at least")
    parser.add_argument("sensors", type=whole(1), nargs="?", default=1, metavar="SENSORS", help="default: 1")
    options = parser.parse_args(arguments)
    minutes: float = options.minutes
    if not 0 < minutes < math.inf:
        parser.error(f"MINUTES is {minutes:g}, expected a positive number")
    try:
        sys.stdout.write(json.dumps(asdict(soak(minutes, options.sensors))))
    except BenchError as error:
        sys.stderr.write(f"soak: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
