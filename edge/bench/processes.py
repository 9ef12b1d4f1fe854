"""Processes of their own for measurements: threads, memory and start-up are properties of a process."""

import json
import os
import subprocess
import sys
import time
from typing import Any, Final

import numpy as np

from edge.bench.errors import BenchError

_THREAD_VARIABLES: Final = tuple(f"{library}_NUM_THREADS" for library in ("OMP", "OPENBLAS", "MKL", "BLIS"))
STARTS: Final = 5
"""Number of starts whose median is the start-up."""


def measured(job: dict[str, Any], threads: int = 1) -> dict[str, Any]:
    """Return a child's result of a job of `edge.bench.timing`.

    Raises:
        BenchError: the child failed; its last line is in the message.
    """
    # The child imports the same modules as this process, however they were located.
    script = f"import sys; sys.path[:] = {sys.path!r}; from edge.bench.timing import main; sys.exit(main())"
    variables = dict.fromkeys((*_THREAD_VARIABLES, "VECLIB_MAXIMUM_THREADS"), str(threads))  # of numpy's BLAS
    command, pipe = [sys.executable, "-c", script], subprocess.PIPE
    environment = os.environ | variables
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment) as child:
        try:
            output, complaint = child.communicate(json.dumps(job))
        finally:
            child.kill()  # after a Ctrl-C, Popen itself would leave it running
    if child.returncode != 0:
        last = (complaint.strip().splitlines() or [f"ended with {child.returncode}"])[-1]
        raise BenchError(f"{job['do']} of {job.get('subject', {}).get('name', 'the machine')} failed: {last}")
    return json.loads(output)


def start_up(job: dict[str, Any], threads: int = 1) -> tuple[float, float | None]:
    """Return the median time from the spawn of a process to its first pattern in [ms], imports and all, and its memory.

    The memory is the most resident until then, median, in [MB]; None where the system does not show it.
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
