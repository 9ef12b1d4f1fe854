"""Link over a gs_usb adapter (candleLight and its kin) on USB, without the kernel's driver."""

import array
import errno
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final, Self

import usb.core
import usb.util
from usb.backend import IBackend

from firmware_bridge.can import gs_usb
from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.errors import DeviceError, LinkLostError
from firmware_bridge.links.base import FrameLink, SourceKind, not_open
from firmware_bridge.links.gs_usb_devices import GsUsbDevice, find_gs_usb, udev_rule
from firmware_bridge.links.usb_devices import Recognised, holders
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap
from firmware_bridge.scans.frame_scans import GsUsbScans
from firmware_bridge.scans.scan import Scan

INTERFACE: Final = 0
CHANNEL: Final = 0
ENDPOINT_IN: Final = 0x81
REQUEST_TIMEOUT_MS: Final = 1000
MOST_OLD_TRANSFERS: Final = 1000
"""Most transfers drained from a stopped channel: its queue has 64, and one that goes on did not stop."""


class GsUsbLink(FrameLink):
    """Link to a sensor on a gs_usb adapter.

    Frames left in an adapter when its client ends, or restarts without fetching them, can leave it mute until it is
    unplugged (candleLight_fw issues 46 and 165). So the channel is stopped and the remaining frames are fetched, both
    on opening, since an earlier client may have died, and on closing; and the USB device is never reset.

    Attributes:
        serial_number: serial number of the adapter as it was read last, and before as it was asked for.
    """

    def __init__(
        self,
        wanted: str | None = None,
        *,
        model: ModelMap = USPA44_MAP,
        triggers: Sequence[CanFrame] = (),
        backend: IBackend | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Prepare a link to the adapter with a serial number or at a place such as "1-2.3", for None the only one.

        Once it was open, only that adapter is opened again, or with a place the one that is there. `triggers` are
        frames that wake older controllers, sent once after opening, and `backend` is one of pyusb, by default libusb.
        """
        self._scans = GsUsbScans(model)
        super().__init__(self._scans, triggers, clock_ns)
        self.name = "gs_usb" if wanted is None else f"gs_usb:{wanted}"
        self.kind: SourceKind = "device"
        self.serial_number = wanted
        self._wanted = wanted
        self._known: Recognised[GsUsbDevice] = Recognised()
        self._backend = backend
        self._received_bytes = self._transfers = 0
        self._device: usb.core.Device | None = None
        self._driver_detached = False
        self._packet = array.array("B", bytes(64))

    def __enter__(self) -> Self:
        with self._counting:
            self._scans.begin_anew()
        described, device = find_gs_usb(self._wanted, self._known, self._backend)
        try:
            self._claim(device)
            self._start(device)
        except (usb.core.USBError, NotImplementedError, ValueError) as error:
            self._release(device)
            raise DeviceError(f"{self.name}: {_reason(error, described)}") from error
        self.serial_number = described.serial_number
        self._device = device
        return self

    def __exit__(self, *exc_info: object) -> None:
        device, self._device = self._device, None
        if device is None:
            return
        with suppress(usb.core.USBError):  # gone already: no adapter to stop
            self._stop(device)
        self._release(device)

    def counters(self) -> dict[str, int]:
        """Return the counts of received bytes and transfers, and the counters of decoder, bus and assembler."""
        with self._counting:
            return {"received_bytes": self._received_bytes, "transfers": self._transfers} | self._scans.counters()

    def _fetch(self, timeout_s: float) -> bytes | None:
        # An adapter sends each frame in a transfer of its own. libusb waits for ever with a time-out of 0.
        if self._device is None:
            raise not_open()
        try:
            timeout_ms = max(1, math.ceil(1000 * timeout_s))
            count: int = self._device.read(  # pyright: ignore[reportAssignmentType]
                ENDPOINT_IN, self._packet, timeout_ms
            )
        except usb.core.USBTimeoutError:
            return None
        except usb.core.USBError as error:
            if error.errno == errno.EINTR:
                return None
            raise LinkLostError(f"{self.name}: link lost, the cable or the adapter is gone: {error}") from error
        return self._packet[:count].tobytes() or None

    def _take(self, piece: bytes, time_ns: int) -> list[Scan]:
        self._transfers += 1
        self._received_bytes += len(piece)
        scans = self._scans.feed(piece, time_ns)
        if len(piece) < len(self._packet):
            self._scans.end_transfer()
        return scans

    def _claim(self, device: usb.core.Device) -> None:
        with suppress(NotImplementedError):  # a platform whose kernel has no such driver
            if device.is_kernel_driver_active(INTERFACE):
                device.detach_kernel_driver(INTERFACE)
                self._driver_detached = True
        try:
            configuration = device.get_active_configuration()
        except usb.core.USBError as error:
            if error.errno is not None:
                raise
            device.set_configuration()  # no configuration is set; setting one again would reset the adapter
            configuration = device.get_active_configuration()
        usb.util.claim_interface(device, INTERFACE)
        # One packet a transfer: a longer transfer would wait for more where frames fill their packets.
        interface = usb.util.find_descriptor(configuration, bInterfaceNumber=INTERFACE)
        endpoint = usb.util.find_descriptor(interface, bEndpointAddress=ENDPOINT_IN)
        packet_bytes = getattr(endpoint, "wMaxPacketSize", 0) & 0x7FF
        self._packet = array.array("B", bytes(packet_bytes or 64))

    def _start(self, device: usb.core.Device) -> None:
        _request(device, gs_usb.HOST_FORMAT, gs_usb.host_format())
        self._stop(device)
        channels = gs_usb.channel_count(_ask(device, gs_usb.DEVICE_CONFIG, gs_usb.CONFIG_BYTES))
        limits = gs_usb.BitTimingLimits.from_bytes(_ask(device, gs_usb.BIT_TIMING_LIMITS, gs_usb.LIMITS_BYTES))
        _request(device, gs_usb.BIT_TIMING, gs_usb.bit_timing(limits).to_bytes())
        features = limits.features & gs_usb.HARDWARE_STAMPS
        self._scans.start(stamped=features != 0, channels=channels)
        self._unread.empty_ns = self._clock_ns()  # from here on: this thread may not run for long after the start
        _request(device, gs_usb.MODE, gs_usb.mode(started=True, features=features))
        for number, frame in enumerate(self._triggers):
            data = gs_usb.encode_frame(frame, number % gs_usb.ECHO_IDS, limits)
            device.write(0x02, data, REQUEST_TIMEOUT_MS)

    def _stop(self, device: usb.core.Device) -> None:
        _request(device, gs_usb.MODE, gs_usb.mode(started=False))
        with suppress(usb.core.USBTimeoutError):
            for _ in range(MOST_OLD_TRANSFERS):  # frames left in the adapter follow each other within 20 ms
                device.read(ENDPOINT_IN, self._packet, 20)

    def _release(self, device: usb.core.Device) -> None:
        with suppress(usb.core.USBError):
            usb.util.release_interface(device, INTERFACE)
        if self._driver_detached:
            with suppress(usb.core.USBError, NotImplementedError):
                device.attach_kernel_driver(INTERFACE)
        self._driver_detached = False
        usb.util.dispose_resources(device)


def _request(device: usb.core.Device, number: int, payload: bytes) -> None:
    device.ctrl_transfer(gs_usb.REQUEST_OUT, number, CHANNEL, INTERFACE, payload, REQUEST_TIMEOUT_MS)


def _ask(device: usb.core.Device, number: int, length: int) -> bytes:
    return bytes(device.ctrl_transfer(gs_usb.REQUEST_IN, number, CHANNEL, INTERFACE, length, REQUEST_TIMEOUT_MS))


def _reason(error: Exception, described: GsUsbDevice) -> str:
    code = getattr(error, "errno", None)
    if code in (errno.EACCES, errno.EPERM):
        return f"no permission: {udev_rule(described.usb_id)}"
    if code == errno.EBUSY:
        held = ", ".join(holders(f"/dev/bus/usb/{described.bus:03d}/{described.address:03d}"))
        return (
            f"in use{f' by {held}' if held else ''}: end the program that holds it, such as another edge-sr or "
            "candump; sudo ip link set can0 down frees the kernel's"
        )
    if code == errno.ETIMEDOUT:
        return f"does not answer: unplug it and plug it in again ({described})"
    if code is None:
        return f"{error} ({described})"
    return f"cannot be used as a gs_usb adapter: {error} ({described})"
