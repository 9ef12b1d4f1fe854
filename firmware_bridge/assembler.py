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
from firmware_bridge.slcan import SlcanDecoder
from firmware_bridge.xela import USPA44_MAP, ModelMap, Reading, decode

LONGEST_SCAN_NS: Final = 1_000_000_000
"""The slowest sensor on record renews a taxel four times a second; older readings are another scan's."""

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
        self._sensors: dict[str, _Sensor] = {}

    def feed(self, reading: Reading, time_ns: int) -> list[Scan]:
        """Scans that this reading closes.

        Args:
            reading: of one taxel.
            time_ns: monotonic time of its arrival, in [ns].
        """
        self._readings += 1
        sensor = self._sensors.get(reading.sensor)
        if sensor is None:
            sensor = self._sensors[reading.sensor] = _Sensor(reading.sensor, self._geometry)
        return sensor.feed(reading, time_ns)

    def counters(self) -> dict[str, int]:
        """Sums over all sensors.

        readings; duplicates: the same frame twice in a row; unconfirmed: readings of sensors that
        do not exist (yet); scans; torn_wire: taxels missing; torn_source: complete, but only partly
        renewed; repeated: nothing renewed; missing_taxels.
        """
        per_sensor = [sensor.counters() for sensor in self._sensors.values()]
        return {"readings": self._readings} | {name: sum(c[name] for c in per_sensor) for name in _COUNTED}

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
        axes_last[list(taxels)] = [(reading.x, reading.y, reading.z) for reading in taxels.values()]
        counts = np.ascontiguousarray(axes_last.T).reshape(self._geometry.scan_shape)
        scan = self._series.close(counts, self._newest_ns)
        self._counts["scans"] += 1
        self._counts["missing_taxels"] += missing
        self._counts["torn_wire"] += missing > 0
        self._counts["repeated"] += scan.repeated
        self._counts["torn_source"] += missing == 0 and scan.torn
        return [scan]


class SlcanScans:
    """slcan text to scans: the three pure stages in a row."""

    def __init__(self, model: ModelMap = USPA44_MAP) -> None:
        self._model = model
        self._decoder = SlcanDecoder()
        self._assembler = ScanAssembler(model.geometry)
        self._foreign = 0

    def feed(self, data: bytes, time_ns: int) -> list[Scan]:
        """Scans that close within `data`, which arrived at `time_ns` [ns]."""
        scans: list[Scan] = []
        for frame in self._decoder.feed(data):
            reading = decode(frame, self._model)
            if reading is None:
                self._foreign += 1
            else:
                scans += self._assembler.feed(reading, time_ns)
        return scans

    def counters(self) -> dict[str, int]:
        """Counters of all stages; foreign: frames that are none of this model's taxels."""
        return self._decoder.counters() | {"foreign": self._foreign} | self._assembler.counters()
