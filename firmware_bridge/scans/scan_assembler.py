"""Assembly of the frames on a wire to scans. No I/O, no clock.

A scan closes when every taxel has come, or the last one of the sensor's cycle, or when the next reading belongs to
another cycle: after a pause, or where the order of the taxels has wrapped round (`wire_cycle`). Then it is torn.
Readings of no certain cycle are left out and counted (`resynchronised`): the rest of the cycle into which the link was
opened, and fragments of fewer than half of the taxels that no pause separates.

Without time stamps a whole cycle that ends late waits for the next ones to show whether a cycle was lost: with sixteen
frames lost between them, its halves may be of two. Then it is left out, too. Limit: nothing closes while no reading
comes, so half a scan at the end of a stream is never returned.

Frames that were read together are taken together: those of a sensor that go on in its order, without a pause, join its
open scan at once, also where the frames of several sensors mix.
"""

import struct
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from operator import itemgetter
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.pad_geometry import SensorGeometry
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap
from firmware_bridge.scans.device_clock import DeviceTime
from firmware_bridge.scans.scan import ABSENT, SCANS_COUNTED, Scan, ScanSeries, count_scan
from firmware_bridge.scans.wire_cycle import LONGEST_PAUSE_NS, WireCycle

READING_BYTES: Final = 8  # bytes of the data of a reading, of which the first and the last are unused

# Besides scans: the same frame twice in a row; readings of sensors that do not exist (yet), of scans that a broken link
# left open, and of cycles whose beginning or end was uncertain.
_COUNTED: Final = (*SCANS_COUNTED, "duplicates", "unconfirmed", "abandoned", "resynchronised")
_unpack_counts = struct.Struct(">xHHHx").unpack


def key(can_id: int) -> int:
    """Return the beginning of a reading's frame as one number: twelve bits of id, and four of its length."""
    return can_id << 4 | READING_BYTES


class Readings(NamedTuple):
    """Readings that came together, one place of each column for each: the `key` of its id, and its counts."""

    keys: tuple[int, ...]
    x: tuple[int, ...]
    y: tuple[int, ...]
    z: tuple[int, ...]

    def taken(self, places: Sequence[int]) -> "Readings":
        """Return those at some places."""
        return Readings(*(tuple(column[place] for place in places) for column in self))


class ScanAssembler:
    """Assembler of readings into the scans of their sensors.

    A sensor exists from its first whole scan on, or from its second in a row with half of the taxels or more: bits that
    flip in ids must not create a sensor. (Half, because the wrong id map shows half of the taxels.)
    """

    def __init__(self, model: ModelMap = USPA44_MAP) -> None:
        self.foreign = 0  # number of frames that are of no taxel of this model
        self._model = model
        self._places = {key(can_id): place for can_id, place in model.taxels.items()}
        self._keys = set[int]()  # bounded: there are at most 2048 of standard ids
        self._runs = lru_cache(maxsize=32)(self._find_runs)  # those of whole cycles come again and again
        self._readings = 0
        self._sensors: dict[str, _Sensor] = {}
        self._speaking: list[_Sensor] = []  # those of which the newest readings are

    @property
    def can_ids(self) -> frozenset[int]:
        """Standard CAN ids received so far, of any device."""
        return frozenset(frame_key >> 4 for frame_key in self._keys)

    def feed_frame(self, frame: CanFrame, time_ns: int, device: DeviceTime | None = None) -> list[Scan]:
        """Return the scans that a frame closes, whatever it holds; `device` is when it was on the bus, by its stamp."""
        if frame.extended or frame.remote or len(frame.data) != READING_BYTES:
            self.foreign += 1
            if not frame.extended:
                self._keys.add(key(frame.can_id))
            return []
        readings = Readings((key(frame.can_id),), *zip(_unpack_counts(frame.data)))
        if device is None:
            return self.feed(readings, time_ns)
        return self.feed(readings, time_ns, [device.own_ns], device.host_ns - device.own_ns)

    def feed(
        self, readings: Readings, time_ns: int, own_ns: Sequence[int] | None = None, offset_ns: int = 0
    ) -> list[Scan]:
        """Return the scans that readings close, which arrived together at `time_ns` in [ns], in their order on the bus.

        `own_ns` are their time stamps by the device's clock, and `offset_ns` is that from it to the host's, in [ns].
        """
        runs, keys = self._runs(readings.keys), len(readings.keys)
        self._speaking = [self._sensor(name) for name in runs]
        closed: list[tuple[int, Scan]] = []
        sorted_out = 0
        for sensor, (numbers, taxels) in zip(self._speaking, runs.values(), strict=True):
            sorted_out += len(numbers)
            mine, times_ns = readings, own_ns
            if len(numbers) < keys:
                mine = readings.taken(numbers)
                times_ns = None if own_ns is None else [own_ns[number] for number in numbers]
            scans = sensor.feed(mine, taxels, time_ns, times_ns, offset_ns)
            closed += [(numbers[at], scan) for at, scan in scans]
        self._readings += sorted_out
        self.foreign += keys - sorted_out
        if len(runs) > 1:
            closed.sort(key=itemgetter(0))
        return [scan for _, scan in closed]

    def _find_runs(self, keys: tuple[int, ...]) -> dict[str, tuple[list[int], list[int]]]:
        """Return the numbers and the taxels of each sensor's readings among those with these keys."""
        self._keys.update(keys)
        runs: dict[str, tuple[list[int], list[int]]] = {}
        for number, frame_key in enumerate(keys):
            name, taxel = self._places.get(frame_key, ("", 0))
            if name:
                numbers, taxels = runs.setdefault(name, ([], []))
                numbers.append(number)
                taxels.append(taxel)
        return runs

    def _sensor(self, name: str) -> "_Sensor":
        sensor = self._sensors.get(name)
        if sensor is None:
            order = [taxel for _, taxel in self._model.wire_order(name)]
            sensor = self._sensors[name] = _Sensor(name, self._model.geometry, order)
        return sensor

    def begin_anew(self) -> None:
        """Discard open scans: the link broke, and the next readings do not belong to them."""
        for sensor in self._sensors.values():
            sensor.begin_anew()

    def fewest_missing(self) -> int:
        """Return the number of readings that must come at least before a sensor that sends can close a whole scan."""
        counts = [sensor.missing for sensor in self._speaking if sensor.confirmed]
        if counts:
            return min(counts)
        # One as well while the order of a sensor is still to be learnt: no read may sleep through its pauses.
        learnt = all(sensor.wire.order for sensor in self._sensors.values())
        return self._model.geometry.taxel_count if learnt else 1

    def counters(self) -> dict[str, int]:
        """Return the counters, summed over all sensors."""
        totals = {name: sum(sensor.counts[name] for sensor in self._sensors.values()) for name in _COUNTED}
        return {"foreign": self.foreign, "readings": self._readings} | totals


class _Sensor:
    """Open scan of one sensor, and its counters."""

    def __init__(self, name: str, geometry: SensorGeometry, order: list[int]) -> None:
        self.confirmed = False
        self.wire = WireCycle(order)
        self.counts: dict[str, int] = dict.fromkeys(_COUNTED, 0)
        self._taxel_count, self._scan_shape = geometry.taxel_count, geometry.scan_shape
        self._last_place = geometry.taxel_count - 1
        self._series = ScanSeries(name, geometry)
        self._held: list[tuple[NDArray[np.int32], int, int | None, int]] = []
        self._begins_known = self._half_before = False
        self._newest_ns = self._offset_ns = 0
        self._last: tuple[int, ...] | None = None
        self._own_ns: int | None = None
        self._taxels: list[int] = []
        self._columns: tuple[list[int], list[int], list[int]] = [], [], []
        self._place = -1

    def begin_anew(self) -> None:
        held = sum(self._taxel_count - missing for *_, missing in self._held)
        self.counts["abandoned"] += len(self._taxels) + held
        self._held.clear()
        self._taxels, self._columns, self._place, self._begins_known = [], ([], [], []), -1, False
        self._last = self._own_ns = None
        self.wire.begin_anew()

    @property
    def missing(self) -> int:
        """Number of readings until the open scan closes; 1 while the order is not learnt yet."""
        return self._last_place - self._place if self.wire.order else 1

    def feed(
        self, readings: Readings, taxels: list[int], time_ns: int, own_ns: Sequence[int] | None, offset_ns: int
    ) -> list[tuple[int, Scan]]:
        """Return the scans that these readings of its taxels close, each with the place of the one that closed it."""
        if own_ns is None and self._own_ns is not None:
            self.begin_anew()  # time stamps were dropped, and arrivals are on another clock
        closed: list[tuple[int, Scan]] = []
        at = 0
        while at < len(taxels):
            # The link causes the same frame twice in a row. Closing on it would tear a scan, and skipping it loses
            # nothing.
            if self._last == (taxels[at], readings.x[at], readings.y[at], readings.z[at]):
                self.counts["duplicates"] += 1
                at += 1
                continue
            end = self._end_of_run(taxels, at, time_ns, own_ns)
            if end == at:
                end = at + 1
                gap_ns = self._gap_ns(time_ns, own_ns, at)
                closed += [(at, scan) for scan in self._judge(taxels[at], gap_ns, stamped=own_ns is not None)]
            elif not self._taxels:
                self._begins_known = True  # a run that opens a scan begins at the first place
            self._taxels += taxels[at:end]
            x, y, z = self._columns
            x += readings.x[at:end]
            y += readings.y[at:end]
            z += readings.z[at:end]
            self._last = taxels[end - 1], x[-1], y[-1], z[-1]
            place = self.wire.places[taxels[end - 1]]
            self._place = max(self._place, place)
            self._own_ns = None if own_ns is None else own_ns[end - 1]
            self._newest_ns, self._offset_ns = time_ns, offset_ns
            at = end
            if place == self._last_place or len(self._taxels) > self._last_place:
                closed += [(end - 1, scan) for scan in self._close(by_pause=False)]
        return closed

    def _gap_ns(self, time_ns: int, own_ns: Sequence[int] | None, at: int) -> int:
        """Return the time since the newest reading; by the device's times, if any, a late read splits no scan."""
        if own_ns is None or self._own_ns is None:
            return time_ns - self._newest_ns
        return own_ns[at] - self._own_ns

    def _end_of_run(self, taxels: list[int], at: int, time_ns: int, own_ns: Sequence[int] | None) -> int:
        """Return the end of the readings that surely go on in the open scan, or are a new one's beginning."""
        wire = self.wire
        if wire.gaps_ns is not None:
            return at  # its pauses are still to be learnt
        ahead = wire.order[self._place + 1 :]
        run = tuple(taxels[at : at + len(ahead)])
        if not run or run != ahead[: len(run)]:
            return at
        end = at + len(run)
        if self._taxels and self._gap_ns(time_ns, own_ns, at) > wire.pause_ns:
            return at
        if own_ns is None or own_ns[end - 1] - own_ns[at] <= wire.pause_ns:
            return end
        # Half a cycle from before a pause and half from after it look like a whole one.
        longest_ns = max(after - before for before, after in pairwise(own_ns[at:end]))
        return end if longest_ns <= wire.pause_ns else at

    def _judge(self, taxel: int, gap_ns: int, *, stamped: bool) -> list[Scan]:
        """Return the scans that close before a reading, since it belongs to another cycle; its place is found."""
        wire, closed = self.wire, list[Scan]()
        paused = gap_ns > wire.pause_ns
        # Late reads would look like pauses, so arrivals count only while the order is to be learnt.
        if wire.gaps_ns is not None and (stamped or not wire.order):
            wire.follow_gap(gap_ns, taxel)
        place = wire.places[taxel]
        if (paused or place != self._place + 1) and self._taxels:
            paced = not stamped and wire.has_pace and gap_ns <= LONGEST_PAUSE_NS
            if not wire.goes_on(self._place, place, came=taxel in self._taxels, paused=paused, paced=paced):
                closed = self._close(by_pause=paused)
        if not self._taxels:
            # A cycle begins at the first place of the order, after another's last, or, without an order, after a pause.
            self._begins_known = self._begins_known or wire.places[taxel] == 0 if wire.order else paused
        return closed

    def _close(self, *, by_pause: bool) -> list[Scan]:
        taxels, columns = self._taxels, self._columns
        self._taxels, self._columns, self._place = [], ([], [], []), -1
        begins_known, self._begins_known = self._begins_known, True
        count, come = self._taxel_count, len(taxels)
        half = 2 * come >= count
        if come == count and begins_known:
            self.wire.close_whole(taxels)
            self.confirmed = self.confirmed or bool(self.wire.order)
        elif begins_known and not (half or by_pause):
            self.wire.doubt()
            if self.confirmed:
                self.counts["resynchronised"] += come
                return []
        if not begins_known or not self.wire.order:
            joined = bool(self.wire.order)
            self.counts["resynchronised" if self.confirmed or joined else "unconfirmed"] += come
            return []
        self.confirmed, self._half_before = self.confirmed or (half and self._half_before), half
        if not self.confirmed:
            self.counts["unconfirmed"] += come
            return []
        on_pace = None
        if half:
            now_ns = self._newest_ns if self._own_ns is None else self._own_ns
            on_pace = self.wire.count(now_ns, ended=come == count or taxels[-1] == self.wire.order[-1])
        counts = self._counts_of(taxels, columns)
        device_ns = None if self._own_ns is None else self._own_ns + self._offset_ns
        self._held.append((counts, self._newest_ns, device_ns, count - come))
        shows_pauses = self._own_ns is not None and not self.wire.in_pieces
        if not shows_pauses and on_pace is None and (come == count or len(self._held) > 1):
            return []
        held, self._held = self._held, []
        if not (shows_pauses or on_pace):  # as many frames may be lost as make the parts of two cycles fit
            self.counts["resynchronised"] += count * sum(missing == 0 for *_, missing in held)
            held = [closed for closed in held if closed[-1]]
        scans = [self._series.close(*closed[:3], whole=closed[3] == 0) for closed in held]
        for scan in scans:
            count_scan(self.counts, scan)
        return scans

    def _counts_of(self, taxels: Sequence[int], columns: Sequence[Sequence[int]]) -> NDArray[np.int32]:
        """Return counts (3, rows, cols) of readings in their order of arrival, ABSENT where no reading came."""
        count = self._taxel_count
        placed = [ABSENT] * (3 * count)
        for taxel, x, y, z in zip(taxels, *columns, strict=True):
            placed[taxel], placed[taxel + count], placed[taxel + 2 * count] = x, y, z
        return np.array(placed, dtype=np.int32).reshape(self._scan_shape)  # for so few numbers the fastest way
