"""Stages from CAN frames to scans, for links that receive frames. No I/O, no clock."""

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap, decode
from firmware_bridge.scans.device_clock import DeviceTime
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.scan_assembler import ScanAssembler


class FrameScans:
    """Stages from CAN frames to scans, for links that receive frames.

    Attributes:
        can_ids: the standard CAN ids received so far, of any device.
    """

    def __init__(self, model: ModelMap = USPA44_MAP) -> None:
        self._model = model
        self._assembler = ScanAssembler(model)
        self._foreign = 0
        self.can_ids: set[int] = set()

    def feed(self, frame: CanFrame, time_ns: int, device: DeviceTime | None = None) -> list[Scan]:
        """Return the scans closed by a frame that arrived at `time_ns` [ns]; `device` is its time stamp, if any."""
        if not frame.extended:  # bounded: there are at most 2048 of these
            self.can_ids.add(frame.can_id)
        reading = decode(frame, self._model)
        if reading is None:
            self._foreign += 1
            return []
        return self._assembler.feed(reading, time_ns, device)

    def begin_anew(self) -> None:
        """Discard open scans, since the link was broken."""
        self._assembler.begin_anew()

    def counters(self) -> dict[str, int]:
        """Return the counters of the assembler; foreign: frames of no taxel of this model."""
        return {"foreign": self._foreign} | self._assembler.counters()
