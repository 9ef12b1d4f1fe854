"""List of the gs_usb adapters of this machine, and selection of one. Loads pyusb and libusb."""

from collections.abc import Sequence
from contextlib import suppress
from typing import Final, NamedTuple

import usb.core
import usb.util
from usb.backend import IBackend

from firmware_bridge.errors import DeviceError, NoDeviceError

GS_USB_IDS: Final = {
    (0x1D50, 0x606F): "candleLight",  # and most of its kin, CANable among them
    (0x1209, 0x2323): "candleLight",
    (0x1209, 0xCA01): "CANnectivity",
    (0x1CD2, 0x606F): "CES CANext FD",
    (0x16D0, 0x10B8): "ABE CANdebugger FD",
}
"""Adapters by vendor and product id. Source: Linux drivers/net/can/usb/gs_usb.c, and CANnectivity."""

# A device without readable texts is still listed: pyusb reports "no langid" where it may not open it.
_NO_TEXT: Final = (usb.core.USBError, ValueError, NotImplementedError)


class GsUsbDevice(NamedTuple):
    """One adapter. `serial_number` and `product` are None where they cannot be read."""

    bus: int
    address: int
    usb_id: tuple[int, int]
    serial_number: str | None
    product: str | None

    def __str__(self) -> str:
        serial = f" serial={self.serial_number}" if self.serial_number else ""
        usb_id = f"{self.usb_id[0]:04x}:{self.usb_id[1]:04x}"
        return f"bus {self.bus} device {self.address} {usb_id}{serial} ({self.product or GS_USB_IDS[self.usb_id]})"


def usb_backend() -> IBackend:
    """Return libusb: that of the package libusb-package, else the system's.

    Raises:
        DeviceError: no libusb works.
    """
    try:
        from libusb_package import get_libusb1_backend
    except ImportError:
        from usb.backend.libusb1 import get_backend as get_libusb1_backend
    backend = get_libusb1_backend()
    if backend is None:
        raise DeviceError("libusb cannot be loaded: pip install libusb-package, or apt install libusb-1.0-0")
    return backend


def gs_usb_devices(backend: IBackend | None = None) -> list[GsUsbDevice]:
    """List all gs_usb adapters of this machine, by bus and address.

    Raises:
        DeviceError: USB cannot be read.
    """
    return [described for described, _ in _found(backend)]


def find_gs_usb(serial_number: str | None, backend: IBackend | None = None) -> tuple[GsUsbDevice, usb.core.Device]:
    """Return the adapter with this serial number; for None the only one there is.

    Raises:
        NoDeviceError: there is no such adapter, or there are several.
        DeviceError: USB cannot be read.
    """
    found = _found(backend)
    seen = f"gs_usb adapters seen: {'; '.join(str(described) for described, _ in found) or 'none'}"
    fitting = [one for one in found if serial_number in (None, one[0].serial_number)]
    if len(fitting) == 1:
        return fitting[0]
    if serial_number is not None:
        unread = [described.usb_id for described, _ in found if described.serial_number is None]
        hint = f"; a serial number that is not shown could not be read: {udev_rule(unread[0])}" if unread else ""
        raise NoDeviceError(
            f"{len(fitting) or 'no'} gs_usb adapter with serial number {serial_number}, expected one. {seen}{hint}"
        )
    if not found:
        raise NoDeviceError(f"no gs_usb adapter found: plug one in, or name another source. {seen}")
    named = next((described.serial_number for described, _ in found if described.serial_number), "SERIAL")
    raise NoDeviceError(f"{len(found)} gs_usb adapters found: name one, such as --source gs_usb:{named}. {seen}")


def udev_rule(usb_id: tuple[int, int]) -> str:
    """Return the shell command that allows users to open such a device."""
    rule = f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{usb_id[0]:04x}", ATTR{{idProduct}}=="{usb_id[1]:04x}", MODE="0666"'
    return f"echo '{rule}' | sudo tee /etc/udev/rules.d/70-gs_usb.rules && sudo udevadm control -R, then plug it again"


def _found(backend: IBackend | None) -> Sequence[tuple[GsUsbDevice, usb.core.Device]]:
    if backend is None:
        backend = usb_backend()
    try:
        found = list(usb.core.find(find_all=True, backend=backend) or ())
    except (usb.core.USBError, NotImplementedError) as error:
        raise DeviceError(f"USB cannot be read: {error}") from error
    devices = [device for device in found if isinstance(device, usb.core.Device) and _usb_id(device) in GS_USB_IDS]
    return sorted(((_describe(device), device) for device in devices), key=lambda one: one[0][:2])


def _usb_id(device: usb.core.Device) -> tuple[int, int]:
    return device.idVendor, device.idProduct  # pyright: ignore[reportAttributeAccessIssue]


def _describe(device: usb.core.Device) -> GsUsbDevice:
    serial_number = product = None
    try:
        with suppress(*_NO_TEXT):
            serial_number = device.serial_number
        with suppress(*_NO_TEXT):
            product = device.product
    finally:
        usb.util.dispose_resources(device)
    return GsUsbDevice(device.bus or 0, device.address or 0, _usb_id(device), serial_number or None, product or None)
