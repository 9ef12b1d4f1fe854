"""Processes of their own for measurements: threads, memory and start-up are properties of a process."""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from edge.bench.errors import BenchError

_THREAD_VARIABLES: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
STARTS: Final = 5
"""Number of starts whose median is the start-up."""


def measured(job: dict[str, Any], threads: int = 1) -> dict[str, Any]:
    """Return a child's result of a job of `edge.bench.worker`, with numpy's BLAS on as many threads.

    Raises:
        BenchError: the child failed; its last line is in the message.
    """
    with _child(threads) as child:
        output, complaint = child.communicate(json.dumps(job))
    if child.returncode != 0:
        last = (complaint.strip().splitlines() or [f"ended with {child.returncode}"])[-1]
        raise BenchError(f"{job['do']} of {job.get('subject', {}).get('name', 'the machine')} failed: {last}")
    return json.loads(output)


def start_up(job: dict[str, Any], threads: int = 1) -> tuple[float, float | None]:
    """Return the median time from the spawn of a process to its first pattern, imports included, and its memory.

    Returns:
        Time in [ms], and the most memory resident until then, median, in [MB]; None where the system does not show it.
    """
    took_ms: list[float] = []
    resident_mb: list[float] = []
    for _ in range(STARTS):
        spawned_ns = time.monotonic_ns()  # one clock for all processes of a machine
        answer = measured(job, threads)
        took_ms.append((answer["first_ns"] - spawned_ns) / 1e6)
        if answer["resident_mb"] is not None:
            resident_mb.append(answer["resident_mb"])
    return float(np.median(took_ms)), float(np.median(resident_mb)) if resident_mb else None


def usable_cores() -> list[int]:
    """Return the numbers of the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


@contextlib.contextmanager
def _child(threads: int) -> Iterator[subprocess.Popen[str]]:
    # The child imports the same modules as this process, however they were located.
    script = f"import sys; sys.path[:] = {sys.path!r}; from edge.bench.worker import main; sys.exit(main())"
    with subprocess.Popen(
        [sys.executable, "-c", script],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | dict.fromkeys(_THREAD_VARIABLES, str(threads)),
    ) as child:
        try:
            yield child
        finally:
            # This does nothing to a child that has ended; after a Ctrl-C, Popen itself would leave it running.
            child.kill()
            child.wait()
