"""CAN networks of the kernel, as sysfs lists them, and the command that brings one up. Opens no device."""

from pathlib import Path
from typing import Final, NamedTuple

from firmware_bridge.can.gs_usb import BITRATE_BIT_S

SYS_ROOT: Final = Path("/sys")
_CAN_TYPE: Final = "280"
"""Type of a CAN network in sysfs, ARPHRD_CAN."""
_UP: Final = 1
"""Flag of a network that is up, IFF_UP."""
_PRETENDED: Final = ("vcan", "vxcan")


class CanNetwork(NamedTuple):
    """One CAN network.

    Attributes:
        name: name of the network, such as can0.
        up: True if frames can come.
        driver: driver of its adapter; None for a network of slcand or vcan, which has no device.
    """

    name: str
    up: bool
    driver: str | None

    @property
    def problem(self) -> str | None:
        """Message that the network is down, with the command that brings it up; None if it is up.

        It sets restart-ms, since the kernel otherwise leaves a controller in bus-off.
        """
        if self.up:
            return None
        how = f" type can bitrate {BITRATE_BIT_S} restart-ms 100" if self.driver else ""
        return f"is down: sudo ip link set {self.name} up{how}"


def can_networks(sys_root: Path = SYS_ROOT) -> list[CanNetwork]:
    """List the CAN networks of this machine, by name.

    Args:
        sys_root: folder of sysfs.
    """
    return [
        CanNetwork(
            network.name,
            bool(int(_text(network / "flags") or "0", 16) & _UP),
            (network / "device/driver").resolve().name if (network / "device/driver").exists() else None,
        )
        for network in sorted((sys_root / "class/net").glob("*"))
        if _text(network / "type") == _CAN_TYPE
    ]


def is_pretended(name: str) -> bool:
    """Return True if a network of this name has no wire, so that every device on it is emulated."""
    return name.startswith(_PRETENDED)


def _text(path: Path) -> str | None:
    try:
        return path.read_text().strip()
    except OSError:
        return None
