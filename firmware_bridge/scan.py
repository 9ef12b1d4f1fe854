"""A scan: one reading of all taxels of one sensor, and which of them are new."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.geometry import SensorGeometry

ABSENT: Final = -1
"""Stands where a taxel gave no reading in this scan; raw counts are unsigned, so no reading is -1."""


@dataclass(frozen=True, slots=True)
class Scan:
    """One reading of all taxels of one sensor.

    Attributes:
        sensor: name of the sensor on its link, such as the controller id "4".
        number: counts the scans of this sensor from 0.
        time_ns: monotonic time at which its newest reading arrived, in [ns].
        counts: (3, rows, cols) int32 raw counts, axes x, y, z; ABSENT where not fresh.
        fresh: (rows, cols) bool, the taxel's reading arrived in this scan.
        renewed: (rows, cols) bool, fresh and different from that taxel's reading before. Noise
            renews a live taxel almost surely, so a fresh taxel that is not renewed is most
            likely an old reading sent again.
    """

    sensor: str
    number: int
    time_ns: int
    counts: NDArray[np.int32]
    fresh: NDArray[np.bool_]
    renewed: NDArray[np.bool_]

    @property
    def complete(self) -> bool:
        """Every taxel's reading arrived."""
        return bool(self.fresh.all())

    @property
    def torn(self) -> bool:
        """Some taxels are new and some are not, on the wire or at the source."""
        return bool(self.renewed.any() and not self.renewed.all()) or not self.complete

    @property
    def repeated(self) -> bool:
        """Every taxel arrived and none is new."""
        return self.complete and not bool(self.renewed.any())


class ScanSeries:
    """The scans of one sensor in their order: numbers them and tells new readings from old ones."""

    def __init__(self, sensor: str, geometry: SensorGeometry) -> None:
        self._sensor = sensor
        self._number = 0
        self._last = np.full(geometry.scan_shape, ABSENT, dtype=np.int32)

    def close(self, counts: NDArray[np.int32], time_ns: int) -> Scan:
        """The next scan.

        Args:
            counts: (3, rows, cols), ABSENT where no reading came; kept and made read-only.
            time_ns: arrival of its newest reading, in [ns].
        """
        fresh = counts[0] != ABSENT
        renewed = fresh & (counts != self._last).any(axis=0)
        self._last = np.where(fresh, counts, self._last)
        for array in (counts, fresh, renewed):
            array.setflags(write=False)
        scan = Scan(self._sensor, self._number, time_ns, counts, fresh, renewed)
        self._number += 1
        return scan
