"""A scan: one reading of all taxels of one sensor, with masks of the new ones."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import SensorGeometry

SCANS_COUNTED: Final = ("scans", "torn_wire", "torn_source", "repeated", "missing_taxels")
ABSENT: Final = -1  # marker of a taxel without a reading in this scan; raw counts are unsigned, so no reading is -1
HIGHEST_COUNT: Final = 0xFFFF
LONGEST_SENSOR_NAME: Final = 64


def is_sensor_name(name: str) -> bool:
    """Return True if a name is valid for a sensor: names from files are shown, logged and written into others."""
    return name.isprintable() and 0 < len(name) <= LONGEST_SENSOR_NAME


@dataclass(frozen=True, slots=True)
class VendorReading:
    """Values that the vendor's software reports in addition to the counts; None where it does not."""

    newtons: NDArray[np.float32] | None = None  # (3, rows, cols), axes x, y, z, in [N]
    temperature_k: NDArray[np.float32] | None = None  # (rows, cols), in [K]; NaN where a taxel has no thermometer
    ups_hz: NDArray[np.float32] | None = None  # (rows, cols), rate at which each taxel is renewed, in [Hz]


@dataclass(frozen=True, slots=True)
class Scan:
    """One reading of all taxels of one sensor."""

    sensor: str  # name of the sensor on its link, such as the controller id "4"
    number: int  # index of the scan, from 0 for each sensor
    time_ns: int  # monotonic time at which its newest reading arrived, in [ns]
    counts: NDArray[np.int32]  # (3, rows, cols) int32 raw counts, axes x, y, z; ABSENT where not fresh
    fresh: NDArray[np.bool_]  # (rows, cols), True where the taxel's reading arrived in this scan
    # (rows, cols), True where it is fresh and differs from the taxel's reading before. Noise renews a live taxel almost
    # surely, so a fresh taxel that is not renewed is most likely an old reading sent again.
    renewed: NDArray[np.bool_]
    # Time at which its newest reading was on the bus or in the sensor, by the device's time stamps mapped to monotonic
    # time, in [ns]; the difference to `time_ns` is delay.
    device_ns: int | None = None
    vendor: VendorReading | None = None  # None for a link that reads the sensor itself
    unread_ns: int = 0  # longest time that it may have waited, in [ns], since the link was not read meanwhile
    complete: bool = field(init=False, repr=False, compare=False)
    whole: bool = field(init=False, repr=False, compare=False)
    on_bus_ns: int = field(init=False, repr=False, compare=False)
    # Estimated monotonic time before which no reading of it was taken, in [ns]: by the device's time stamps, and by the
    # last time at which the link was empty: the first reading after an opening sets the device's clock, and seems new.
    not_before_ns: int = field(init=False, repr=False, compare=False)
    # Force x, y, z on the pad in [N], by the vendor; None if it is missing, or includes old readings.
    vendor_force_n: tuple[float, float, float] | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        # Computed once, since reader, perception and statistics use them. For sixteen taxels numpy's all() takes ten
        # times as long as a search for a byte.
        find, since_ns = object.__setattr__, self.time_ns - self.unread_ns
        find(self, "complete", False not in self.fresh.tobytes())
        find(self, "whole", False not in self.renewed.tobytes())
        find(self, "on_bus_ns", self.time_ns if self.device_ns is None else self.device_ns)
        find(self, "not_before_ns", min(self.on_bus_ns, since_ns))
        newtons = None if self.vendor is None or not self.complete else self.vendor.newtons
        force_n = None if newtons is None else tuple(newtons.reshape(3, -1).sum(axis=1).tolist())
        find(self, "vendor_force_n", force_n)

    def __repr__(self) -> str:
        taxels = f"{self.fresh.sum()} of {self.fresh.size} taxels, {self.renewed.sum()} renewed"
        return f"<Scan {self.number} of sensor {self.sensor} at {self.time_ns / 1e9:.3f} s: {taxels}>"

    @property
    def torn(self) -> bool:
        """True if some taxels are new and some are not, on the wire or at the source."""
        renewed = self.renewed.tobytes()
        return (True in renewed and False in renewed) or not self.complete

    @property
    def repeated(self) -> bool:
        """True if every taxel arrived and not one is new."""
        return self.complete and True not in self.renewed.tobytes()


def count_scan(counts: dict[str, int], scan: Scan) -> None:
    """Count a scan in those of SCANS_COUNTED."""
    counts["scans"] += 1
    if not scan.whole:
        counts["missing_taxels"] += int(np.count_nonzero(~scan.fresh))
        counts["torn_wire"] += not scan.complete
        counts["torn_source"] += scan.complete and scan.torn
        counts["repeated"] += scan.repeated


class ScanSeries:
    """Sequence of the scans of one sensor: numbers them and separates new readings from old ones."""

    def __init__(self, sensor: str, geometry: SensorGeometry) -> None:
        self._sensor = sensor
        self._number = 0
        self._last = np.full(geometry.scan_shape, ABSENT, dtype=np.int32)
        self._all_fresh = np.ones((geometry.rows, geometry.cols), dtype=bool)

    def close(
        self,
        counts: NDArray[np.int32],
        time_ns: int,
        device_ns: int | None = None,
        vendor: VendorReading | None = None,
        *,
        whole: bool = False,
    ) -> Scan:
        """Return the next scan, of counts (3, rows, cols), ABSENT where no reading came, which become read-only.

        `whole` is True if it certainly holds every taxel, which halves the cost.
        """
        if whole:
            fresh, renewed = self._all_fresh, np.logical_or.reduce(counts != self._last)
            self._last = counts
        else:
            fresh = counts[0] != ABSENT
            renewed = fresh & (counts != self._last).any(axis=0)
            self._last = np.where(fresh, counts, self._last)
        for array in (counts, fresh, renewed):
            array.setflags(write=False)
        scan = Scan(self._sensor, self._number, time_ns, counts, fresh, renewed, device_ns, vendor)
        self._number += 1
        return scan
