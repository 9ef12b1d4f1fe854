"""Stages from slcan text to scans: decoder, clock and assembler in a row. No I/O, no clock of its own."""

import struct
from collections.abc import Sequence
from typing import Final

from firmware_bridge.can.slcan import LAST_TIMESTAMP_MS, PACKED_BYTES, STAMPED_BYTES, CanFrame, SlcanDecoder
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap
from firmware_bridge.scans.device_clock import DeviceClock, DeviceTime
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.scan_assembler import Readings, ScanAssembler

_MS_NS: Final = 1_000_000
_WRAP_MS: Final = LAST_TIMESTAMP_MS + 1
LONGEST_RUN_MS: Final = 50  # between stamps by the newest of which all are mapped to this machine's clock
_LAYOUTS: Final = {PACKED_BYTES: ("HxHHHx", 4), STAMPED_BYTES: ("HxHHHxH", 5)}
"""Layouts of packed frames and the numbers in them, by their length: key and counts of a reading, stamp in [ms]."""


class SlcanScans:
    """Stages from slcan text to scans."""

    def __init__(self, model: ModelMap = USPA44_MAP) -> None:
        self.decoder = SlcanDecoder()  # the first stage, with its counters and the status that the adapter reported
        self.assembler = ScanAssembler(model)
        self._fed_ns = 0
        self._begin_clock()

    def feed(self, data: bytes, time_ns: int) -> list[Scan]:
        """Return the scans that close within `data`, which arrived at `time_ns` [ns]."""
        scans: list[Scan] = []
        pending = self.decoder.pending_bytes
        in_two = pending and pending + data.find(b"\r") + 1 == self.decoder.usual_line_bytes
        head_ns, self._fed_ns = self._fed_ns if in_two else time_ns, time_ns
        for piece in self.decoder.cut(data):
            if isinstance(piece, CanFrame):
                device = None if piece.timestamp_ms is None else self._device_time(piece.timestamp_ms, time_ns)
                scans += self.assembler.feed_frame(piece, time_ns, device)
            else:
                layout, numbers = _LAYOUTS[piece.frame_bytes]
                flat = struct.unpack(">" + layout * (len(piece.data) // piece.frame_bytes), piece.data)
                stamps_ms = flat[4::5] if numbers == 5 else ()
                if head_ns < time_ns and stamps_ms and self._is_joined(stamps_ms[0], head_ns):
                    self.assembler.foreign += 1
                    flat, stamps_ms = flat[numbers:], stamps_ms[1:]
                columns = flat[::numbers], flat[1::numbers], flat[2::numbers], flat[3::numbers]
                scans += self._feed(Readings(*columns), stamps_ms, time_ns)
            head_ns = time_ns
        return scans

    def begin_anew(self) -> None:
        """Discard open scans, since the link was broken; the adapter's clock may have restarted as well."""
        self.decoder.begin_anew()
        self.assembler.begin_anew()
        self._begin_clock()

    def bytes_until_scan(self) -> int:
        """Return the number of bytes, from 1, that must come at least before a scan can close whole."""
        missing_bytes = self.assembler.fewest_missing() * self.decoder.usual_line_bytes
        return max(1, missing_bytes - self.decoder.pending_bytes)

    def counters(self) -> dict[str, int]:
        """Return the counters of all stages; foreign: frames of no taxel of this model, or joined of two."""
        return self.decoder.counters() | self.assembler.counters()

    def _begin_clock(self) -> None:
        self.clock = DeviceClock(tick_ns=_MS_NS, wrap_ticks=_WRAP_MS)  # the adapter's clock since the last opening
        self._newest: tuple[int, DeviceTime] | None = None

    def _feed(self, readings: Readings, stamps_ms: Sequence[int], time_ns: int) -> list[Scan]:
        """Return the scans that a run of readings closes; the newest stamp, which was read soonest, gives the times."""
        device = None
        if stamps_ms and not self.clock.dropped:
            last_ms = stamps_ms[-1]
            rising = list(stamps_ms) == sorted(stamps_ms)
            if not rising or last_ms - stamps_ms[0] > LONGEST_RUN_MS:
                # They wrap round, or are of no good clock, or may be of none: that shows in each.
                singles = ((readings.taken([at]), stamp_ms) for at, stamp_ms in enumerate(stamps_ms))
                return [scan for one, stamp_ms in singles for scan in self._feed(one, [stamp_ms], time_ns)]
            device = self._device_time(last_ms, time_ns)
        if device is None:
            return self.assembler.feed(readings, time_ns)
        zero_ns = device.own_ns - stamps_ms[-1] * _MS_NS
        own_ns = [zero_ns + stamp_ms * _MS_NS for stamp_ms in stamps_ms]
        return self.assembler.feed(readings, time_ns, own_ns, device.host_ns - device.own_ns)

    def _is_joined(self, stamp_ms: int, head_ns: int) -> bool:
        """Return True if the head of a line came at `head_ns`, before its stamp: it has the tail of another."""
        if self._newest is None:
            return False
        newest_ms, device = self._newest
        since_ns = (stamp_ms - newest_ms) % _WRAP_MS * _MS_NS
        # No frame can arrive 5 ms before its stamp, which is the error of stamps and of their offset.
        return head_ns + 5 * _MS_NS < device.host_ns + since_ns < head_ns + _MS_NS * LAST_TIMESTAMP_MS // 2

    def _device_time(self, stamp_ms: int, time_ns: int) -> DeviceTime | None:
        device = self.clock.at(stamp_ms, time_ns)
        self._newest = None if device is None else (stamp_ms, device)
        return device
