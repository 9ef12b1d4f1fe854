"""Taxel readings to scans. No I/O, no clock.

The wire has no end-of-scan marker. A scan closes when every taxel has come, or when a taxel comes
again (then the scan is torn), or when it has stood open too long for its readings to belong together.

What this cannot see: where a cycle of the controller begins. Who joins in mid-cycle, or loses the
first frame of one, gets complete scans that each hold taxels of two neighbouring cycles, until the
next torn scan puts the cut elsewhere; and where many frames are lost at once, one scan may join two
cycles that lie further apart. And nothing closes while no reading comes: half a scan at the end of
a stream is never given out.
"""

from typing import Final

import numpy as np

from firmware_bridge.geometry import SensorGeometry
from firmware_bridge.scan import ABSENT, Scan, ScanSeries
from firmware_bridge.slcan import PACKED_BYTES, USUAL_LINE_BYTES, CanFrame, SlcanDecoder
from firmware_bridge.xela import USPA44_MAP, Cycle, ModelMap, Reading, decode, decode_packed

LONGEST_SCAN_NS: Final = 1_000_000_000
"""The slowest sensor on record renews a taxel four times a second; older readings are another scan's."""

_MOST_ORDERS: Final = 1024

_COUNTED: Final[tuple[str, ...]] = (
    "scans",
    "torn_wire",
    "torn_source",
    "repeated",
    "missing_taxels",
    "duplicates",
    "unconfirmed",
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

    def feed(self, reading: Reading, time_ns: int) -> list[Scan]:
        """Scans that this reading closes.

        Args:
            reading: of one taxel.
            time_ns: monotonic time of its arrival, in [ns].
        """
        self._readings += 1
        self._newest_ns = time_ns
        sensor = self._sensors.get(reading.sensor)
        if sensor is None:
            sensor = self._sensors[reading.sensor] = _Sensor(reading.sensor, self._geometry)
        return sensor.feed(reading, time_ns)

    def feed_cycle(self, cycle: Cycle, packed: bytes, time_ns: int) -> Scan | None:
        """The scan of a cycle that came as one; None if it must be fed reading by reading, and nothing was done.

        Args:
            cycle: its sensor, and the order of its taxels.
            packed: its frames, as `SlcanDecoder.cut` packs them.
            time_ns: monotonic time of its arrival, in [ns].
        """
        sensor = self._sensors.get(cycle.sensor)
        if sensor is None or not sensor.between_cycles(cycle.taxels[0]):
            return None
        self._readings += len(cycle.taxels)
        self._newest_ns = time_ns
        return sensor.feed_cycle(cycle, packed, time_ns)

    def fewest_missing(self) -> int:
        """Readings that must come at least before a scan can close whole.

        A sensor that a flipped bit invented, or that fell silent in mid-scan, closes none.
        """
        open_ones = (sensor for sensor in self._sensors.values() if sensor.closes_before_long(self._newest_ns))
        return min((sensor.missing for sensor in open_ones), default=self._geometry.taxel_count)

    def counters(self) -> dict[str, int]:
        """Sums over all sensors.

        readings; duplicates: the same frame twice in a row; unconfirmed: readings of sensors that
        do not exist (yet); scans; torn_wire: taxels missing; torn_source: complete, but only partly
        renewed; repeated: nothing renewed; missing_taxels.
        """
        totals = dict.fromkeys(_COUNTED, 0)
        for sensor in self._sensors.values():
            for name, count in sensor.counters().items():
                totals[name] += count
        return {"readings": self._readings} | totals

    def sensor_counters(self) -> dict[str, dict[str, int]]:
        """The same counters apart for each sensor that exists."""
        return {name: sensor.counters() for name, sensor in self._sensors.items() if sensor.confirmed}


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
        self._counts: dict[str, int] = dict.fromkeys(_COUNTED, 0)

    def counters(self) -> dict[str, int]:
        return dict(self._counts)

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

    def feed_cycle(self, cycle: Cycle, packed: bytes, time_ns: int) -> Scan:
        counts = cycle.counts(packed)
        last = cycle.taxels[-1]
        self._last = Reading(cycle.sensor, last, *counts[:, last].tolist())
        self.confirmed = True
        return self._count(self._series.close_whole(counts.reshape(self._geometry.scan_shape), time_ns), missing=0)

    def feed(self, reading: Reading, time_ns: int) -> list[Scan]:
        # Twice the same frame in a row is the link's doing. Closing on it would move the cut
        # between scans for ever, and skipping it loses nothing.
        if reading == self._last:
            self._counts["duplicates"] += 1
            return []
        self._last = reading
        closed: list[Scan] = []
        if self._taxels and (reading.taxel in self._taxels or time_ns - self._opened_ns > LONGEST_SCAN_NS):
            closed += self._close()
        if not self._taxels:
            self._opened_ns = time_ns
        self._taxels[reading.taxel] = reading
        self._newest_ns = time_ns
        if len(self._taxels) == self._geometry.taxel_count:
            closed += self._close()
        return closed

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
        return [self._count(self._series.close(counts, self._newest_ns), missing)]

    def _count(self, scan: Scan, missing: int) -> Scan:
        self._counts["scans"] += 1
        if not scan.whole:
            self._counts["missing_taxels"] += missing
            self._counts["torn_wire"] += missing > 0
            self._counts["repeated"] += scan.repeated
            self._counts["torn_source"] += missing == 0 and scan.torn
        return scan


class SlcanScans:
    """slcan text to scans: the three pure stages in a row."""

    def __init__(self, model: ModelMap = USPA44_MAP) -> None:
        self._model = model
        self._cycle_bytes = model.geometry.taxel_count * PACKED_BYTES
        self._cycles: dict[bytes, Cycle | None] = {}
        self._decoder = SlcanDecoder()
        self._assembler = ScanAssembler(model.geometry)
        self._foreign = 0

    def feed(self, data: bytes, time_ns: int) -> list[Scan]:
        """Scans that close within `data`, which arrived at `time_ns` [ns]."""
        scans: list[Scan] = []
        for piece in self._decoder.cut(data):
            if isinstance(piece, CanFrame):
                self._feed_reading(decode(piece, self._model), time_ns, scans)
                continue
            start = 0
            while start < len(piece):
                scan = self._feed_cycle(piece[start : start + self._cycle_bytes], time_ns)
                if scan is not None:
                    scans.append(scan)
                    start += self._cycle_bytes
                else:
                    self._feed_reading(decode_packed(piece, start, self._model), time_ns, scans)
                    start += PACKED_BYTES
        return scans

    def bytes_until_scan(self) -> int:
        """How many bytes must come at least before a scan can close whole; from 1."""
        return max(1, self._assembler.fewest_missing() * USUAL_LINE_BYTES - self._decoder.pending_bytes)

    def counters(self) -> dict[str, int]:
        """Counters of all stages; foreign: frames that are none of this model's taxels."""
        return self._decoder.counters() | {"foreign": self._foreign} | self._assembler.counters()

    def _feed_reading(self, reading: Reading | None, time_ns: int, scans: list[Scan]) -> None:
        if reading is None:
            self._foreign += 1
        else:
            scans += self._assembler.feed(reading, time_ns)

    def _feed_cycle(self, packed: bytes, time_ns: int) -> Scan | None:
        """The scan of a sensor's whole cycle; None where this is none, or one of readings before is still open."""
        if len(packed) < self._cycle_bytes:
            return None
        can_ids = packed[::PACKED_BYTES] + packed[1::PACKED_BYTES]
        if can_ids not in self._cycles:
            if len(self._cycles) >= _MOST_ORDERS:  # frames of two sensors mix in many orders
                self._cycles.clear()
            high, low = can_ids[: len(can_ids) // 2], can_ids[len(can_ids) // 2 :]
            self._cycles[can_ids] = self._model.cycle([h << 4 | b >> 4 for h, b in zip(high, low, strict=True)])
        cycle = self._cycles[can_ids]
        return None if cycle is None else self._assembler.feed_cycle(cycle, packed, time_ns)
