"""Which serial ports there are, and which of them is a sensor's adapter."""

from collections.abc import Sequence
from typing import Final, NamedTuple

from serial.tools import list_ports

from firmware_bridge.errors import NoDeviceError

KNOWN_ADAPTERS: Final = {
    (0x0403, 0x6015): "VScom USB-CAN Plus",  # what XELA ships; other FTDI devices have this id as well
    (0xAD50, 0x60C4): "CANable, slcan firmware",  # the id of CANtact, from which it comes
    (0x16D0, 0x117E): "CANable 2, slcan firmware",
}


class Port(NamedTuple):
    """One serial port. `usb_id` is vendor and product, or None for a port that is not on USB."""

    path: str
    usb_id: tuple[int, int] | None
    serial_number: str | None
    description: str

    @property
    def adapter(self) -> str | None:
        """Name of the adapter, if it is one known to be used with these sensors."""
        return KNOWN_ADAPTERS.get(self.usb_id) if self.usb_id else None

    def __str__(self) -> str:
        usb = f" {self.usb_id[0]:04x}:{self.usb_id[1]:04x}" if self.usb_id else ""
        serial = f" serial={self.serial_number}" if self.serial_number else ""
        return f"{self.path}{usb}{serial} ({self.adapter or self.description})"


def serial_ports() -> list[Port]:
    """All serial ports of this machine, by path."""
    return sorted(
        Port(
            info.device,
            None if info.vid is None or info.pid is None else (info.vid, info.pid),
            info.serial_number or None,
            info.description,
        )
        for info in list_ports.comports()
    )


def find_adapter(ports: Sequence[Port]) -> Port:
    """The one known adapter among `ports`.

    Of several kinds the first in KNOWN_ADAPTERS wins; of several of one kind none does.

    Raises:
        NoDeviceError: there is none, or there are several.
    """
    for name in KNOWN_ADAPTERS.values():
        found = [port for port in ports if port.adapter == name]
        if len(found) == 1:
            return found[0]
        if found:
            raise NoDeviceError(f"{len(found)} adapters found: name one, {_example(found[0])}. {_seen(ports)}")
    raise NoDeviceError(
        f"no known adapter found: name a port, --source slcan:PORT, or try --source demo. {_seen(ports)}"
    )


def find_by_serial(serial_number: str, ports: Sequence[Port]) -> Port:
    """The port whose USB device has this serial number.

    Raises:
        NoDeviceError: there is none, or there are several.
    """
    found = [port for port in ports if port.serial_number == serial_number]
    if len(found) != 1:
        count = len(found) or "no"
        raise NoDeviceError(f"{count} port with serial number {serial_number}, expected one. {_seen(ports)}")
    return found[0]


def _example(port: Port) -> str:
    named = f"serial={port.serial_number}" if port.serial_number else port.path
    return f"such as --source slcan:{named}, or try --source demo"


def _seen(ports: Sequence[Port]) -> str:
    return f"Serial ports seen: {'; '.join(map(str, ports)) or 'none'}"
