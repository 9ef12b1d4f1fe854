"""Recordings in memory: tracks of scans, one per sensor."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import SensorGeometry, pad_of
from firmware_bridge.scans.scan import VendorReading
from firmware_bridge.schedule import NS_PER_S

if TYPE_CHECKING:
    from firmware_bridge.poses import TimedPose
    from firmware_bridge.scans.mounting import Mounting
    from firmware_bridge.zeroing.baseline import Baseline

GEOMETRY_METADATA: Final = "geometry"  # name of the MCAP metadata that holds the pad of all sensors
MOUNTING_METADATA: Final = "mounting"  # name of the MCAP metadata that hold the mounting of a sensor each
SOURCE_METADATA: Final = "source"  # name of the MCAP metadata that holds the kind of source
HIGHEST_COUNT: Final = 0xFFFF
MOST_SENSORS: Final = 64  # most sensors of a recording; one wire can have sixteen
MOST_POSES: Final = 1 << 23  # most poses of a recording: those of a day at 100 Hz, in 3 GB
RATES_HZ: Final = (1e-3, 1e5)  # lowest and highest rate, in [Hz]: beyond them periods in [ns] overflow, or become 0
A_RATE: Final = f"a positive number, {RATES_HZ[0]:g} to {RATES_HZ[1]:g}"


@dataclass(frozen=True, slots=True)
class Track:
    """Scans of one sensor in a recording; what was not recorded is None.

    Attributes:
        counts: (n, 3, rows, cols) int32, ABSENT where a taxel gave no reading.
        time_ns: (n,) int64 monotonic time of each scan in [ns], never falling.
        numbers: (n,) int64 numbers of the scans.
        device_time_ns: (n,) int64 device times on the clock of `time_ns`, in [ns]; -1 where the device had none.
        renewed: (n, rows, cols) bool, True where a reading was new.
        vendor: (n,) values of the vendor's software.
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
        """Pad of the sensor, by its grid where the file does not name it."""
        return self.pad or pad_of(*self.counts.shape[2:])

    @property
    def mean_rate_hz(self) -> float | None:
        """Mean rate by the recorded times, in [Hz]; None without times."""
        if self.time_ns is None or self.time_ns[-1] <= self.time_ns[0]:
            return None
        return (len(self.time_ns) - 1) * NS_PER_S / float(self.time_ns[-1] - self.time_ns[0])


@dataclass(frozen=True, slots=True)
class Recording:
    """Tracks of one file, at least one, each with at least one scan.

    Attributes:
        tracks: one per sensor, in the order in which they first occur.
        rate_hz: rate of each sensor's scans, in [Hz]; None if the file does not state it.
        baselines: baselines at the first scan of each sensor; without sensors that were not zeroed yet.
        mountings: mountings of the sensors, by name. The taxels are in place; only the axes are still to be turned.
        unix_offset_ns: offset from `time_ns` to [ns] since 1970; None if the file does not state it.
        origin: "device" or "emulated", the origin of its scans, however often they were played and recorded again;
            None if the file does not state it.
        poses: poses of the pads, in the order in which they were taken.
        poses_by_row: the times of the poses are rows of the scans, which have no times themselves.
    """

    path: Path
    tracks: tuple[Track, ...]
    rate_hz: float | None
    baselines: "Mapping[str, Baseline]" = field(default_factory=dict)
    mountings: "Mapping[str, Mounting]" = field(default_factory=dict)
    unix_offset_ns: int | None = None
    notes: tuple[str, ...] = ()
    origin: Literal["device", "emulated"] | None = None
    poses: "Sequence[TimedPose]" = ()
    poses_by_row: bool = False


def origin_of(kinds: Iterable[str | None]) -> Literal["device", "emulated"] | None:
    """Return the origin of scans of these kinds of sources together, None if it is uncertain."""
    found = set(kinds)
    if "emulated" in found:
        return "emulated"
    return "device" if found == {"device"} else None


def is_rate(rate_hz: float) -> bool:
    """Return True if scans can come at this rate in [Hz]."""
    return RATES_HZ[0] <= rate_hz <= RATES_HZ[1]
