"""CAN frames to scans, for links that hand out frames. No I/O, no clock."""

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap, decode
from firmware_bridge.scans.device_clock import DeviceTime
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.scan_assembler import ScanAssembler


class FrameScans:
    """CAN frames to scans, for links that hand out frames.

    Attributes:
        can_ids: the standard CAN ids that came so far, of whatever device.
    """

    def __init__(self, model: ModelMap = USPA44_MAP) -> None:
        self._model = model
        self._assembler = ScanAssembler(model)
        self._foreign = 0
        self.can_ids: set[int] = set()

    def feed(self, frame: CanFrame, time_ns: int, device: DeviceTime | None = None) -> list[Scan]:
        """Scans that a frame closes which arrived at `time_ns` [ns], and was on the bus at `device` if known."""
        if not frame.extended:  # of these there are 2048 at most
            self.can_ids.add(frame.can_id)
        reading = decode(frame, self._model)
        if reading is None:
            self._foreign += 1
            return []
        return self._assembler.feed(reading, time_ns, device)

    def begin_anew(self) -> None:
        """Give up what is half read, since the link was broken."""
        self._assembler.begin_anew()

    def counters(self) -> dict[str, int]:
        """Counters of the assembler; foreign: frames that are none of this model's taxels."""
        return {"foreign": self._foreign} | self._assembler.counters()
