"""Stages from the bytes of a gs_usb adapter to scans. No I/O, no clock."""

from typing import Final

from firmware_bridge.can.bus_errors import BusErrors
from firmware_bridge.can.gs_usb import GsUsbDecoder
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap
from firmware_bridge.scans.device_clock import DeviceClock
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.scan_assembler import ScanAssembler

TICK_NS: Final = 1_000
WRAP_TICKS: Final = 1 << 32  # ticks after which the 32-bit stamps wrap: 71.6 minutes of microseconds


class GsUsbScans:
    """Stages from bytes to scans, over any number of starts of the adapter.

    Attributes:
        clock: the adapter's clock since the last start.
        errors: what the adapter reported of its bus.
        can_ids: the standard CAN ids received so far, of any device.
    """

    def __init__(self, model: ModelMap = USPA44_MAP) -> None:
        self._scans = ScanAssembler(model)
        self.can_ids = self._scans.can_ids
        self.errors = BusErrors()
        self._earlier_counts: dict[str, int] = {}
        self._decoder, self.clock = GsUsbDecoder(stamped=False), DeviceClock(TICK_NS, WRAP_TICKS)

    def begin_anew(self) -> None:
        """Discard open scans, since the link was broken."""
        self._scans.begin_anew()

    def start(self, *, stamped: bool, channels: int) -> None:
        """Begin with a new decoder and clock after a start of the adapter, which may have reset its clock."""
        self._earlier_counts = self._sum_decoder_counts()
        self._decoder, self.clock = GsUsbDecoder(stamped=stamped, channels=channels), DeviceClock(TICK_NS, WRAP_TICKS)
        self.errors.restarted()

    def feed(self, data: bytes, time_ns: int) -> list[Scan]:
        """Return the scans that close within `data`, which arrived at `time_ns` [ns] of monotonic time."""
        scans: list[Scan] = []
        for host_frame in self._decoder.feed(data):
            if host_frame.overflow:
                self.errors.overflow(time_ns)
            if host_frame.error is not None:
                self.errors.error_frame(host_frame.error, host_frame.frame.data, time_ns)
                continue
            self.errors.frame_heard()
            stamp_us = host_frame.stamp_us
            device = None if stamp_us is None else self.clock.at(stamp_us, time_ns)
            scans += self._scans.feed_frame(host_frame.frame, time_ns, device)
        return scans

    def end_transfer(self) -> None:
        """Discard an incomplete frame: the next transfer begins with another one."""
        self._decoder.end_transfer()

    def counters(self) -> dict[str, int]:
        """Return the counters of all stages."""
        return self._sum_decoder_counts() | self.errors.counters() | self._scans.counters()

    def _sum_decoder_counts(self) -> dict[str, int]:
        return {name: self._earlier_counts.get(name, 0) + count for name, count in self._decoder.counters().items()}
