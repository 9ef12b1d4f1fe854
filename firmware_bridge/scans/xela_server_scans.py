"""Stage from readings of the vendor's server to scans. No I/O, no clock.

The server sends its readings at its own pace, old ones again, and the reading of a taxel with older ones of its
neighbours: 507 messages a second were observed for a sensor that renewed seven taxels meanwhile. A taxel has been
renewed if its counts have changed, or if it is due by `ups`: then it has the same counts again. A scan closes once
every taxel has been renewed that is renewed about as often as most; then it holds the newest reading of each.

- A still pad gives scans at the rate of `ups`, repeated ones if it has no noise. A loose cable gives no scan, however
  long the server repeats the last reading: a taxel is absent while its `ups` is 0, and all are while the sensor's time
  stands still. Where all would be absent and their counts go on changing, the usual `ups` replaces the zeros.
- A message that renews most taxels belongs to one cycle, and the others in it count as repeated: noise does that now
  and then, and waiting for them would cost a cycle.
- Within a cycle nothing shows which readings belong together; slow servers mix those of two cycles.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.scans.device_clock import DeviceClock
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import ABSENT, SCANS_COUNTED, Scan, ScanSeries, VendorReading, count_scan
from firmware_bridge.scans.xela_server_messages import MOST_SENSORS, ServerDecoder, ServerMessage, ServerReading
from firmware_bridge.schedule import NS_PER_S, SERVER_READING_OLD_NS

MOST_MISSED: Final = 100_000
_COUNTED: Final = ["repeated_messages", "missed_messages", "server_restarts"]


class ServerScans:
    """Stage from messages to scans, for all sensors of one server."""

    def __init__(
        self,
        geometry: SensorGeometry = USPA44,
        prefix: str = "",
        mountings: Mapping[str, Mounting] = MappingProxyType({}),
    ) -> None:
        """Begin without a message; `prefix` begins the names of sensors in scans, and `mountings` are by these."""
        self._prefix, self._mountings = prefix, mountings
        self._geometry = geometry
        self._decoder = ServerDecoder(geometry)
        self._sensors: dict[str, _ServerSensor] = {}
        self._counted: dict[str, int] = dict.fromkeys(_COUNTED, 0)
        self.begin()

    @property
    def trouble(self) -> str | None:
        """Trouble of the server and its sensors to report to the user, None if there is none."""
        wanted = f"expected {self._geometry.taxel_count}"
        notes = [f"sensor {name} is left out: {what}, {wanted}" for name, what in self._decoder.foreign.items()]
        silent = [name for name, sensor in self._sensors.items() if sensor.silent]
        notes += [f"nothing arrives from sensor {name}: check its cable and its power" for name in silent]
        return "; ".join(notes) or None

    @property
    def usable(self) -> bool:
        """False if the server has sensors, and none of them can be used."""
        return bool(self._sensors) or not self._decoder.foreign

    def begin(self) -> None:
        """Begin again with the server, as after a connection: its count, its clock and its readings are new."""
        self._sequence: int | None = None
        self._clock = DeviceClock(1000, None)
        for sensor in self._sensors.values():
            sensor.begin()

    def feed(self, text: str | bytes, arrival_ns: int) -> list[Scan]:
        """Return the scans that a message closes; `arrival_ns` [ns] is never before that of the message before."""
        message = self._decoder.decode(text)
        if message.sequence is None or not self._in_order(message.sequence):
            return []
        sent_ns = None if message.sent_s is None else self._clock.host_ns(round(message.sent_s * 1e6), arrival_ns)
        scans: list[Scan] = []
        readings = {reading.sensor: reading for reading in message.readings}
        new = [name for name in readings if name not in self._sensors][: MOST_SENSORS - len(self._sensors)]
        for name in [*self._sensors, *new]:
            sensor = self._sensors.get(name)
            if sensor is None:
                own_name = self._prefix + name
                sensor = self._sensors[name] = _ServerSensor(own_name, self._geometry, self._mountings.get(own_name))
            if name in readings:
                age_ns = _age_ns(readings[name], message)
                device_ns = None if sent_ns is None or age_ns is None else sent_ns - age_ns
                scan = sensor.feed(readings[name], arrival_ns, device_ns, old=(age_ns or 0) > SERVER_READING_OLD_NS)
                if scan is not None:
                    scans.append(scan)
            sensor.look(arrival_ns)
        return scans

    def counters(self) -> dict[str, int]:
        """Return the counters of the decoder and of the scans."""
        totals = {name: sum(sensor.counted[name] for sensor in self._sensors.values()) for name in SCANS_COUNTED}
        return self._decoder.counters() | self._counted | totals

    def _in_order(self, sequence: int) -> bool:
        """Return True if the message is a new one, and update the count: another order has only a new server's."""
        last = self._sequence
        if sequence == last:
            self._counted["repeated_messages"] += 1
            return False
        if last is not None and last < sequence <= last + MOST_MISSED:
            self._counted["missed_messages"] += sequence - last - 1
        elif last is not None:
            self._counted["server_restarts"] += 1
            self.begin()
        self._sequence = sequence
        return True


class _ServerSensor:
    """Readings of one sensor, and the taxels renewed since its last scan."""

    def __init__(self, name: str, geometry: SensorGeometry, mounting: Mounting | None) -> None:
        self._mounting = mounting if mounting and (mounting.moves_taxels or mounting.turns_axes) else None
        self.counted: dict[str, int] = dict.fromkeys(SCANS_COUNTED, 0)
        self._geometry = geometry
        self._series = ScanSeries(name, geometry)
        # By the vendor's data sheet, for a server that does not report it.
        self._usual_hz = np.full(geometry.taxel_count, 83.0)
        self._received_ns: int | None = None
        self._acquired_s: float | None = None
        self._acquired_ns = 0
        self._stated_dead = False
        self._belied_ns: int | None = None
        self.silent = False
        self.begin()

    def begin(self) -> None:
        """Forget the readings: after a restart of the server all are new, except one that it still holds."""
        self._counts: NDArray[np.int32] | None = None
        self._come = np.zeros(self._geometry.taxel_count, dtype=bool)
        self._come_ns = np.zeros(self._geometry.taxel_count, dtype=np.int64)

    def look(self, now_ns: int) -> None:
        """Update `silent`: True if no taxel was renewed for too long."""
        self._received_ns = now_ns if self._received_ns is None else self._received_ns
        self.silent = now_ns - self._received_ns > SERVER_READING_OLD_NS

    def feed(self, reading: ServerReading, arrival_ns: int, device_ns: int | None, *, old: bool = False) -> Scan | None:
        """Return the scan that a reading closes, None if it closes no scan; `old` marks one that was old when sent."""
        still = self._stands_still(reading, arrival_ns)
        device_ns = None if still else device_ns
        ups_hz = self._rates_hz(reading, arrival_ns, old=old or still)
        changed = ups_hz > 0 if self._counts is None else (reading.counts != self._counts).any(axis=0)
        changes = int(np.count_nonzero(changed))
        self._counts = reading.counts

        alive = ups_hz > 0
        # In periods, until an unchanged taxel counts as renewed: where taxels come one by one, changed ones come first.
        patience = 0.5 if 2 * changes >= max(1, np.count_nonzero(alive)) else 1.5
        come = changed | (alive & ((arrival_ns - self._come_ns) * ups_hz >= patience * NS_PER_S))
        self._come_ns[come] = arrival_ns
        self._come |= come
        if not self._come.any():
            return None
        self._received_ns = arrival_ns
        waited_for = alive
        if alive.any():
            median_hz = sorted(ups_hz[alive].tolist())[int(np.count_nonzero(alive)) // 2]
            waited_for = ups_hz >= 0.5 * median_hz
        if (waited_for & ~self._come).any():
            return None
        return self._close(np.where(self._come, reading.counts, ABSENT), arrival_ns, device_ns, self._vendor(reading))

    def _rates_hz(self, reading: ServerReading, arrival_ns: int, *, old: bool) -> NDArray[np.float64]:
        """Return the rate of each taxel, in [Hz]; 0 for those reported dead, unless their counts change."""
        measured = reading.ups_hz is not None and any(reading.ups_hz)
        stated_dead = old or (reading.ups_hz is not None and not measured)
        # Compared between two such messages in a row: the first one may bring a last reading.
        if stated_dead and self._stated_dead and self._counts is not None and (reading.counts != self._counts).any():
            self._belied_ns = arrival_ns
        self._stated_dead = stated_dead
        if stated_dead and (self._belied_ns is None or arrival_ns - self._belied_ns > SERVER_READING_OLD_NS):
            return np.zeros_like(self._usual_hz)
        return np.array(reading.ups_hz) if measured else self._usual_hz

    def _stands_still(self, reading: ServerReading, arrival_ns: int) -> bool:
        """Return True if the server has repeated a reading for too long, whatever its age by the server's clock."""
        if reading.acquired_s is None:
            return False
        if reading.acquired_s != self._acquired_s:
            self._acquired_s, self._acquired_ns = reading.acquired_s, arrival_ns
        return arrival_ns - self._acquired_ns > SERVER_READING_OLD_NS

    def _close(
        self, counts: NDArray[np.int32], arrival_ns: int, device_ns: int | None, vendor: VendorReading | None
    ) -> Scan:
        scan = self._series.close(counts.reshape(self._geometry.scan_shape), arrival_ns, device_ns, vendor)
        self._come[:] = False
        count_scan(self.counted, scan)
        return scan if self._mounting is None else self._mounting.place(scan)

    def _vendor(self, reading: ServerReading) -> VendorReading:
        ups_hz = None
        if reading.ups_hz is not None and any(reading.ups_hz):
            ups_hz = np.array(reading.ups_hz, dtype=np.float32).reshape(self._geometry.rows, self._geometry.cols)
        return VendorReading(reading.newtons, reading.temperature_k, ups_hz)


def _age_ns(reading: ServerReading, message: ServerMessage) -> int | None:
    """Return the age of a reading when sent, by the server's clock alone, in [ns]; None if it is impossible."""
    if message.sent_s is None or reading.acquired_s is None:
        return None
    age_s = message.sent_s - reading.acquired_s
    return round(age_s * NS_PER_S) if 0 <= age_s <= 60 else None  # else its clock was set
