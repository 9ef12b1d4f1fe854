"""Discovery of devices that may lead to a sensor on this machine, and of their problems. Opens and sends nothing."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal, NamedTuple

from firmware_bridge.can.gs_usb import BITRATE_BIT_S
from firmware_bridge.errors import DeviceError, as_typed
from firmware_bridge.links.serial_ports import NO_PERMISSION, Port, holders, serial_ports

SYS_ROOT: Final = Path("/sys")


class CanNetwork(NamedTuple):
    """One CAN network; `driver` is None for a network of slcand or vcan, which has no device."""

    name: str
    up: bool
    driver: str | None

    @property
    def problem(self) -> str | None:
        """Message that the network is down, with the command that brings it up; None if it is up."""
        if self.up:
            return None
        # Without restart-ms the kernel leaves a controller in bus-off.
        how = f" type can bitrate {BITRATE_BIT_S} restart-ms 100" if self.driver else ""
        return f"is down: sudo ip link set {as_typed(self.name)} up{how}"


def can_networks(sys_root: Path = SYS_ROOT) -> list[CanNetwork]:
    """List the CAN networks of this machine, by name."""
    return [
        CanNetwork(
            network.name,
            bool(int(_text(network / "flags") or "0", 16) & 1),  # IFF_UP
            (network / "device/driver").resolve().name if (network / "device/driver").exists() else None,
        )
        for network in sorted((sys_root / "class/net").glob("*"))
        if _text(network / "type") == "280"  # ARPHRD_CAN
    ]


def _text(path: Path) -> str | None:
    try:
        return path.read_text().strip()
    except OSError:
        return None


class Found(NamedTuple):
    """One port, adapter or network interface."""

    kind: Literal["serial", "gs_usb", "socketcan"]  # kind of device, which determines its link
    path: str  # path of a port; bus and address of a USB device; name of an interface
    usb_id: str | None  # vendor and product, "0403:6015"
    serial_number: str | None  # serial number of the USB device
    looks_like: str  # description of the device
    adapter: bool  # True if sensors are usually connected by such a device
    source: str  # argument of --source that selects it
    problems: tuple[str, ...]  # its problems with their remedies, a line each


def devices() -> tuple[list[Found], list[str]]:
    """List all serial ports, gs_usb adapters and CAN interfaces, and the reasons why some could not be listed."""
    notes: list[str] = []
    gs_usb: list[Found] = []
    try:
        gs_usb = _gs_usb_adapters()
    except DeviceError as error:
        notes.append(str(error))
    return [*serial_devices(serial_ports()), *gs_usb, *can_interfaces()], notes


def serial_devices(ports: Sequence[Port]) -> list[Found]:
    """Describe the serial ports, in their order."""
    serials = [port.serial_number for port in ports]
    listed: list[Found] = []
    for port in ports:
        words = " by ".join(word for word in (port.product or port.description, port.manufacturer) if word)
        alone = port.serial_number is not None and serials.count(port.serial_number) == 1
        problems: list[str] = []
        if not os.access(port.path, os.R_OK | os.W_OK):
            problems.append(NO_PERMISSION)
        if held := holders(port.path):
            problems.append(f"held by {', '.join(held)}: end it first")
        listed.append(
            Found(
                "serial",
                port.path,
                None if port.usb_id is None else _usb_id(port.usb_id),
                port.serial_number,
                port.adapter or f"{words}: no known adapter",
                port.adapter is not None,
                f"slcan:serial={port.serial_number}" if alone else f"slcan:{_by_place(port.path)}",
                tuple(problems),
            )
        )
    return listed


def can_interfaces(sys_root: Path = SYS_ROOT) -> list[Found]:
    """List the CAN interfaces of the kernel, by name."""
    listed: list[Found] = []
    for network in can_networks(sys_root):
        name, driver = network.name, network.driver
        problems = () if network.problem is None else (network.problem,)
        looks_like = f"CAN interface, {f'driver {driver}' if driver else 'virtual or of slcand'}"
        listed.append(Found("socketcan", name, None, None, looks_like, True, f"can:socketcan:{name}", problems))
    return listed


def _gs_usb_adapters() -> list[Found]:
    from firmware_bridge.links.gs_usb_link import gs_usb_devices, source_name, udev_rule  # only this needs libusb

    present = gs_usb_devices()
    return [
        Found(
            "gs_usb",
            adapter.where,
            _usb_id(adapter.usb_id),
            adapter.serial_number,
            adapter.product or "gs_usb adapter",
            True,
            source_name(adapter, present) or "gs_usb",
            () if adapter.serial_number or adapter.product else (f"no permission: {udev_rule(adapter.usb_id)}",),
        )
        for adapter in present
    ]


def _by_place(path: str) -> str:
    """Return the link to a port that is named by its place; its path where there is none."""
    links = sorted(Path("/dev/serial/by-path").glob("*"))
    return next((str(link) for link in links if link.resolve() == Path(path).resolve()), path)


def _usb_id(usb_id: tuple[int, int]) -> str:
    return f"{usb_id[0]:04x}:{usb_id[1]:04x}"
