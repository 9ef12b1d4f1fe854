"""Process that is measured: it takes one job as JSON on stdin, and writes the result as JSON on stdout."""

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge.bench.contenders import FROZEN_FILE, Subject, opened
from edge.bench.timing import Run
from edge.errors import EdgeError

_SPIN_SIZE: Final = 128


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
    from edge.bench.timing import back_to_back, paced

    run = _run(subject, threads)
    return {"back_to_back": asdict(back_to_back(run, ticks)), "paced": asdict(paced(run, rate_hz, ticks))}


def _against(subject: dict[str, Any], peer: dict[str, Any], rounds: int) -> dict[str, Any]:
    from edge.bench.peer_ratios import alternated

    ours_us, peers_us = alternated(_run(subject, 1), _run(peer, 1), rounds)
    return {"subject_us": ours_us, "peer_us": peers_us}


def _peak(threads: int) -> dict[str, float]:
    from edge.bench.peak import peak_gmac_s

    return {"gmac_s": peak_gmac_s(threads)}


def _spin(core: int | None) -> None:
    """Keep a core busy until the parent process has gone."""
    if core is not None:
        os.sched_setaffinity(0, {core})
    parent = os.getppid()
    sys.stdout.write("spinning\n")
    sys.stdout.flush()
    factor = np.full((_SPIN_SIZE, _SPIN_SIZE), 1 / _SPIN_SIZE, dtype=np.float32)
    product = factor
    while os.getppid() == parent:
        for _ in range(100):
            product = product @ factor


JOBS: Final[dict[str, Callable[..., Any]]] = {
    "first": _first,
    "time": _time,
    "against": _against,
    "peak": _peak,
    "spin": _spin,
}


def _run(subject: dict[str, Any], threads: int) -> Run:
    """Return an inference on the test set's windows in turn, with all taps that there are."""
    from edge.evaluation.test_set import load_frozen_set

    frozen = load_frozen_set(FROZEN_FILE)
    windows = frozen.windows(1 + frozen.earlier.shape[1])
    infer = opened(Subject(**subject), threads)
    return lambda number: infer(windows[number % len(windows)])


def resident_mb() -> float | None:
    """Return the most memory that this process has held at once, in [MB]; None where the system does not show it."""
    status = Path("/proc/self/status")
    if status.exists():
        lines = status.read_text().splitlines()
        return next((int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM:")), None)
    try:
        import resource
    except ImportError:
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / 1e6 if sys.platform == "darwin" else most * 1024 / 1e6
