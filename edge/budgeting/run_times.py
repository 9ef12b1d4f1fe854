"""Run times of models on this machine, each run at its tick as on a robot; takes a few seconds."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.model_interface import Model
from edge.terminal.progress_bar import Progress
from firmware_bridge.schedule import Clock, Ticker

ROUNDS: Final = 3
"""Rounds in which the models take turns, so that a bad second of a shared host does not fall on one model alone."""
ROUND_TICKS: Final = 50
LEAST_RATE_HZ: Final = 50.0
"""Least rate of a calibration; slower sensors are calibrated at this one, or it would take too long."""
SEED: Final = 1
WINDOWS: Final = 16


@dataclass(frozen=True, slots=True)
class RunTime:
    """Run time of a model at the sensor's rate.

    Attributes:
        p50_us: median, in [us].
        p99_us: the 149th of 150 in order, in [us]. It exceeds the true 99th percentile in 44 of 100 calibrations, the
            longest of 150 would in 78: whatever the distribution, no other of them is nearer to even.
    """

    p50_us: float
    p99_us: float

    @classmethod
    def of(cls, took_us: NDArray[np.float64]) -> "RunTime":
        """Summarise run times (n,) in [us]."""
        p50, p99 = np.percentile(took_us, [50, 99], method="inverted_cdf")
        return cls(float(p50), float(p99))


def calibrate(
    models: Sequence[Model],
    rate_hz: float,
    *,
    stop: threading.Event,
    ticker_of: Callable[[float], Ticker] = Ticker,
    clock_ns: Clock = time.perf_counter_ns,
) -> list[RunTime] | None:
    """Measure the run time of each model on seeded random windows, since it does not depend on their values.

    Args:
        models: models to run on this thread.
        rate_hz: rate of the sensor, in [Hz].
        stop: event that ends the measurement early.
        ticker_of: makes the ticker of a rate.
        clock_ns: measures a run, in [ns].

    Returns:
        One for each model, or None if it was stopped.
    """
    rng = np.random.default_rng(SEED)
    took_us = np.zeros((len(models), ROUNDS, ROUND_TICKS))
    with Progress("run times", len(models) * ROUNDS * ROUND_TICKS, "run") as bar:
        for round_ in range(ROUNDS):
            for index, model in enumerate(models):
                contract = model.contract
                shape = (WINDOWS, contract.taps, 3, contract.rows, contract.cols)
                windows = (rng.standard_normal(shape) * 1000).astype(np.float32)
                ticker = ticker_of(max(rate_hz, LEAST_RATE_HZ))
                for tick in range(ROUND_TICKS):
                    if stop.is_set():
                        return None
                    ticker.wait()
                    start_ns = clock_ns()
                    model.run(contract.scale_window(windows[tick % WINDOWS]))
                    took_us[index, round_, tick] = (clock_ns() - start_ns) / 1e3
                bar.advance(ROUND_TICKS)  # not while it measures
    return [RunTime.of(took) for took in took_us.reshape(len(models), -1)]
