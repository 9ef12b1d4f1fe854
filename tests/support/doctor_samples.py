"""Samples for the doctor's tests: sensors that are well, each fault by itself, and fingers on corners."""

import numpy as np

from edge.doctor.examine import Watched
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import ABSENT, Scan, ScanSeries

REST = np.array([32_700, 32_900, 37_300])[:, None, None] + np.arange(16).reshape(4, 4) * 37
COUNTERS = {"received_bytes": 22 * 16 * 400, "frames": 16 * 400, "bad_lines": 0, "refusals": 0}


def healthy_counts(scans: int = 400, seed: int = 0, sigma: float = 2.0) -> np.ndarray:
    """Return counts of a free, still pad, (scans, 3, 4, 4)."""
    noise = np.random.default_rng(seed).normal(0, sigma, (scans, 3, 4, 4))
    return np.rint(REST + noise).astype(np.int32)


def times_ns(scans: int = 400, rate_hz: float = 100.0, seed: int = 1) -> np.ndarray:
    """Return times on a grid, each up to a millisecond early or late."""
    jitter_s = np.random.default_rng(seed).uniform(-0.001, 0.001, scans)
    return np.rint((np.arange(scans) / rate_hz + jitter_s + 1) * 1e9).astype(np.int64)


def as_scans(counts: np.ndarray, time_ns: np.ndarray | None = None, sensor: str = "4") -> list[Scan]:
    times = times_ns(len(counts)) if time_ns is None else time_ns
    series = ScanSeries(sensor, USPA44)
    return [series.close(one.copy(), int(at)) for one, at in zip(counts, times, strict=True)]


def silenced(counts: np.ndarray, taxels: list[int], scans: slice = slice(None)) -> np.ndarray:
    counts = counts.copy().reshape(len(counts), 3, 16)
    for taxel in taxels:
        counts[scans, :, taxel] = ABSENT
    return counts.reshape(-1, 3, 4, 4)


def watched(scans: list[Scan], duration_s: float = 4.0, **changes) -> Watched:
    settings = {"counters": COUNTERS, "duration_s": duration_s} | changes
    return Watched(scans={"4": scans}, **settings)


def finger(place: int, force: float = 4000.0) -> np.ndarray:
    """Return z of a finger on a corner as a person sees it, (4, 4), in counts."""
    rows, cols = np.indices((4, 4))
    at_row, at_col = divmod(place, 4)
    # A finger is wider than a taxel, and its middle lies a little inside.
    at_row, at_col = 0.3 + 0.8 * at_row, 0.3 + 0.8 * at_col
    return force * np.exp(-((rows - at_row) ** 2 + (cols - at_col) ** 2) / 1.5)


PUSHES = {0: (1, 1), 3: (-1, 1), 15: (-1, -1), 12: (1, -1)}


def visit(order: list[int], swap: bool, signs: tuple[int, int, int], *, rest: int = 20, hold: int = 45) -> np.ndarray:
    """Return the counts of a pad that a person presses as asked, noiseless and over its rest, (n, 3, 4, 4).

    `order` holds the taxel of the id map at each place as the person sees it; with `swap` the wire's x is the pad's y.
    Between presses are `rest` scans; each press, and each push, takes `hold`.
    """
    seen = []
    for place in (0, 3, 15, 12):
        z = finger(place)
        still = np.stack([np.zeros((4, 4)), np.zeros((4, 4)), z])
        x, y = PUSHES[place]
        pushed = still + np.stack([0.2 * x * z, 0.2 * y * z, np.zeros((4, 4))])
        seen += [np.zeros((3, 4, 4))] * rest + [still] * hold + [pushed] * hold
    seen += [np.zeros((3, 4, 4))] * 2 * rest
    wire = np.stack(seen) * np.array(signs)[:, None, None]
    if swap:
        wire = wire[:, [1, 0, 2]]
    flat = np.empty((len(wire), 3, 16))
    flat[:, :, order] = wire.reshape(len(wire), 3, 16)
    return flat.reshape(-1, 3, 4, 4)
