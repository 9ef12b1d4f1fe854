"""Taxel readings to scans. No I/O, no clock.

The wire has no end-of-scan marker. A scan closes when every taxel has come, or when a taxel comes
again (then the scan is torn), or when too much time has passed for its readings to belong together.

What this cannot see: where a cycle of the controller begins. Who joins in mid-cycle, or loses the
first frame of one, gets complete scans that each hold taxels of two neighbouring cycles, until the
next torn scan puts the cut elsewhere; and where many frames are lost at once, one scan may join two
cycles that lie further apart. And nothing closes while no reading comes: half a scan at the end of
a stream is never given out.
"""

from typing import Final

import numpy as np

from firmware_bridge.device_clock import DeviceTime
from firmware_bridge.geometry import SensorGeometry
from firmware_bridge.scan import ABSENT, Scan, ScanSeries
from firmware_bridge.xela import Cycle, Reading

LONGEST_SCAN_NS: Final = 1_000_000_000
"""The slowest sensor on record renews a taxel four times a second; older readings are another scan's."""
LONGEST_PAUSE_NS: Final = 60_000_000
"""Between two readings of one scan: that sensor's come 17 ms apart, and an FTDI chip keeps them for 16. After a longer
one, as where the bus was off for a moment, what comes is of another press."""

_COUNTED: Final[tuple[str, ...]] = (
    "scans",
    "torn_wire",
    "torn_source",
    "repeated",
    "missing_taxels",
    "duplicates",
    "unconfirmed",
    "abandoned",
)


class ScanAssembler:
    """Sorts readings into the scans of their sensors.

    A sensor exists from its first scan with at least half of the taxels on: one flipped bit in an
    id must not invent a finger. (Half, because that is what the wrong model map shows.)

    Memory: one open scan per sensor name; a ModelMap has at most 16 names.
    """

    def __init__(self, geometry: SensorGeometry) -> None:
        self._geometry = geometry
        self._readings = 0
        self._newest_ns = 0
        self._sensors: dict[str, _Sensor] = {}

    def feed(self, reading: Reading, time_ns: int, device: DeviceTime | None = None) -> list[Scan]:
        """Scans that this reading closes.

        Args:
            reading: of one taxel.
            time_ns: monotonic time of its arrival, in [ns].
            device: when it was on the bus, by the device's time stamps.
        """
        self._readings += 1
        self._newest_ns = time_ns
        sensor = self._sensors.get(reading.sensor)
        if sensor is None:
            sensor = self._sensors[reading.sensor] = _Sensor(reading.sensor, self._geometry)
        return sensor.feed(reading, time_ns, device)

    def takes(self, cycle: Cycle) -> bool:
        """Whether a cycle may be fed as one; otherwise it must be, reading by reading."""
        sensor = self._sensors.get(cycle.sensor)
        return sensor is not None and sensor.between_cycles(cycle.taxels[0])

    def feed_cycle(self, cycle: Cycle, packed: bytes, time_ns: int, device: DeviceTime | None = None) -> Scan:
        """The scan of a cycle that came as one, which `takes` has said may be.

        Args:
            cycle: its sensor, and the order of its taxels.
            packed: its frames, as `SlcanDecoder.cut` packs them.
            time_ns: monotonic time of its arrival, in [ns].
            device: when its last frame was on the bus, by the device's time stamps.
        """
        self._readings += len(cycle.taxels)
        self._newest_ns = time_ns
        return self._sensors[cycle.sensor].feed_cycle(cycle, packed, time_ns, device)

    def begin_anew(self) -> None:
        """Give up open scans: the link broke, and what comes next does not belong to them."""
        for sensor in self._sensors.values():
            sensor.begin_anew()

    def fewest_missing(self) -> int:
        """Readings that must come at least before a scan can close whole.

        A sensor that a flipped bit invented, or that fell silent in mid-scan, closes none.
        """
        open_ones = (sensor for sensor in self._sensors.values() if sensor.closes_before_long(self._newest_ns))
        return min((sensor.missing for sensor in open_ones), default=self._geometry.taxel_count)

    def counters(self) -> dict[str, int]:
        """Sums over all sensors.

        readings; duplicates: the same frame twice in a row; unconfirmed: readings of sensors that
        do not exist (yet); abandoned: readings of scans that a broken link left open; scans; torn_wire:
        taxels missing; torn_source: complete, but only partly renewed; repeated: nothing renewed; missing_taxels.
        """
        totals = dict.fromkeys(_COUNTED, 0)
        for sensor in list(self._sensors.values()):  # another thread may read the link meanwhile, and find a sensor
            for name, count in sensor.counters().items():
                totals[name] += count
        return {"readings": self._readings} | totals

    def sensor_counters(self) -> dict[str, dict[str, int]]:
        """The same counters apart for each sensor that exists."""
        return {name: sensor.counters() for name, sensor in list(self._sensors.items()) if sensor.confirmed}


class _Sensor:
    """The open scan of one sensor and its counters."""

    def __init__(self, name: str, geometry: SensorGeometry) -> None:
        self.confirmed = False
        self._geometry = geometry
        self._series = ScanSeries(name, geometry)
        self._last: Reading | None = None
        self._taxels: dict[int, Reading] = {}
        self._opened_ns = 0
        self._newest_ns = 0
        self._device: DeviceTime | None = None
        self._counts: dict[str, int] = dict.fromkeys(_COUNTED, 0)

    def counters(self) -> dict[str, int]:
        return dict(self._counts)

    def begin_anew(self) -> None:
        self._counts["abandoned"] += len(self._taxels)
        self._taxels = {}
        self._last = None

    def closes_before_long(self, now_ns: int) -> bool:
        """It exists, and the scan that may be open is not one that it left unfinished."""
        return self.confirmed and (not self._taxels or now_ns - self._opened_ns <= LONGEST_SCAN_NS)

    @property
    def missing(self) -> int:
        """Readings until the open scan is whole."""
        return self._geometry.taxel_count - len(self._taxels)

    def between_cycles(self, next_taxel: int) -> bool:
        """No scan is open, and this taxel was not the last one, so that it cannot be a duplicate."""
        return not self._taxels and (self._last is None or self._last.taxel != next_taxel)

    def feed_cycle(self, cycle: Cycle, packed: bytes, time_ns: int, device: DeviceTime | None) -> Scan:
        counts = cycle.counts(packed)
        last = cycle.taxels[-1]
        self._last = Reading(cycle.sensor, last, *counts[:, last].tolist())
        self.confirmed = True
        counts = counts.reshape(self._geometry.scan_shape)
        return self._count(
            self._series.close_whole(counts, time_ns, None if device is None else device.host_ns), missing=0
        )

    def feed(self, reading: Reading, time_ns: int, device: DeviceTime | None) -> list[Scan]:
        # Twice the same frame in a row is the link's doing. Closing on it would move the cut
        # between scans for ever, and skipping it loses nothing.
        if reading == self._last:
            self._counts["duplicates"] += 1
            return []
        self._last = reading
        closed: list[Scan] = []
        if self._taxels and (reading.taxel in self._taxels or self._is_over(time_ns, device)):
            closed += self._close()
        if not self._taxels:
            self._opened_ns = time_ns
        self._taxels[reading.taxel] = reading
        self._newest_ns, self._device = time_ns, device
        if len(self._taxels) == self._geometry.taxel_count:
            closed += self._close()
        return closed

    def _is_over(self, time_ns: int, device: DeviceTime | None) -> bool:
        """What comes now cannot be of the open scan. Where the device tells times, our own being late splits none."""
        if device is not None and self._device is not None:
            return device.own_ns - self._device.own_ns > LONGEST_PAUSE_NS
        return time_ns - self._newest_ns > LONGEST_PAUSE_NS

    def _close(self) -> list[Scan]:
        taxels, self._taxels = self._taxels, {}
        missing = self._geometry.taxel_count - len(taxels)
        self.confirmed = self.confirmed or len(taxels) >= missing
        if not self.confirmed:
            self._counts["unconfirmed"] += len(taxels)
            return []
        axes_last = np.full((self._geometry.taxel_count, 3), ABSENT, dtype=np.int32)
        axes_last[list(taxels)] = np.array([(reading.x, reading.y, reading.z) for reading in taxels.values()])
        counts = np.ascontiguousarray(axes_last.T).reshape(self._geometry.scan_shape)
        device_ns = None if self._device is None else self._device.host_ns
        return [self._count(self._series.close(counts, self._newest_ns, device_ns), missing)]

    def _count(self, scan: Scan, missing: int) -> Scan:
        self._counts["scans"] += 1
        if not scan.whole:
            self._counts["missing_taxels"] += missing
            self._counts["torn_wire"] += missing > 0
            self._counts["repeated"] += scan.repeated
            self._counts["torn_source"] += missing == 0 and scan.torn
        return scan
