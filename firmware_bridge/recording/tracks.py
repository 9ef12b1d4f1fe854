"""A recording in memory: tracks of scans, one per sensor."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.geometry import SensorGeometry, pad_of
from firmware_bridge.scans.scan import VendorReading
from firmware_bridge.schedule import NS_PER_S

if TYPE_CHECKING:
    from firmware_bridge.scans.mounting import Mounting
    from firmware_bridge.zeroing.baseline import Baseline

GEOMETRY_METADATA: Final = "geometry"
"""Of an MCAP file: the pad of all its sensors."""
MOUNTING_METADATA: Final = "mounting"
"""The same: one a sensor."""
SOURCE_METADATA: Final = "source"
"""The same: what kind of source it was."""
HIGHEST_COUNT: Final = 0xFFFF
MOST_SENSORS: Final = 64
"""On one wire there can be sixteen."""
LAST_TIME_NS: Final = 1 << 60
"""36 years: sums of two times stay below 2^63."""


@dataclass(frozen=True, slots=True)
class Track:
    """The scans of one sensor in a recording.

    Attributes:
        sensor: name of the sensor.
        counts: (n, 3, rows, cols) int32, ABSENT where a taxel gave no reading.
        time_ns: (n,) int64 monotonic time of each scan in [ns], never falling; None if not recorded.
        numbers: (n,) int64, as the scans were numbered; None if not recorded, as what follows.
        device_time_ns: (n,) int64, on the same clock as `time_ns`; -1 where the device gave none.
        renewed: (n, rows, cols) bool, which readings were new.
        vendor: (n,) of what the vendor's software said.
        pad: as the file names it; None if it does not.
    """

    sensor: str
    counts: NDArray[np.int32]
    time_ns: NDArray[np.int64] | None
    numbers: NDArray[np.int64] | None = None
    device_time_ns: NDArray[np.int64] | None = None
    renewed: NDArray[np.bool_] | None = None
    vendor: tuple[VendorReading | None, ...] | None = None
    pad: SensorGeometry | None = None

    @property
    def geometry(self) -> SensorGeometry:
        """The pad, by its grid where the file does not name it."""
        return self.pad or pad_of(*self.counts.shape[2:])

    @property
    def mean_rate_hz(self) -> float | None:
        """Scans a second by the recorded times, or None."""
        if self.time_ns is None or self.time_ns[-1] <= self.time_ns[0]:
            return None
        return (len(self.time_ns) - 1) * NS_PER_S / float(self.time_ns[-1] - self.time_ns[0])


@dataclass(frozen=True, slots=True)
class Recording:
    """One file's tracks, at least one, each with at least one scan.

    Attributes:
        path: of the file.
        tracks: one per sensor, in the order in which they first occur.
        rate_hz: scans a second of each sensor; None if the file does not say.
        baselines: what was subtracted from the first scan of each sensor; without those that were not zeroed yet.
        mountings: of the sensors, by name. The taxels are in place; what is to be done still is to turn the axes.
        unix_offset_ns: added to `time_ns` gives [ns] since 1970; None if the file does not say.
        notes: what whoever plays it should know.
        origin: "device" or "emulated", what its scans come from, however often they were played and recorded again;
            None if the file does not say.
    """

    path: Path
    tracks: tuple[Track, ...]
    rate_hz: float | None
    baselines: "Mapping[str, Baseline]" = field(default_factory=dict)
    mountings: "Mapping[str, Mounting]" = field(default_factory=dict)
    unix_offset_ns: int | None = None
    notes: tuple[str, ...] = ()
    origin: Literal["device", "emulated"] | None = None


def origin_of(kinds: Iterable[str]) -> Literal["device", "emulated"] | None:
    """What scans come from whose file names these kinds of sources."""
    found = set(kinds)
    if "emulated" in found:
        return "emulated"
    return "device" if found == {"device"} else None
