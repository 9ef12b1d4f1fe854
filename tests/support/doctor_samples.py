"""Samples for the doctor's tests: sensors that are well, each fault by itself, and fingers on corners."""

import numpy as np

from edge.doctor.guided_press import CORNERS
from edge.doctor.link_checks import Watched
from edge.doctor.rehearsal import load_asked
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import ABSENT, Scan, ScanSeries

REST = np.array([32_700, 32_900, 37_300])[:, None, None] + np.arange(16).reshape(4, 4) * 37
COUNTERS = {"received_bytes": 22 * 16 * 400, "frames": 16 * 400, "bad_lines": 0, "refusals": 0}


def healthy_counts(scans: int = 400, sigma: float = 2.0) -> np.ndarray:
    """Return counts of a free, still pad, (scans, 3, 4, 4)."""
    noise = np.random.default_rng(0).normal(0, sigma, (scans, 3, 4, 4))
    return np.rint(REST + noise).astype(np.int32)


def times_ns(scans: int = 400, rate_hz: float = 100.0) -> np.ndarray:
    """Return times on a grid, each up to a millisecond early or late."""
    jitter_s = np.random.default_rng(1).uniform(-0.001, 0.001, scans)
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


class Person:
    """Holds a sensor, mounted somehow, and does what is asked; gives what the pad sends, scan by scan, without end."""

    shape = (1, 3, 4, 4)

    def __init__(self, mounting: Mounting | None = None, grip_counts: float = 4000.0) -> None:
        self._mounting = mounting or Mounting()
        self._felt = np.zeros((3, 4, 4))
        self._gripped, self._grip_counts = 0, grip_counts
        self._rng = np.random.default_rng(7)

    def hear(self, text: str) -> str | None:
        """Do what a request says, and return a line to type, if any."""
        self._felt = load_asked(text, self._felt)
        if "Let the gripper close" in text:
            self._gripped = 150
        return None

    def deformation(self) -> np.ndarray:
        """Return what the wire has over its rest, noiseless, (3, 4, 4)."""
        wire = self._felt * np.array(self._mounting.signs)[:, None, None]
        wire = (wire[[1, 0, 2]] if self._mounting.swap_xy else wire).reshape(3, 16)
        taxels = np.empty((3, 16))
        taxels[:, list(self._mounting.order)] = wire
        return taxels.reshape(3, 4, 4)

    def __iter__(self):
        while True:
            if self._gripped:
                self._gripped -= 1
                self._felt = np.zeros((3, 4, 4))
                self._felt[2] = (self._grip_counts if self._gripped else 0.0) / 16
            yield np.rint(REST + self.deformation() + self._rng.normal(0, 2, (3, 4, 4))).astype(np.int32)


def visit(mounting: Mounting | None = None, *, rest: int = 20) -> np.ndarray:
    """Return the deformations of a pad that a person presses as asked, (n, 3, 4, 4).

    Between presses are `rest` scans; each press, and each push, takes 45.
    """
    person, seen = Person(mounting), []
    for corner in CORNERS:
        for request, scans in (("Let go.", rest), (f"the {corner} corner", 45), ("push towards", 45)):
            person.hear(request)
            seen += [person.deformation()] * scans
    person.hear("Let go.")
    return np.stack(seen + [person.deformation()] * 2 * rest)
