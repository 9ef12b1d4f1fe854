"""Serial ports of this machine: a sensor's adapter among them, the same one plugged in again, and who holds one."""

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, Generic, NamedTuple, Protocol, TypeVar

from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from firmware_bridge.errors import NoDeviceError, as_typed
from firmware_bridge.links.known_adapters import FTDI_X, SLCAN_ADAPTERS

LATENCY_ROOT: Final = Path("/sys/bus/usb-serial/devices")
NO_PERMISSION: Final = (
    "no permission: add the user to the group that owns it (often: sudo usermod -aG dialout $USER), log in again"
)


class Port(NamedTuple):
    """One serial port."""

    path: str  # path of the port, such as /dev/ttyUSB0
    usb_id: tuple[int, int] | None  # vendor and product; None for a port that is not on USB
    serial_number: str | None  # serial number of the USB device, which several ports may share
    description: str  # description for the user; `product` and `manufacturer` are as the device reports them
    product: str | None = None
    manufacturer: str | None = None
    interface: str | None = None  # port of a device with several ones, such as "1.0"
    location: str | None = None  # bus and sockets of the USB device, such as "1-2.3"

    @property
    def identity(self) -> tuple[object, ...] | None:
        """Its identity at any socket; None without a serial number."""
        return None if self.serial_number is None else (self.usb_id, self.serial_number, self.interface)

    @property
    def place(self) -> str:
        """Socket of the USB device, or where that is not known the path."""
        return self.location or self.path

    @property
    def adapter(self) -> str | None:
        """Name of the adapter, if it looks like one that is used with these sensors; None otherwise.

        For a chip that many devices have, the texts of the device decide, if there are any.
        """
        words = " ".join(word for word in (self.product, self.manufacturer) if word)
        can = re.search(r"\bCAN\b|CAN-?USB|USB-?CAN", words)
        if self.usb_id is None or (self.usb_id == FTDI_X and words and not can):
            return None
        return SLCAN_ADAPTERS.get(self.usb_id)

    def __str__(self) -> str:
        usb = f" {self.usb_id[0]:04x}:{self.usb_id[1]:04x}" if self.usb_id else ""
        serial = f" serial={self.serial_number}" if self.serial_number else ""
        return f"{self.path}{usb}{serial} ({self.adapter or self.description})"


def serial_ports() -> list[Port]:
    """List all serial ports of this machine, by path."""
    listed: list[ListPortInfo] = []
    for _ in range(3):
        # pyserial converts texts to numbers that it could not read from a device that is being unplugged.
        with suppress(TypeError, ValueError, OSError):
            listed = list(list_ports.comports())
            break
    ports: list[Port] = []
    for info in listed:
        usb_id = None if info.vid is None or info.pid is None else (info.vid, info.pid)
        place, _, interface = (info.location or "").partition(":")
        texts = (info.product or None, info.manufacturer or None, interface or None, place or None)
        ports.append(Port(info.device, usb_id, info.serial_number or None, info.description, *texts))
    return sorted(ports)


def latency_timer_ms(port: str) -> int | None:
    """Return the time for which the driver of a port lets bytes wait, in [ms]; None where it is not shown.

    Source: Linux, drivers/usb/serial/ftdi_sio.c, latency_timer_show; 1 is shown while low latency was asked for.
    """
    try:
        text = (LATENCY_ROOT / Path(port).resolve().name / "latency_timer").read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return None
    return int(text) if text.isdigit() else None


def find_adapter(ports: Sequence[Port]) -> Port:
    """Return the only recognised adapter among `ports`; raises NoDeviceError if there is none, or several."""
    adapters = [port for port in ports if port.adapter is not None]
    if len(adapters) == 1:
        return adapters[0]
    if adapters:
        names = ", ".join(f"{port.adapter} at {port.path}" for port in adapters)
        raise NoDeviceError(
            f"{len(adapters)} adapters found, {names}: name one, {_example(adapters[0])}. {_seen(ports)}"
        )
    raise NoDeviceError(
        f"no known adapter found: name a port, --source slcan:PORT, or try --source demo. {_seen(ports)}"
    )


def find_by_serial(serial_number: str, ports: Sequence[Port]) -> Port:
    """Return the port whose USB device has this serial number; raises NoDeviceError unless there is one."""
    matching = [port for port in ports if port.serial_number == serial_number]
    if len(matching) != 1:
        count = len(matching) or "no"
        raise NoDeviceError(
            f"{count} port with serial number {serial_number}, expected one"
            f"{': name one by its path' if matching else ''}. {_seen(ports)}"
        )
    return matching[0]


class _UsbDevice(Protocol):
    @property
    def identity(self) -> tuple[object, ...] | None: ...  # None without a serial number

    @property
    def place(self) -> str | None: ...  # its socket, or what comes next to it


_Device = TypeVar("_Device", bound=_UsbDevice)


class Recognised(Generic[_Device]):
    """Device that a link has opened, known by its identity, or by its place once two were seen to share that."""

    def __init__(self) -> None:
        self.device: _Device | None = None  # as it was seen last; None before, and without an identity
        self._shared = False

    def learn(self, device: _Device, present: Sequence[_Device]) -> None:
        """Remember a device among all that are present."""
        self.device = None if device.identity is None else device
        self._shared |= [other.identity for other in present].count(device.identity) > 1

    def find(self, present: Sequence[_Device]) -> _Device | None:
        """Return the remembered device among those that are present; None if it is missing, or cannot be told."""
        remembered = self.device
        if remembered is None:
            return None
        same = [device for device in present if device.identity == remembered.identity]
        self._shared |= len(same) > 1
        if self._shared:
            same = [device for device in same if device.place == remembered.place]
        if len(same) != 1:
            return None
        self.device = same[0]
        return same[0]


class PluggedAdapter:
    """Adapter that is found again at any port by its USB serial number, unless the user named its place.

    A name that is a link, such as those in /dev/serial/by-path, is a place, and is followed; one of the kernel's, such
    as /dev/ttyUSB0, changes when a plug is pulled.
    """

    def __init__(self, path: str) -> None:
        """Identify it by the path of its port, until `find` has its serial number."""
        self._path = path
        self._recognised: Recognised[Port] = Recognised()

    def find(self, ports: Sequence[Port]) -> str:
        """Return the path of its port among the present ones, or the first path if it has no serial number.

        Raises NoDeviceError where it is missing, or cannot be told from another one.
        """
        adapter = self._recognised.device
        if adapter is None or Path(self._path).is_symlink():
            real_path = Path(self._path).resolve()
            port = next((port for port in ports if Path(port.path).resolve() == real_path), None)
            if port is None and adapter is None:  # a port that is not listed
                return self._path
            if port is None:
                raise NoDeviceError(f"no adapter at {self._path}: plug it in again. {_seen(ports)}")
            self._recognised.learn(port, ports)
            return port.path
        port = self._recognised.find(ports)
        if port is None:
            raise NoDeviceError(
                f"no adapter that is surely the one with serial number {adapter.serial_number} that was at "
                f"{adapter.path}: plug it in where it was. {_seen(ports)}"
            )
        return port.path


def holders(path: str) -> list[str]:
    """List the other processes that have it open; those of other users are visible to root alone."""
    real_path = Path(path).resolve()
    return [
        f"{_name(process)} ({process.name})"
        for process in sorted(Path("/proc").glob("[0-9]*"), key=lambda process: int(process.name))
        if process.name != str(os.getpid()) and real_path in _opened(process)
    ]


def in_use(path: str) -> str:
    """Return who holds a serial port, and what to do."""
    # ModemManager is root's, so that nobody else sees what it holds; it tries each new port for some seconds.
    held = ", ".join(holders(path)) or "this program, or one of another user"
    return (
        f"in use by {held}: end the program that holds it, such as slcand, xela_server or another edge-sr. After a "
        "plug-in it may be ModemManager, which lets go after some seconds: try again, or keep it away by the udev rule "
        'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6015", ENV{ID_MM_DEVICE_IGNORE}="1" with the adapter\'s own ids'
    )


def _example(port: Port) -> str:
    named = f"serial={port.serial_number}" if port.serial_number else port.path
    return f"such as --source {as_typed(f'slcan:{named}')}, or try --source demo"


def _seen(ports: Sequence[Port]) -> str:
    return f"Serial ports seen: {'; '.join(map(str, ports)) or 'none'}"


def _name(process: Path) -> str:
    with suppress(OSError):
        return (process / "comm").read_text(errors="replace").strip()
    return "a process"


def _opened(process: Path) -> set[Path]:
    opened: set[Path] = set()
    with suppress(OSError):  # the process has gone, or is another user's
        for descriptor in (process / "fd").iterdir():
            with suppress(OSError):  # closed meanwhile
                opened.add(descriptor.readlink())
    return opened
