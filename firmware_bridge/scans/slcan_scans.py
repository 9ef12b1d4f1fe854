"""Stages from slcan text to scans: decoder, id map and assembler in a row. No I/O, no clock."""

from collections.abc import Iterable
from itertools import pairwise, starmap
from operator import itemgetter
from typing import Final

import numpy as np

from firmware_bridge.can.slcan import (
    LAST_TIMESTAMP_MS,
    PACKED_BYTES,
    STAMPED_BYTES,
    CanFrame,
    PackedFrames,
    SlcanDecoder,
)
from firmware_bridge.scans.can_id_maps import USPA44_MAP, Cycle, ModelMap, Reading, decode, decode_packed
from firmware_bridge.scans.device_clock import DeviceClock, DeviceTime
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.scan_assembler import ScanAssembler
from firmware_bridge.schedule import SCAN_GIVEN_UP_NS

_MS_NS: Final = 1_000_000
FOREIGN: Final = 255  # number of no sensor
BEFORE: Final = -1  # place of frames that came before the present ones


class MixedCycles:
    """Frames of begun cycles, by sensor; the numbers of sensors are those of `names`.

    A whole cycle is decoded at a fifth of the cost of its frames one by one, but on a bus with four sensors frames mix,
    and a read ends within a cycle. So the frames of a cycle that has begun well wait for its end. Only time stamps show
    afterwards that there was no pause in it, so without stamps nothing waits.

    Attributes:
        names: names of all sensors of the model.
        begun: the frames that wait, and the time at which the first of them arrived, in [ns], by number of the sensor.
    """

    def __init__(self, model: ModelMap) -> None:
        """Begin without a frame; cycles are expected in the order of the model's ids."""
        self.names = sorted({sensor for sensor, _ in model.taxels.values()})
        self.begun: dict[int, tuple[bytes, int]] = {}
        self._sensors = np.full(1 << 11, FOREIGN, dtype=np.uint8)
        self._places = np.zeros(1 << 11, dtype=np.uint8)
        self._order = bytes(range(model.geometry.taxel_count))
        for number, name in enumerate(self.names):
            for place, (can_id, _) in enumerate(model.wire_order(name)):
                self._sensors[can_id], self._places[can_id] = number, place

    def part(self, packed: bytes, frame_bytes: int, time_ns: int, *, waits: bool) -> list[tuple[int, bytes]]:
        """Return whole cycles and single frames, each with the place of its last frame in `packed`, and by that order.

        `packed` are frames of `frame_bytes` each, as `SlcanDecoder.cut` packs them, that arrived at `time_ns` [ns].
        With `waits` begun cycles wait; those that came so far are returned if they do not go on.
        """
        # The first two bytes of a frame are its id, and four bits of its length.
        ids = np.frombuffer(packed, dtype=">u2")[:: frame_bytes // 2] >> 4
        sensors = self._sensors[ids]
        # Sorted once: to look for the frames of each sensor takes as long for every sensor as this for all.
        by_sensor = sensors.argsort(kind="stable")
        frames = np.frombuffer(packed, dtype=f"V{frame_bytes}")[by_sensor].tobytes()
        all_places, all_at = self._places[ids[by_sensor]].tobytes(), by_sensor.tolist()
        numbers = sensors[by_sensor].tobytes()
        parted: list[tuple[int, bytes]] = []
        end = 0
        while end < len(numbers):
            first, number = end, numbers[end]
            end += numbers.count(number)
            text, order, at = frames[first * frame_bytes : end * frame_bytes], all_places[first:end], all_at[first:end]
            begun, since_ns = self.begun.pop(number, (b"", time_ns))
            if begun:
                count = len(begun) // frame_bytes
                text, order, at = begun + text, self._order[:count] + order, [BEFORE] * count + at
            start = 0
            while (found := order.find(self._order, start)) >= 0 and number != FOREIGN:
                parted += _singly(text, frame_bytes, at, start, found)
                start = found + len(self._order)
                parted.append((at[start - 1], text[found * frame_bytes : start * frame_bytes]))
                since_ns = time_ns
            last = order.rfind(b"\0", start) if waits and number != FOREIGN else -1
            if last >= 0 and self._order.startswith(order[last:]):
                self.begun[number] = text[last * frame_bytes :], time_ns if last > start else since_ns
            else:
                last = len(order)
            parted += _singly(text, frame_bytes, at, start, last)
        parted.sort(key=itemgetter(0))
        return parted


def _singly(text: bytes, frame_bytes: int, at: list[int], start: int, end: int) -> list[tuple[int, bytes]]:
    return [(at[frame], text[frame * frame_bytes : (frame + 1) * frame_bytes]) for frame in range(start, end)]


class SlcanScans:
    """Stages from slcan text to scans: decoder, id map and assembler.

    Attributes:
        decoder: the first stage, with its counters and the status that the adapter reported.
        clock: the adapter's clock since the last opening.
        can_ids: the standard CAN ids received so far, of any device.
    """

    def __init__(self, model: ModelMap = USPA44_MAP) -> None:
        self._model = model
        self._taxels = model.geometry.taxel_count
        self.clock = _millisecond_clock()
        self._stamped: tuple[int, int] | None = None
        self._device: DeviceTime | None = None
        self._cycles: dict[bytes, Cycle | None] = {}
        self._mixed = MixedCycles(model)
        self.decoder = SlcanDecoder()
        self._assembler = ScanAssembler(model)
        self.can_ids = self._assembler.can_ids
        self._fed_ns = 0

    def feed(self, data: bytes, time_ns: int) -> list[Scan]:
        """Return the scans that close within `data`, which arrived at `time_ns` [ns]."""
        scans: list[Scan] = []
        pending = self.decoder.pending_bytes
        in_two = pending and pending + data.find(b"\r") + 1 == self.decoder.usual_line_bytes
        head_ns = self._fed_ns if in_two else time_ns
        self._fed_ns = time_ns
        for piece in self.decoder.cut(data):
            if head_ns < time_ns:
                if isinstance(piece, PackedFrames) and self._is_joined(piece, head_ns):
                    self._assembler.foreign += 1
                    piece = PackedFrames(piece.data[STAMPED_BYTES:], STAMPED_BYTES)
                head_ns = time_ns
            if isinstance(piece, CanFrame):
                self._give_up(self._mixed.begun, time_ns, scans)
                if not piece.extended:  # bounded: there are at most 2048 of these
                    self.can_ids.add(piece.can_id)
                self._feed_reading(decode(piece, self._model), piece.timestamp_ms, time_ns, scans)
                continue
            self._feed_frames(*piece, time_ns, scans)
        return scans

    def _is_joined(self, frames: PackedFrames, head_ns: int) -> bool:
        """Return True if the head of the first line came at `head_ns`, before its stamp: it has the tail of another."""
        if frames.frame_bytes != STAMPED_BYTES or self._stamped is None or self._device is None:
            return False
        since_ns = _ns_between(self._stamped[0], int.from_bytes(frames.data[PACKED_BYTES:STAMPED_BYTES]))
        # No frame can arrive 5 ms before its stamp, which is the error of stamps and of their offset.
        return head_ns + 5 * _MS_NS < self._device.host_ns + since_ns < head_ns + _MS_NS * LAST_TIMESTAMP_MS // 2

    def begin_anew(self) -> None:
        """Discard open scans, since the link was broken; the adapter's clock may have restarted as well."""
        self.decoder.begin_anew()
        for number, (frames, _) in self._mixed.begun.items():
            self._assembler.abandon(self._mixed.names[number], len(frames) // STAMPED_BYTES)
        self._mixed.begun.clear()
        self._assembler.begin_anew()
        self.clock, self._stamped = _millisecond_clock(), None

    def bytes_until_scan(self) -> int:
        """Return the number of bytes, from 1, that must come at least before a scan can close whole."""
        missing = self._assembler.fewest_missing()
        for frames, _ in self._mixed.begun.values():
            missing = min(missing, self._taxels - len(frames) // STAMPED_BYTES)
        return max(1, missing * self.decoder.usual_line_bytes - self.decoder.pending_bytes)

    def counters(self) -> dict[str, int]:
        """Return the counters of all stages; foreign: frames of no taxel of this model, or joined of two."""
        counters = self.decoder.counters() | self._assembler.counters()
        for frames, _ in self._mixed.begun.values():
            counters["readings"] += len(frames) // STAMPED_BYTES
        return counters

    def _feed_frames(self, packed: bytes, frame_bytes: int, time_ns: int, scans: list[Scan]) -> None:
        """Feed a run of usual frames: the cycles of a sensor that come in one piece, and then the others, parted."""
        start, cycle_bytes = 0, self._taxels * frame_bytes
        waits = frame_bytes == STAMPED_BYTES and not self.clock.dropped
        if not waits:
            self._give_up(self._mixed.begun, time_ns, scans)
        mixed = bool(self._mixed.begun)
        while not mixed and start + cycle_bytes <= len(packed) and self._one_sensor(packed, start, frame_bytes):
            scan = self._feed_cycle(packed[start : start + cycle_bytes], frame_bytes, time_ns)
            if scan is None:
                break
            scans.append(scan)
            start += cycle_bytes
        if start == len(packed):
            return
        for place, frames in self._mixed.part(packed[start:], frame_bytes, time_ns, waits=waits):
            if len(frames) > frame_bytes:
                scan = self._feed_cycle(frames, frame_bytes, time_ns)
                if scan is not None:
                    scans.append(scan)
                    continue
            self._feed_singly(frames, frame_bytes, time_ns, scans, late=place == BEFORE or len(frames) > frame_bytes)
        if self._mixed.begun:
            self._device_time(int.from_bytes(packed[-2:]), time_ns)  # the newest stamp, which was read soonest
        for number, (_, since_ns) in list(self._mixed.begun.items()):
            # A scan that is open would end by the first of them.
            if time_ns - since_ns > SCAN_GIVEN_UP_NS or self._assembler.is_open(self._mixed.names[number]):
                self._give_up([number], time_ns, scans)

    def _give_up(self, begun: Iterable[int], time_ns: int, scans: list[Scan]) -> None:
        """Feed the frames of begun cycles one by one."""
        for number in tuple(begun):
            self._feed_singly(self._mixed.begun.pop(number)[0], STAMPED_BYTES, time_ns, scans, late=True)

    def _feed_singly(self, packed: bytes, frame_bytes: int, time_ns: int, scans: list[Scan], *, late: bool) -> None:
        """Feed frames one by one; `late` if others that came after them were fed before."""
        before_ms = stamp_ms = None
        for start in range(0, len(packed), frame_bytes):
            end = start + frame_bytes
            self.can_ids.add(packed[start] << 4 | packed[start + 1] >> 4)
            if frame_bytes == STAMPED_BYTES:
                before_ms, stamp_ms = stamp_ms, int.from_bytes(packed[end - 2 : end])
                if late and before_ms is not None:
                    self.clock.follow_order((stamp_ms - before_ms) * _MS_NS)
            self._feed_reading(decode_packed(packed, start, self._model), stamp_ms, time_ns, scans, late=late)

    def _one_sensor(self, packed: bytes, start: int, frame_bytes: int) -> bool:
        """Return whether two frames in a row are of one sensor; where scans of several mix, no cycle begins."""
        taxels = self._model.taxels
        first, second = (taxels.get(packed[at] << 4 | packed[at + 1] >> 4) for at in (start, start + frame_bytes))
        return first is not None and second is not None and first[0] == second[0]

    def _feed_reading(
        self, reading: Reading | None, stamp_ms: int | None, time_ns: int, scans: list[Scan], *, late: bool = False
    ) -> None:
        if reading is None:
            self._assembler.foreign += 1
            return
        device = None
        if stamp_ms is not None and not self.clock.dropped:
            device = self._earlier_time(stamp_ms, time_ns) if late else self._device_time(stamp_ms, time_ns)
        scans += self._assembler.feed(reading, time_ns, device)

    def _feed_cycle(self, packed: bytes, frame_bytes: int, time_ns: int) -> Scan | None:
        """Return the scan of a sensor's whole cycle; None if this is no whole cycle, or a scan is still open."""
        can_ids = packed[::frame_bytes] + packed[1::frame_bytes]
        if can_ids not in self._cycles:
            if len(self._cycles) >= 1024:  # frames of two sensors mix in many orders
                self._cycles.clear()
            high, low = can_ids[: len(can_ids) // 2], can_ids[len(can_ids) // 2 :]
            order = [h << 4 | b >> 4 for h, b in zip(high, low, strict=True)]
            self.can_ids.update(order)
            self._cycles[can_ids] = self._model.cycle(order)
        cycle = self._cycles[can_ids]
        # Checked before the clock gets the last stamp: earlier ones after it would count as a clock set back.
        arrival_ns = time_ns if frame_bytes == PACKED_BYTES or self.clock.dropped else None
        longest_ns = 0 if cycle is None else self._assembler.longest_cycle_ns(cycle, arrival_ns)
        if cycle is None or not longest_ns:
            return None
        if arrival_ns is not None:
            return self._assembler.feed_cycle(cycle, packed, time_ns)
        first_ms, last_ms = int.from_bytes(packed[frame_bytes - 2 : frame_bytes]), int.from_bytes(packed[-2:])
        # Half a cycle from before a pause and half from after it look like a whole one.
        if _ns_between(first_ms, last_ms) > longest_ns:
            ends = range(frame_bytes, len(packed) + 1, frame_bytes)
            stamps_ms = [int.from_bytes(packed[end - 2 : end]) for end in ends]
            if max(starmap(_ns_between, pairwise(stamps_ms))) > longest_ns:
                return None
        return self._assembler.feed_cycle(cycle, packed, time_ns, self._device_time(last_ms, time_ns))

    def _earlier_time(self, stamp_ms: int, time_ns: int) -> DeviceTime | None:
        """Return the time of a frame that came before others whose times were taken."""
        if self._stamped is None or self._device is None:
            return self._device_time(stamp_ms, time_ns)
        back_ns = _ns_between(stamp_ms, self._stamped[0])
        if back_ns > SCAN_GIVEN_UP_NS:  # it came after them, as none waits for so long
            return self._device_time(stamp_ms, time_ns)
        return DeviceTime(self._device.host_ns - back_ns, self._device.own_ns - back_ns)

    def _device_time(self, stamp_ms: int, time_ns: int) -> DeviceTime | None:
        # Sixteen frames that come together have about three different stamps: a scan takes 2 ms on the bus.
        if (stamp_ms, time_ns) != self._stamped:
            self._stamped = stamp_ms, time_ns
            self._device = self.clock.at(stamp_ms, time_ns)
        return self._device


def _ns_between(earlier_ms: int, later_ms: int) -> int:
    """Return the time between two stamps, in [ns]."""
    return (later_ms - earlier_ms) % (LAST_TIMESTAMP_MS + 1) * _MS_NS


def _millisecond_clock() -> DeviceClock:
    return DeviceClock(tick_ns=1_000_000, wrap_ticks=LAST_TIMESTAMP_MS + 1)
