"""USB with emulated gs_usb adapters, as a backend of pyusb that answers as libusb, errors included.

An adapter treats requests, frames and a client that dies as a candleLight does. Its queue holds 64 frames; a frame
without room is lost, and a flag on the next frame reports it. It receives nothing without the right bit timing. A
client's death does not stop it.
"""

# The documentation of pyusb explains each method. It is untyped, so pyright takes its empty methods to return None.
# pyright: reportIncompatibleMethodOverride=false

import errno
import os
import struct
import threading
import time
from array import array
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Final

import usb.backend
import usb.core

from firmware_bridge.can import gs_usb
from firmware_bridge.can.gs_usb import BitTiming, BitTimingLimits
from firmware_bridge.can.slcan import CanFrame

QUEUE_FRAMES: Final = 64
CANDLELIGHT: Final = BitTimingLimits(
    features=0x13 | gs_usb.HARDWARE_STAMPS, clock_hz=48_000_000, tseg1_min=1, tseg1_max=16, tseg2_min=1, tseg2_max=8,
    sjw_max=4, brp_min=1, brp_max=1024, brp_inc=1,
)  # fmt: skip
_FRAME: Final = struct.Struct("<IIBBBB8s")


class GsUsbAdapter:
    """Adapter from one plugging-in to the next. Its methods may be called from any thread."""

    def __init__(self, limits: BitTimingLimits = CANDLELIGHT) -> None:
        """Plug it in."""
        self.started = False  # true while its channel is on the bus
        self.right_bitrate = False  # true where its timing makes 1 Mbit/s
        self.sent: list[CanFrame] = []  # frames that it put on the bus for the client
        self.lost_frames = 0  # frames that had no room
        self.limits = limits
        self._stamped = False
        self._overflowed = False
        self.queue: deque[bytes] = deque()  # host frames that wait to be fetched
        self._changed = threading.Condition()
        self.plugged = True  # while its cable is in

    def hear(self, *frames: CanFrame, stamp_us: int | None = None, channel: int = 0, flags: int = 0) -> None:
        """Receive frames from the bus, at `stamp_us` of its clock, by default now."""
        with self._changed:
            for frame in frames:
                if not (self.started and self.right_bitrate):
                    return
                if len(self.queue) >= QUEUE_FRAMES:
                    self._overflowed = True
                    self.lost_frames += 1
                    continue
                raw_id = frame.can_id | flags | gs_usb.EXTENDED * frame.extended | gs_usb.REMOTE * frame.remote
                self._enqueue(gs_usb.RECEIVED, raw_id, len(frame.data), channel, frame.data, stamp_us)

    def report(self, classes: int) -> None:
        """Send an error frame, of classes as in Linux's error.h."""
        self.hear(CanFrame(classes, bytes(8)), flags=gs_usb.ERROR)

    def unplug(self) -> None:
        """Pull the cable out, and wake all who wait for it."""
        with self._changed:
            self.plugged = False
            self._changed.notify_all()

    def request_out(self, number: int, payload: bytes) -> None:
        """Obey a request, or stall if it knows none such, or the payload is too short."""
        lengths: dict[int, int] = {gs_usb.Request.HOST_FORMAT: 4, gs_usb.Request.BIT_TIMING: 20, gs_usb.Request.MODE: 8}
        if len(payload) < lengths.get(number, 1 << 16):
            raise libusb_error(errno.EPIPE)
        with self._changed:
            if number == gs_usb.Request.BIT_TIMING:
                timing = BitTiming(*struct.unpack_from("<5I", payload))
                self.right_bitrate = self.limits.clock_hz == timing.quanta * timing.brp * gs_usb.BITRATE_BIT_S
            elif number == gs_usb.Request.MODE:
                wanted, features = struct.unpack_from("<II", payload)
                self.started = wanted == 1
                if self.started:
                    self._stamped = features & self.limits.features & gs_usb.HARDWARE_STAMPS != 0

    def take(self, data: bytes) -> None:
        """Take a host frame to send, and echo it."""
        with self._changed:
            if self.started:
                echo_id, raw_id, dlc, _, _, _, payload = _FRAME.unpack_from(data)
                self.sent.append(CanFrame(raw_id, payload[:dlc]))
                self._enqueue(echo_id, raw_id, dlc, 0, payload, None)

    def fetch(self, timeout_s: float | None) -> bytes | None:
        """Wait for the next host frame and return it; None when there is none in time, or the cable is out."""
        with self._changed:
            self._changed.wait_for(lambda: not self.plugged or self.queue, timeout_s)
            return self.queue.popleft() if self.plugged and self.queue else None

    def _enqueue(self, echo_id: int, raw_id: int, dlc: int, channel: int, payload: bytes, stamp_us: int | None) -> None:
        flags = gs_usb.OVERFLOW_FLAG if self._overflowed and echo_id == gs_usb.RECEIVED else 0
        self._overflowed = self._overflowed and not flags
        data = _FRAME.pack(echo_id, raw_id, dlc, channel, flags, 0, payload)
        if self._stamped:
            data += struct.pack("<I", (time.monotonic_ns() // 1000 if stamp_us is None else stamp_us) & 0xFFFFFFFF)
        self.queue.append(data)
        self._changed.notify_all()


class GsUsbPort:
    """Place on the bus where an adapter may be plugged in: the one that is there, or was there last."""

    def __init__(
        self,
        adapter: Callable[[], GsUsbAdapter] = GsUsbAdapter,
        *,
        serial_number: str | None = "0039003A5542501020393739",
        product: str | None = "candleLight USB to CAN adapter",
        usb_id: tuple[int, int] = (0x1D50, 0x606F),
        packet_bytes: int = 32,
        sockets: tuple[int, ...] = (1,),
    ) -> None:
        """Plug an adapter in; `adapter` makes a new one each time."""
        self.serial_number = serial_number
        self.product = product
        self.kernel_driver = False  # it holds the adapter
        self.claimed: _Plugged | None = None  # by which handle
        self.handles = 0  # how often it is open
        self.permitted = True  # the user may open it
        self.gone_as = errno.ENODEV  # the error of libusb that unplugging gives; host controllers differ
        self.usb_id = usb_id
        self.packet_bytes = packet_bytes
        self.address = 5
        self.sockets = sockets  # numbers of the hubs' sockets that lead to it
        self._make = adapter
        self.adapter = adapter()

    def plug(self) -> None:
        """Plug it in again: a new adapter under another address."""
        self.address += 1
        self.claimed = None
        self.adapter = self._make()


@dataclass(eq=False)  # each is a program of its own
class _Plugged:
    """Handle by which libusb identifies a device: gone for good once it was unplugged."""

    port: GsUsbPort
    adapter: GsUsbAdapter

    def check(self) -> GsUsbAdapter:
        if not self.adapter.plugged:
            raise libusb_error(self.port.gone_as)
        return self.adapter


class GsUsbBackend(usb.backend.IBackend):
    """Bus with ports."""

    def __init__(self, *ports: GsUsbPort) -> None:
        """Set up a bus, by default with one adapter on it."""
        super().__init__()
        self.ports = list(ports) or [GsUsbPort()]

    # What stands in the descriptors.

    def enumerate_devices(self) -> Iterator[_Plugged]:
        return iter([_Plugged(port, port.adapter) for port in self.ports if port.adapter.plugged])

    def get_device_descriptor(self, dev: _Plugged) -> SimpleNamespace:
        vendor, product = dev.port.usb_id
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x200, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=64, idVendor=vendor, idProduct=product, bcdDevice=0, iManufacturer=1, iProduct=2,
            iSerialNumber=3 if dev.port.serial_number is not None else 0, bNumConfigurations=1, bus=1,
            address=dev.port.address, port_number=dev.port.sockets[-1], port_numbers=dev.port.sockets, speed=2,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: _Plugged, config: int) -> SimpleNamespace:
        if config:
            raise IndexError(config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=32, bNumInterfaces=1, bConfigurationValue=1, iConfiguration=0,
            bmAttributes=0x80, bMaxPower=75, extra_descriptors=b"",
        )  # fmt: skip

    def get_interface_descriptor(self, dev: _Plugged, intf: int, alt: int, config: int) -> SimpleNamespace:
        if intf or alt:
            raise IndexError(intf, alt)
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0, bNumEndpoints=2,
            bInterfaceClass=255, bInterfaceSubClass=255, bInterfaceProtocol=255, iInterface=0, extra_descriptors=b"",
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: _Plugged, ep: int, intf: int, alt: int, config: int) -> SimpleNamespace:
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=(0x81, 0x02)[ep], bmAttributes=2, bInterval=0, bRefresh=0,
            bSynchAddress=0, wMaxPacketSize=dev.port.packet_bytes, extra_descriptors=b"",
        )  # fmt: skip

    # Who holds a device.

    def open_device(self, dev: _Plugged) -> _Plugged:
        dev.check()
        if not dev.port.permitted:
            raise libusb_error(errno.EACCES)
        dev.port.handles += 1
        return dev

    def close_device(self, dev_handle: _Plugged) -> None:
        self._let_go(dev_handle)
        dev_handle.port.handles -= 1

    def get_configuration(self, dev_handle: _Plugged) -> int:
        dev_handle.check()
        return 1

    def claim_interface(self, dev_handle: _Plugged, intf: int) -> None:
        dev_handle.check()
        if dev_handle.port.kernel_driver or dev_handle.port.claimed not in (None, dev_handle):
            raise libusb_error(errno.EBUSY)
        dev_handle.port.claimed = dev_handle

    def release_interface(self, dev_handle: _Plugged, intf: int) -> None:
        dev_handle.check()
        self._let_go(dev_handle)

    def is_kernel_driver_active(self, dev_handle: _Plugged, intf: int) -> bool:
        dev_handle.check()
        return dev_handle.port.kernel_driver

    def detach_kernel_driver(self, dev_handle: _Plugged, intf: int) -> None:
        dev_handle.check()
        if not dev_handle.port.kernel_driver:
            raise libusb_error(errno.ENOENT)
        dev_handle.port.kernel_driver = False

    def attach_kernel_driver(self, dev_handle: _Plugged, intf: int) -> None:
        dev_handle.check()
        if dev_handle.port.claimed:
            raise libusb_error(errno.EBUSY)
        dev_handle.port.kernel_driver = True

    # Transfers.

    def ctrl_transfer(
        self,
        dev_handle: _Plugged,
        bmRequestType: int,  # noqa: N803
        bRequest: int,  # noqa: N803
        wValue: int,  # noqa: N803
        wIndex: int,  # noqa: N803
        data: "array[int]",
        timeout: int,
    ) -> int:
        adapter = dev_handle.check()
        if not bmRequestType & 0x80:  # to the device
            adapter.request_out(bRequest, data.tobytes())
            return len(data)
        if (bmRequestType, bRequest, wValue >> 8) == (0x80, 6, 3):  # get a descriptor, of a text
            answer = self._text(dev_handle.port, wValue & 0xFF)
        elif bRequest == gs_usb.Request.BIT_TIMING_LIMITS:
            answer = struct.pack("<10I", *adapter.limits)
        else:  # it knows none such, and stalls
            raise libusb_error(errno.EPIPE)
        answer = answer[: len(data)]
        data[: len(answer)] = array("B", answer)
        return len(answer)

    def bulk_read(self, dev_handle: _Plugged, ep: int, intf: int, buff: Any, timeout: int) -> int:
        adapter = dev_handle.check()
        self._check_claim(dev_handle)
        data = adapter.fetch(timeout / 1000 if timeout else None)
        if data is None:
            dev_handle.check()  # the cable may have come out meanwhile
            raise libusb_error(errno.ETIMEDOUT)
        if len(data) > len(buff):
            raise libusb_error(errno.EOVERFLOW)
        buff[: len(data)] = array("B", data)
        return len(data)

    def bulk_write(self, dev_handle: _Plugged, ep: int, intf: int, data: "array[int]", timeout: int) -> int:
        adapter = dev_handle.check()
        self._check_claim(dev_handle)
        adapter.take(data.tobytes())
        return len(data)

    def _check_claim(self, handle: _Plugged) -> None:
        if handle.port.claimed is not handle:
            raise libusb_error(errno.EIO)

    def _let_go(self, handle: _Plugged) -> None:
        if handle.port.claimed is handle:
            handle.port.claimed = None

    def _text(self, port: GsUsbPort, index: int) -> bytes:
        if index == 0:
            return b"\x04\x03\x09\x04"  # English
        text = {2: port.product, 3: port.serial_number}.get(index)
        if text is None:
            raise libusb_error(errno.EPIPE)
        encoded = text.encode("utf-16-le")
        return bytes((2 + len(encoded), 3)) + encoded


def libusb_error(number: int) -> usb.core.USBError:
    """Return the error that pyusb makes of one of libusb, by its errno."""
    kind = usb.core.USBTimeoutError if number == errno.ETIMEDOUT else usb.core.USBError
    return kind(os.strerror(number), None, number)
