"""Assembly of taxel readings to scans. No I/O, no clock.

The wire has no end-of-scan marker. A scan closes when every taxel has come, or the last one of the sensor's cycle, or
when the next reading belongs to another cycle: after a pause, or where the order of the taxels has wrapped round
(`wire_cycle`). Then it is torn. Readings of no certain cycle are left out and counted (`resynchronised`): the rest of
the cycle into which the link was opened, and fragments of fewer than half of the taxels that no pause separates.

Without time stamps a whole cycle that ends late waits for the next ones to show whether a cycle was lost: with sixteen
frames lost between them, its halves may be of two. Then it is left out, too. Limit: nothing closes while no reading
comes, so half a scan at the end of a stream is never returned.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.pad_geometry import SensorGeometry
from firmware_bridge.scans.can_id_maps import USPA44_MAP, Cycle, ModelMap, Reading, decode
from firmware_bridge.scans.device_clock import DeviceTime
from firmware_bridge.scans.scan import ABSENT, Scan, ScanSeries
from firmware_bridge.scans.wire_cycle import LONGEST_PAUSE_NS, SHORTEST_PAUSE_NS, WireCycle
from firmware_bridge.schedule import SCAN_GIVEN_UP_NS

_COUNTED: Final[tuple[str, ...]] = (
    "scans",
    "torn_wire",
    "torn_source",
    "repeated",
    "missing_taxels",
    "duplicates",
    "unconfirmed",
    "abandoned",
    "resynchronised",
)


class ScanAssembler:
    """Assembler of readings into the scans of their sensors.

    A sensor exists from its first whole scan on, or from its second in a row with half of the taxels or more: bits that
    flip in ids must not create a sensor. (Half, because the wrong id map shows half of the taxels.)

    Memory: one open scan per sensor name; a ModelMap has at most 16 names.

    Attributes:
        can_ids: the standard CAN ids received so far, of any device.
        foreign: number of frames that are of no taxel of this model.
    """

    def __init__(self, model: ModelMap = USPA44_MAP) -> None:
        self.can_ids: set[int] = set()
        self.foreign = 0
        self._model = model
        self._geometry = model.geometry
        self._taxels = model.geometry.taxel_count
        self._readings = 0
        self._newest_ns = 0
        self._sensors: dict[str, _Sensor] = {}

    def feed_frame(self, frame: CanFrame, time_ns: int, device: DeviceTime | None = None) -> list[Scan]:
        """Return the scans that a frame closes, whatever it holds; otherwise as `feed`."""
        if not frame.extended:  # bounded: there are at most 2048 of these
            self.can_ids.add(frame.can_id)
        reading = decode(frame, self._model)
        if reading is None:
            self.foreign += 1
            return []
        return self.feed(reading, time_ns, device)

    def feed(self, reading: Reading, time_ns: int, device: DeviceTime | None = None) -> list[Scan]:
        """Return the scans that this reading closes; `device` is when it was on the bus, by its time stamp."""
        self._readings += 1
        self._newest_ns = time_ns
        return self._sensor(reading.sensor).feed(reading, time_ns, device)

    def _sensor(self, name: str) -> "_Sensor":
        sensor = self._sensors.get(name)
        if sensor is None:
            order = [taxel for _, taxel in self._model.wire_order(name)]
            sensor = self._sensors[name] = _Sensor(name, self._geometry, order)
        return sensor

    def longest_cycle_ns(self, cycle: Cycle, arrival_ns: int | None = None) -> int:
        """Return the longest pause, in [ns], in a cycle that may be fed as one; 0: feed its readings one by one.

        `arrival_ns` is given for a cycle without time stamps.
        """
        sensor = self._sensors.get(cycle.sensor)
        if sensor is None or not sensor.awaits(cycle):
            return 0
        if sensor.wire.in_pieces if arrival_ns is None else sensor.doubts(arrival_ns):
            return 0
        return sensor.wire.pause_ns if sensor.wire.gaps_ns is None else SHORTEST_PAUSE_NS

    def feed_cycle(self, cycle: Cycle, packed: bytes, time_ns: int, device: DeviceTime | None = None) -> Scan:
        """Return the scan of a cycle that came as one, where `longest_cycle_ns` allows it.

        Its frames are packed as `SlcanDecoder.cut` does; `device` is when the last of them was on the bus.
        """
        self._readings += len(cycle.taxels)
        self._newest_ns = time_ns
        return self._sensors[cycle.sensor].feed_cycle(cycle, packed, time_ns, device)

    def is_open(self, sensor: str) -> bool:
        """Return True if a scan of the sensor is open."""
        return sensor in self._sensors and self._sensors[sensor].open

    def begin_anew(self) -> None:
        """Discard open scans: the link broke, and the next readings do not belong to them."""
        for sensor in self._sensors.values():
            sensor.begin_anew()

    def abandon(self, sensor: str, readings: int) -> None:
        """Count readings of a sensor that were not fed when the link broke; no scan closes by them."""
        self._readings += readings
        self._sensor(sensor).counts["abandoned"] += readings

    def fewest_missing(self) -> int:
        """Return the number of readings that must come at least before a scan can close whole.

        A sensor that a flipped bit created, or that fell silent in mid-scan, is left out: it closes no scan.
        """
        fewest = self._taxels + 1
        for sensor in self._sensors.values():
            missing = sensor.missing(self._newest_ns)
            if missing is not None and missing < fewest:
                fewest = missing
        if fewest <= self._taxels:
            return fewest
        # One as well while the order of a sensor is still to be learnt: no read may sleep through its pauses.
        return 1 if any(not sensor.wire.order for sensor in self._sensors.values()) else self._taxels

    def counters(self) -> dict[str, int]:
        """Return the counters, summed over all sensors.

        foreign: frames of no taxel; readings; duplicates: the same frame twice in a row; unconfirmed: readings of
        sensors that do not exist (yet); abandoned: of scans that a broken link left open; resynchronised: left out,
        since the beginning or end of their cycle was uncertain; scans; torn_wire: taxels missing; torn_source:
        complete, but only partly renewed; repeated: nothing renewed; missing_taxels.
        """
        totals = dict.fromkeys(_COUNTED, 0)
        for sensor in self._sensors.values():
            for name, count in sensor.counts.items():
                totals[name] += count
        return {"foreign": self.foreign, "readings": self._readings} | totals


class _Sensor:
    """Open scan of one sensor, and its counters."""

    def __init__(self, name: str, geometry: SensorGeometry, order: list[int]) -> None:
        self.confirmed = False
        self.wire = WireCycle(order)
        self._geometry = geometry
        self._scan_shape = geometry.scan_shape
        self._series = ScanSeries(name, geometry)
        self._last: Reading | None = None
        self._last_cycle: tuple[Cycle, NDArray[np.int32]] | None = None
        self._taxels: dict[int, Reading] = {}
        self._place = -1
        self._last_place = geometry.taxel_count - 1
        self._begins_known = False
        self._half_before = False
        self._newest_ns = 0
        self._device: DeviceTime | None = None
        self._held: list[tuple[NDArray[np.int32], int, int | None, int]] = []
        self.counts: dict[str, int] = dict.fromkeys(_COUNTED, 0)

    def begin_anew(self) -> None:
        held = sum(self._geometry.taxel_count - missing for *_, missing in self._held)
        self.counts["abandoned"] += len(self._taxels) + held
        self._held.clear()
        self._taxels, self._place, self._begins_known = {}, -1, False
        self._last = self._last_cycle = self._device = None
        self.wire.begin_anew()

    @property
    def open(self) -> bool:
        return bool(self._taxels)

    def missing(self, now_ns: int) -> int | None:
        """Return the number of readings until the open scan closes; 1 while the order is not learnt yet.

        None: the sensor does not exist, or has left its open scan unfinished.
        """
        if not self.confirmed or (self._taxels and now_ns - self._opened_ns > SCAN_GIVEN_UP_NS):
            return None
        return self._last_place - self._place if self.wire.order else 1

    def awaits(self, cycle: Cycle) -> bool:
        """Return True if no scan is open, and the taxels of this cycle come in the sensor's order."""
        if self._taxels:
            return False
        if cycle is not self.wire.awaited:
            if cycle.taxels != self.wire.order:
                return False
            self.wire.awaited = cycle
        return True

    def doubts(self, arrival_ns: int) -> bool:
        """Return True if a cycle without stamps that ends now is the first, or this or one before may be of two."""
        return self._device is not None or bool(self._held) or self.wire.late(arrival_ns)

    def feed_cycle(self, cycle: Cycle, packed: bytes, time_ns: int, device: DeviceTime | None) -> Scan:
        counts = cycle.counts(packed)
        self._last_cycle = cycle, counts
        self.confirmed = self._begins_known = True
        self.wire.doubts = 0
        self._newest_ns, self._device = time_ns, device
        counts = counts.reshape(self._scan_shape)
        if device is None:
            self.wire.count(time_ns)
            return self._count(self._series.close(counts, time_ns, whole=True), missing=0)
        self.wire.count(device.own_ns)
        return self._count(self._series.close(counts, time_ns, device.host_ns, whole=True), missing=0)

    def feed(self, reading: Reading, time_ns: int, device: DeviceTime | None) -> list[Scan]:
        if self._last_cycle is not None:
            self._recall(*self._last_cycle)
        if device is None and self._device is not None:
            self.begin_anew()  # time stamps were dropped, and arrivals are on another clock
        # The link causes the same frame twice in a row. Closing on it would tear a scan, and skipping it loses nothing.
        if reading == self._last:
            self.counts["duplicates"] += 1
            return []
        self._last = reading
        wire, taxel = self.wire, reading.taxel
        if device is None or self._device is None:
            gap_ns = time_ns - self._newest_ns
        else:  # by the device's times, a late read splits no scan
            gap_ns = device.own_ns - self._device.own_ns
        paused = gap_ns > wire.pause_ns
        # Late reads would look like pauses, so arrivals count only while the order is to be learnt.
        if wire.gaps_ns is not None and (device is not None or not wire.order):
            wire.follow_gap(gap_ns, taxel)
        closed: list[Scan] = []
        place = wire.places[taxel]
        if (paused or place != self._place + 1) and self._taxels:
            paced = device is None and wire.has_pace and gap_ns <= LONGEST_PAUSE_NS
            if not wire.goes_on(self._place, place, came=taxel in self._taxels, paused=paused, paced=paced):
                closed = self._close(by_pause=paused)
                place = wire.places[taxel]
        if not self._taxels:
            self._opened_ns = time_ns
            # A cycle begins at the first place of the order, after another's last, or, without an order, after a pause.
            self._begins_known = self._begins_known or place == 0 if wire.order else paused
        self._taxels[taxel] = reading
        if place > self._place:
            self._place = place
        self._newest_ns, self._device = time_ns, device
        if place == self._last_place or len(self._taxels) > self._last_place:
            closed += self._close(by_pause=False)
        return closed

    def _recall(self, cycle: Cycle, counts: NDArray[np.int32]) -> None:
        """Restore the last reading of a cycle that was fed as one."""
        last = cycle.taxels[-1]
        self._last, self._last_cycle = Reading(cycle.sensor, last, *counts.reshape(3, -1)[:, last].tolist()), None

    def _close(self, *, by_pause: bool) -> list[Scan]:
        taxels, self._taxels, self._place = self._taxels, {}, -1
        known, self._begins_known = self._begins_known, True
        count, come = self._geometry.taxel_count, len(taxels)
        half = 2 * come >= count
        if come == count and known:
            self.wire.close_whole(tuple(taxels))
            self.confirmed = self.confirmed or bool(self.wire.order)
        elif known and not (half or by_pause):
            self.wire.doubt()
            if self.confirmed:
                self.counts["resynchronised"] += come
                return []
        if not known or not self.wire.order:
            joined = bool(self.wire.order)
            self.counts["resynchronised" if self.confirmed or joined else "unconfirmed"] += come
            return []
        self.confirmed, self._half_before = self.confirmed or (half and self._half_before), half
        if not self.confirmed:
            self.counts["unconfirmed"] += come
            return []
        on_pace = None
        if half:
            now_ns = self._newest_ns if self._device is None else self._device.own_ns
            on_pace = self.wire.count(now_ns, ended=come == count or next(reversed(taxels)) == self.wire.order[-1])
        axes_last = np.full((count, 3), ABSENT, dtype=np.int32)
        axes_last[list(taxels)] = np.array([(reading.x, reading.y, reading.z) for reading in taxels.values()])
        counts = np.ascontiguousarray(axes_last.T).reshape(self._geometry.scan_shape)
        device_ns = None if self._device is None else self._device.host_ns
        self._held.append((counts, self._newest_ns, device_ns, count - come))
        shows_pauses = self._device is not None and not self.wire.in_pieces
        if not shows_pauses and on_pace is None and (come == count or len(self._held) > 1):
            return []
        held, self._held = self._held, []
        if not (shows_pauses or on_pace):  # as many frames may be lost as make the parts of two cycles fit
            self.counts["resynchronised"] += count * sum(missing == 0 for *_, missing in held)
            held = [one for one in held if one[-1]]
        return [self._count(self._series.close(*closed), missing) for *closed, missing in held]

    def _count(self, scan: Scan, missing: int) -> Scan:
        self.counts["scans"] += 1
        if not scan.whole:
            self.counts["missing_taxels"] += missing
            self.counts["torn_wire"] += missing > 0
            self.counts["repeated"] += scan.repeated
            self.counts["torn_source"] += missing == 0 and scan.torn
        return scan
