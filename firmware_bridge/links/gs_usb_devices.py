"""List of the gs_usb adapters of this machine, and selection of one. Loads pyusb and libusb."""

import re
from collections.abc import Sequence
from typing import Final, NamedTuple

import usb.core
import usb.util
from usb.backend import IBackend

from firmware_bridge.errors import DeviceError, NoDeviceError
from firmware_bridge.links.usb_devices import Recognised

GS_USB_IDS: Final = {
    (0x1D50, 0x606F): "candleLight",  # and most of its kin, CANable among them
    (0x1209, 0x2323): "candleLight",
    (0x1209, 0xCA01): "CANnectivity",
    (0x1CD2, 0x606F): "CES CANext FD",
    (0x16D0, 0x10B8): "ABE CANdebugger FD",
}
"""Adapters by vendor and product id. Source: Linux drivers/net/can/usb/gs_usb.c, and CANnectivity."""


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
        return f"{self.where} {usb_id}{serial} ({self.product or GS_USB_IDS[self.usb_id]})"


def usb_backend() -> IBackend:
    """Return libusb: that of the package libusb-package, else the system's; raises DeviceError if none works."""
    try:
        from libusb_package import get_libusb1_backend
    except ImportError:
        from usb.backend.libusb1 import get_backend as get_libusb1_backend
    backend = get_libusb1_backend()
    if backend is None:
        raise DeviceError("libusb cannot be loaded: pip install libusb-package, or apt install libusb-1.0-0")
    return backend


def gs_usb_devices(backend: IBackend | None = None) -> list[GsUsbDevice]:
    """List all gs_usb adapters of this machine, by bus and address; raises DeviceError if USB cannot be read."""
    return [described for described, _ in _found(backend)]


def find_gs_usb(
    wanted: str | None, known: Recognised[GsUsbDevice], backend: IBackend | None = None
) -> tuple[GsUsbDevice, usb.core.Device]:
    """Return the adapter with a serial number or at a place such as "1-2.3", for None the only one; `known` learns it.

    The one that is known from an earlier opening is found again, unless a place is wanted. It raises NoDeviceError
    where there is no such adapter, or several, and DeviceError if USB cannot be read.
    """
    found = _found(backend)
    present = [described for described, _ in found]
    seen = f"gs_usb adapters seen: {'; '.join(map(str, present)) or 'none'}"
    # Bus and sockets, as the kernel names a USB device.
    placed = wanted is not None and re.fullmatch(r"[0-9]+-[0-9]+(\.[0-9]+)*", wanted) is not None
    if known.device is not None and not placed:
        wanted, same = known.device.serial_number, known.find(present)
        fitting = [one for one in present if one is same]
    else:
        fitting = [one for one in present if wanted in (None, one.place if placed else one.serial_number)]
    if len(fitting) == 1:
        known.learn(fitting[0], present)
        return found[present.index(fitting[0])]
    named = next((name for one in present if (name := source_name(one, present))), "gs_usb:SERIAL")
    if placed:
        raise NoDeviceError(f"no gs_usb adapter at {wanted}: plug it in there. {seen}")
    if wanted is not None:
        unread = [one.usb_id for one in present if one.serial_number is None]
        hint = f"; a serial number that is not shown could not be read: {udev_rule(unread[0])}" if unread else ""
        several = f": name one by its place, such as --source {named}" if len(fitting) > 1 else ""
        if known.device is not None and wanted in [one.serial_number for one in present]:
            several = f", and others have the same: plug it in where it was, at {known.device.place}"
        raise NoDeviceError(
            f"{len(fitting) or 'no'} gs_usb adapter with serial number {wanted}, expected one{several}. {seen}{hint}"
        )
    if not found:
        raise NoDeviceError(f"no gs_usb adapter found: plug one in, or name another source. {seen}")
    raise NoDeviceError(f"{len(found)} gs_usb adapters found: name one, such as --source {named}. {seen}")


def source_name(device: GsUsbDevice, present: Sequence[GsUsbDevice]) -> str | None:
    """Return the source that selects one of the present adapters: by serial number if that is its own, else by place.

    None where it has neither.
    """
    own = device.serial_number is not None and [one.serial_number for one in present].count(device.serial_number) == 1
    name = device.serial_number if own else device.place
    return name and f"gs_usb:{name}"


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
