"""gs_usb adapters (candleLight and its kin) on USB, without the kernel's driver: their list, and a link over one."""

import array
import errno
import math
import re
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final, NamedTuple, Self

import usb.core
import usb.util
from usb.backend import IBackend

from firmware_bridge.can import gs_usb
from firmware_bridge.errors import DeviceError, LinkLostError, NoDeviceError, as_typed
from firmware_bridge.links.base import SourceKind, not_open
from firmware_bridge.links.frame_link import FrameLink
from firmware_bridge.links.known_adapters import GS_USB_ADAPTERS
from firmware_bridge.links.serial_ports import Recognised, holders
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap
from firmware_bridge.scans.frame_scans import GsUsbScans
from firmware_bridge.scans.scan import Scan

INTERFACE: Final = 0
CHANNEL: Final = 0
ENDPOINT_IN: Final = 0x81
REQUEST_TIMEOUT_MS: Final = 1000
MOST_OLD_TRANSFERS: Final = 1000  # drained from a stopped channel: its queue has 64


class GsUsbDevice(NamedTuple):
    """One adapter. `serial_number` and `product` are None where they cannot be read; `place` is such as "1-2.3"."""

    bus: int
    address: int
    usb_id: tuple[int, int]
    serial_number: str | None
    product: str | None
    place: str | None = None

    @property
    def identity(self) -> tuple[object, ...] | None:
        """Its identity at any socket; None without a serial number."""
        return None if self.serial_number is None else (self.usb_id, self.serial_number)

    @property
    def where(self) -> str:
        """Its address until it is unplugged, and the bus and sockets that lead to it."""
        return f"bus {self.bus} device {self.address}{f' at {self.place}' if self.place else ''}"

    def __str__(self) -> str:
        serial = f" serial={self.serial_number}" if self.serial_number else ""
        usb_id = f"{self.usb_id[0]:04x}:{self.usb_id[1]:04x}"
        return f"{self.where} {usb_id}{serial} ({self.product or GS_USB_ADAPTERS[self.usb_id]})"


class GsUsbLink(FrameLink):
    """Link to a sensor on a gs_usb adapter.

    Frames left in an adapter when its client ends, or restarts without fetching them, can leave it mute until it is
    unplugged (candleLight_fw issues 46 and 165). So the channel is stopped and the remaining frames are fetched, both
    on opening, since an earlier client may have died, and on closing; and the USB device is never reset.
    """

    def __init__(
        self,
        wanted: str | None = None,
        *,
        model: ModelMap = USPA44_MAP,
        backend: IBackend | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Prepare a link to the adapter with a serial number or at a place such as "1-2.3", for None the only one.

        Once it was open, only that adapter is opened again, or with a place the one that is there.
        """
        self._scans = GsUsbScans(model)
        super().__init__(self._scans, clock_ns)
        self._triggers = model.triggers
        self.name = "gs_usb" if wanted is None else f"gs_usb:{wanted}"
        self.kind: SourceKind = "device"
        self._wanted = wanted
        self._recognised: Recognised[GsUsbDevice] = Recognised()
        self._backend = backend
        self._received_bytes = self._transfers = 0
        self._device: usb.core.Device | None = None
        self._driver_detached = False
        self._packet = array.array("B", bytes(64))

    def __enter__(self) -> Self:
        with self._counting:
            self._scans.begin_anew()
        described, device = find_gs_usb(self._wanted, self._recognised, self._backend)
        try:
            self._claim(device)
            self._start(device)
        except (usb.core.USBError, NotImplementedError, ValueError) as error:
            self._release(device)
            raise DeviceError(f"{self.name}: {_reason(error, described)}") from error
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
        usb.util.claim_interface(device, INTERFACE)  # in the configuration that is set: setting one would reset it
        # One packet a transfer: a longer transfer would wait for more where frames fill their packets.
        interface = usb.util.find_descriptor(device.get_active_configuration(), bInterfaceNumber=INTERFACE)
        endpoint = usb.util.find_descriptor(interface, bEndpointAddress=ENDPOINT_IN)
        packet_bytes = getattr(endpoint, "wMaxPacketSize", 0) & 0x7FF
        self._packet = array.array("B", bytes(packet_bytes or 64))

    def _start(self, device: usb.core.Device) -> None:
        _request(device, gs_usb.Request.HOST_FORMAT, gs_usb.host_format())
        self._stop(device)
        limits = gs_usb.BitTimingLimits.from_bytes(_ask(device, gs_usb.Request.BIT_TIMING_LIMITS, gs_usb.LIMITS_BYTES))
        _request(device, gs_usb.Request.BIT_TIMING, gs_usb.bit_timing(limits).to_bytes())
        features = limits.features & gs_usb.HARDWARE_STAMPS
        self._scans.start(stamped=features != 0)
        self._unread.empty_ns = self._clock_ns()  # from here on: this thread may not run for long after the start
        _request(device, gs_usb.Request.MODE, gs_usb.mode(started=True, features=features))
        for number, frame in enumerate(self._triggers):
            device.write(0x02, gs_usb.encode_frame(frame, number), REQUEST_TIMEOUT_MS)

    def _stop(self, device: usb.core.Device) -> None:
        _request(device, gs_usb.Request.MODE, gs_usb.mode(started=False))
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


def gs_usb_devices(backend: IBackend | None = None) -> list[GsUsbDevice]:
    """List all gs_usb adapters of this machine, by bus and address; raises DeviceError if USB cannot be read."""
    return [described for described, _ in _adapters(backend)]


def find_gs_usb(
    wanted: str | None, recognised: Recognised[GsUsbDevice], backend: IBackend | None = None
) -> tuple[GsUsbDevice, usb.core.Device]:
    """Return the adapter that `GsUsbLink` wants, or that was `recognised` at an earlier opening, and learn it.

    Raises NoDeviceError where there is no such adapter, or several, and DeviceError if USB cannot be read.
    """
    adapters = _adapters(backend)
    present = [described for described, _ in adapters]
    seen = f"gs_usb adapters seen: {'; '.join(map(str, present)) or 'none'}"
    # Bus and sockets, as the kernel names a USB device.
    placed = wanted is not None and re.fullmatch(r"[0-9]+-[0-9]+(\.[0-9]+)*", wanted) is not None
    if recognised.device is not None and not placed:
        wanted, same = recognised.device.serial_number, recognised.find(present)
        fitting = [adapter for adapter in present if adapter is same]
    else:
        named = [adapter.place if placed else adapter.serial_number for adapter in present]
        fitting = [adapter for adapter, name in zip(present, named, strict=True) if wanted in (None, name)]
    if len(fitting) == 1:
        recognised.learn(fitting[0], present)
        return adapters[present.index(fitting[0])]
    which = "" if wanted is None else f" at {wanted}" if placed else f" with serial number {wanted}"
    what = f"no gs_usb adapter{which}: plug it in, or name another source"
    if len(fitting) > 1:
        named = next((name for adapter in present if (name := source_name(adapter, present))), "gs_usb:SERIAL")
        what = f"{len(fitting)} gs_usb adapters{which}: name one, such as --source {as_typed(named)}"
    elif recognised.device is not None and wanted in [adapter.serial_number for adapter in present]:
        what = f"no gs_usb adapter{which} that is surely the one: plug it in where it was, at {recognised.device.place}"
    named_by_serial = wanted is not None and not placed
    unread = [adapter.usb_id for adapter in present if named_by_serial and adapter.serial_number is None]
    hint = f"; a serial number that is not shown could not be read: {udev_rule(unread[0])}" if unread else ""
    raise NoDeviceError(f"{what}. {seen}{hint}")


def source_name(device: GsUsbDevice, present: Sequence[GsUsbDevice]) -> str | None:
    """Return the source that selects a present adapter: by its own serial number, else by place; None without both."""
    serial_numbers = [adapter.serial_number for adapter in present]
    own = device.serial_number is not None and serial_numbers.count(device.serial_number) == 1
    name = device.serial_number if own else device.place
    return name and f"gs_usb:{name}"


def udev_rule(usb_id: tuple[int, int]) -> str:
    """Return the shell command that allows users to open such a device."""
    rule = f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{usb_id[0]:04x}", ATTR{{idProduct}}=="{usb_id[1]:04x}", MODE="0666"'
    return f"echo '{rule}' | sudo tee /etc/udev/rules.d/70-gs_usb.rules && sudo udevadm control -R, then plug it again"


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


def _adapters(backend: IBackend | None) -> Sequence[tuple[GsUsbDevice, usb.core.Device]]:
    if backend is None:  # that of the package libusb-package, else the system's
        try:
            from libusb_package import get_libusb1_backend
        except ImportError:
            from usb.backend.libusb1 import get_backend as get_libusb1_backend
        backend = get_libusb1_backend()
    if backend is None:
        raise DeviceError("libusb cannot be loaded: pip install libusb-package, or apt install libusb-1.0-0")
    try:
        seen = list(usb.core.find(find_all=True, backend=backend) or ())
    except (usb.core.USBError, NotImplementedError) as error:
        raise DeviceError(f"USB cannot be read: {error}") from error
    devices = [device for device in seen if isinstance(device, usb.core.Device) and _usb_id(device) in GS_USB_ADAPTERS]
    return sorted(((_describe(device), device) for device in devices), key=lambda pair: pair[0][:2])


def _usb_id(device: usb.core.Device) -> tuple[int, int]:
    return device.idVendor, device.idProduct  # pyright: ignore[reportAttributeAccessIssue]


def _describe(device: usb.core.Device) -> GsUsbDevice:
    texts: list[str | None] = []
    for name in ("serial_number", "product"):
        try:
            texts.append(getattr(device, name) or None)
        except (usb.core.USBError, ValueError, NotImplementedError):  # "no langid" where it may not be opened
            texts.append(None)
    usb.util.dispose_resources(device)
    bus, sockets = device.bus or 0, device.port_numbers or ()  # pyright: ignore[reportAttributeAccessIssue]
    place = f"{bus}-{'.'.join(map(str, sockets))}" if sockets else None
    return GsUsbDevice(bus, device.address or 0, _usb_id(device), texts[0], texts[1], place)
