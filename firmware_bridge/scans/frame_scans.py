"""Stages from CAN frames with time stamps in microseconds, or from the bytes of a gs_usb adapter, to scans. No I/O."""

from firmware_bridge.can.bus_errors import BusErrors
from firmware_bridge.can.gs_usb import GsUsbDecoder
from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap
from firmware_bridge.scans.device_clock import DeviceClock
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.scan_assembler import ScanAssembler


class FrameScans:
    """Stages from frames to scans, over any number of openings."""

    def __init__(self, model: ModelMap = USPA44_MAP) -> None:
        self.clock = DeviceClock(1_000, None)  # the adapter's clock
        self.errors = BusErrors()  # what the adapter reported of its bus
        self.assembler = ScanAssembler(model)

    def begin_anew(self) -> None:
        """Discard open scans, since the link was broken."""
        self.assembler.begin_anew()

    def feed_frame(self, frame: CanFrame, stamp_us: int | None, time_ns: int) -> list[Scan]:
        """Return the scans that a frame closes; it arrived at `time_ns` [ns], by its stamp, if any, at `stamp_us`."""
        self.errors.frame_heard()
        device = None if stamp_us is None else self.clock.at(stamp_us, time_ns)
        return self.assembler.feed_frame(frame, time_ns, device)

    def counters(self) -> dict[str, int]:
        """Return the counters of all stages."""
        return self.errors.counters() | self.assembler.counters()


class GsUsbScans(FrameScans):
    """The same from the bytes of a gs_usb adapter."""

    def __init__(self, model: ModelMap = USPA44_MAP) -> None:
        super().__init__(model)
        self._decoder = GsUsbDecoder(stamped=False)

    def start(self, *, stamped: bool) -> None:
        """Begin with a new clock after a start of the adapter, which may have reset its own."""
        self._decoder.start(stamped=stamped)
        self.clock = DeviceClock(1_000, 1 << 32)  # the 32-bit stamps wrap after 71.6 minutes
        self.errors.restarted()

    def feed(self, data: bytes, time_ns: int) -> list[Scan]:
        """Return the scans that close within `data`, which arrived at `time_ns` [ns] of monotonic time."""
        scans: list[Scan] = []
        for host_frame in self._decoder.feed(data):
            if host_frame.overflow:
                self.errors.overflow(time_ns)
            if host_frame.error is not None:
                self.errors.error_frame(host_frame.error, host_frame.frame.data, time_ns)
            else:
                scans += self.feed_frame(host_frame.frame, host_frame.stamp_us, time_ns)
        return scans

    def end_transfer(self) -> None:
        """Discard an incomplete frame: the next transfer begins with another one."""
        self._decoder.end_transfer()

    def counters(self) -> dict[str, int]:
        """Return the counters of all stages."""
        return self._decoder.counters() | super().counters()
