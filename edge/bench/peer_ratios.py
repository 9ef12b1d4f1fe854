"""Ratios to a peer's network: both run in one process, in turn, so that a disturbance of the machine affects both."""

import time
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from edge.bench.timing import Run, timed
from firmware_bridge.schedule import Clock

ROUNDS: Final = 30
_BLOCK_NS: Final = 20_000_000
_LEAST_RUNS: Final = 2
_MOST_RUNS: Final = 50


def alternated(
    one: Run, other: Run, rounds: int, clock: Clock = time.perf_counter_ns
) -> tuple[list[float], list[float]]:
    """Return median run times of two, block by block in turn, in [us]; the one that runs first alternates.

    Each block lasts about 20 ms, its first run not counted, because the caches are full of the other's data.
    """
    runs = (one, other)
    lengths = [_block_runs(timed(run, range(3), clock)) for run in runs]
    medians_us: tuple[list[float], list[float]] = ([], [])
    for number in range(rounds):
        for which in (0, 1) if number % 2 else (1, 0):
            took_ns = timed(runs[which], range(1 + lengths[which]), clock)[1:]
            medians_us[which].append(float(np.median(took_ns)) / 1e3)
    return medians_us


def _block_runs(took_ns: Sequence[int]) -> int:
    return int(np.clip(_BLOCK_NS // max(1, min(took_ns)), _LEAST_RUNS, _MOST_RUNS))


def job(subject: dict[str, Any], peer: dict[str, Any]) -> dict[str, Any]:
    """Return the job for a child process."""
    return {"do": "against", "subject": subject, "peer": peer, "rounds": ROUNDS}
