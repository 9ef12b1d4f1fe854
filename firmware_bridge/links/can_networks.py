"""The CAN networks that the kernel has, as sysfs tells of them, and how one is brought up. Opens nothing."""

from pathlib import Path
from typing import Final, NamedTuple

from firmware_bridge.can.gs_usb import BITRATE_BIT_S

SYS_ROOT: Final = Path("/sys")
_CAN_TYPE: Final = "280"
"""ARPHRD_CAN."""
_UP: Final = 1
"""IFF_UP."""
_PRETENDED: Final = ("vcan", "vxcan")


class CanNetwork(NamedTuple):
    """One network.

    Attributes:
        name: such as can0.
        up: whether frames can come.
        driver: of its adapter; None for what slcand or vcan makes, which hangs on no device.
    """

    name: str
    up: bool
    driver: str | None

    @property
    def problem(self) -> str | None:
        """That it is down, and what to do; the kernel leaves a controller bus-off unless it is told for how long."""
        if self.up:
            return None
        how = f" type can bitrate {BITRATE_BIT_S} restart-ms 100" if self.driver else ""
        return f"is down: sudo ip link set {self.name} up{how}"


def can_networks(sys_root: Path = SYS_ROOT) -> list[CanNetwork]:
    """The CAN networks there are, by name.

    Args:
        sys_root: where sysfs is.
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
    """Whether a network of this name has no wire, and whoever speaks there only pretends."""
    return name.startswith(_PRETENDED)


def _text(path: Path) -> str | None:
    try:
        return path.read_text().strip()
    except OSError:
        return None
