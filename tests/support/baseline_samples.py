"""Baseline made by hand, for the tests of zeroing and of baseline files."""

import numpy as np

from firmware_bridge.zeroing.baseline import (
    Baseline,
)

REST = np.array([16_000, 16_400, 38_600])[:, None, None] + np.arange(16).reshape(4, 4) * 90


def made(counts: np.ndarray = REST, sensor: str = "4", created_unix_s: float = 1_000.0) -> Baseline:
    return Baseline.of(sensor, counts, created_unix_s, scans=100, origin="start-up")
