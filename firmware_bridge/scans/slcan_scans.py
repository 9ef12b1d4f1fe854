"""Stages from slcan text to scans: decoder, id map and assembler in a row. No I/O, no clock."""

from typing import Final

from firmware_bridge.can.slcan import LAST_TIMESTAMP_MS, PACKED_BYTES, CanFrame, SlcanDecoder
from firmware_bridge.scans.can_id_maps import USPA44_MAP, Cycle, ModelMap, Reading, decode, decode_packed
from firmware_bridge.scans.device_clock import DeviceClock, DeviceTime
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.scan_assembler import ScanAssembler

_MOST_ORDERS: Final = 1024
_MS_NS: Final = 1_000_000


class SlcanScans:
    """Stages from slcan text to scans: decoder, id map and assembler.

    Attributes:
        decoder: the first stage, with its counters and the status that the adapter reported.
        can_ids: the standard CAN ids received so far, of any device.
    """

    def __init__(self, model: ModelMap = USPA44_MAP) -> None:
        self._model = model
        self._taxels = model.geometry.taxel_count
        self._clock = _millisecond_clock()
        self._stamped: tuple[int, int] | None = None
        self._device = DeviceTime(0, 0)
        self._cycles: dict[bytes, Cycle | None] = {}
        self.decoder = SlcanDecoder()
        self._assembler = ScanAssembler(model)
        self._foreign = 0
        self.can_ids: set[int] = set()

    def feed(self, data: bytes, time_ns: int) -> list[Scan]:
        """Return the scans that close within `data`, which arrived at `time_ns` [ns]."""
        scans: list[Scan] = []
        for piece in self.decoder.cut(data):
            if isinstance(piece, CanFrame):
                if not piece.extended:  # bounded: there are at most 2048 of these
                    self.can_ids.add(piece.can_id)
                self._feed_reading(decode(piece, self._model), piece.timestamp_ms, time_ns, scans)
                continue
            packed, frame_bytes = piece
            cycle_bytes = self._taxels * frame_bytes
            start = 0
            while start < len(packed):
                end = start + cycle_bytes
                scan = self._feed_cycle(packed[start:end], frame_bytes, time_ns) if end <= len(packed) else None
                if scan is not None:
                    scans.append(scan)
                else:
                    end = start + frame_bytes
                    self.can_ids.add(packed[start] << 4 | packed[start + 1] >> 4)
                    stamp_ms = int.from_bytes(packed[end - 2 : end]) if frame_bytes != PACKED_BYTES else None
                    self._feed_reading(decode_packed(packed, start, self._model), stamp_ms, time_ns, scans)
                start = end
        return scans

    def begin_anew(self) -> None:
        """Discard open scans, since the link was broken; the adapter's clock may have restarted as well."""
        self.decoder.begin_anew()
        self._assembler.begin_anew()
        self._clock, self._stamped = _millisecond_clock(), None

    @property
    def clock_begun_ns(self) -> int | None:
        """Monotonic time at which the adapter's clock was first compared, as in `DeviceClock`, in [ns]."""
        return self._clock.begun_ns

    def bytes_until_scan(self) -> int:
        """Return the number of bytes, from 1, that must come at least before a scan can close whole."""
        return max(1, self._assembler.fewest_missing() * self.decoder.usual_line_bytes - self.decoder.pending_bytes)

    def counters(self) -> dict[str, int]:
        """Return the counters of all stages; foreign: frames of no taxel of this model."""
        return self.decoder.counters() | {"foreign": self._foreign} | self._assembler.counters()

    def _feed_reading(self, reading: Reading | None, stamp_ms: int | None, time_ns: int, scans: list[Scan]) -> None:
        if reading is None:
            self._foreign += 1
        else:
            scans += self._assembler.feed(
                reading, time_ns, None if stamp_ms is None else self._device_time(stamp_ms, time_ns)
            )

    def _feed_cycle(self, packed: bytes, frame_bytes: int, time_ns: int) -> Scan | None:
        """Return the scan of a sensor's whole cycle; None if this is no whole cycle, or a scan is still open."""
        can_ids = packed[::frame_bytes] + packed[1::frame_bytes]
        if can_ids not in self._cycles:
            if len(self._cycles) >= _MOST_ORDERS:  # frames of two sensors mix in many orders
                self._cycles.clear()
            high, low = can_ids[: len(can_ids) // 2], can_ids[len(can_ids) // 2 :]
            order = [h << 4 | b >> 4 for h, b in zip(high, low, strict=True)]
            self.can_ids.update(order)
            self._cycles[can_ids] = self._model.cycle(order)
        cycle = self._cycles[can_ids]
        # Checked before the last stamp is read: a clock that gets earlier stamps after it counts as set back.
        longest_ns = 0 if cycle is None else self._assembler.longest_cycle_ns(cycle)
        if cycle is None or not longest_ns:
            return None
        if frame_bytes == PACKED_BYTES:
            return self._assembler.feed_cycle(cycle, packed, time_ns)
        first_ms, last_ms = int.from_bytes(packed[frame_bytes - 2 : frame_bytes]), int.from_bytes(packed[-2:])
        # Read late and in one piece, half a cycle from before a pause and half from after it look like a whole one.
        if (last_ms - first_ms) % (LAST_TIMESTAMP_MS + 1) * _MS_NS > longest_ns:
            return None
        return self._assembler.feed_cycle(cycle, packed, time_ns, self._device_time(last_ms, time_ns))

    def _device_time(self, stamp_ms: int, time_ns: int) -> DeviceTime:
        # Sixteen frames that come together have about three different stamps: a scan takes 2 ms on the bus.
        if (stamp_ms, time_ns) != self._stamped:
            self._stamped = stamp_ms, time_ns
            self._device = self._clock.at(stamp_ms, time_ns)
        return self._device


def _millisecond_clock() -> DeviceClock:
    return DeviceClock(tick_ns=1_000_000, wrap_ticks=LAST_TIMESTAMP_MS + 1)
