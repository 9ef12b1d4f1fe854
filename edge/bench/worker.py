"""Process that is measured: it takes one job as JSON on stdin, and writes the result as JSON on stdout."""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge.bench.contenders import FROZEN_FILE, Subject, opened
from edge.errors import EdgeError


def main() -> int:
    """Do the job; returns 1, with a line on stderr, where it cannot be done."""
    job = json.load(sys.stdin)
    try:
        measured = JOBS[job.pop("do")](**job)
    except EdgeError as error:
        sys.stderr.write(f"{' '.join(str(error).split())}\n")
        return 1
    sys.stdout.write(json.dumps(measured))
    return 0


def _first(subject: dict[str, Any], threads: int, window: list[Any]) -> dict[str, Any]:
    """Return the time of the first pattern, and the memory that it took."""
    infer = opened(Subject(**subject), threads)
    infer(np.array(window, dtype=np.float32))
    return {"first_ns": time.monotonic_ns(), "resident_mb": resident_mb()}


def _time(subject: dict[str, Any], threads: int, rate_hz: float, ticks: int) -> dict[str, Any]:
    """Return run times on the test set's windows in turn, with all taps that there are."""
    from edge.bench.timing import back_to_back, paced
    from edge.evaluation.test_set import load_frozen_set

    frozen = load_frozen_set(FROZEN_FILE)
    windows = frozen.windows(1 + frozen.earlier.shape[1])
    infer = opened(Subject(**subject), threads)

    def run(number: int) -> object:
        return infer(windows[number % len(windows)])

    return {"back_to_back": asdict(back_to_back(run, ticks)), "paced": asdict(paced(run, rate_hz, ticks))}


JOBS: Final[dict[str, Callable[..., Any]]] = {"first": _first, "time": _time}


def resident_mb() -> float | None:
    """Return the most memory that this process has held at once, in [MB]; None where the system does not show it."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM:")), None)
