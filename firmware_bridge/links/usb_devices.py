"""USB devices: recognition of one that was plugged in again, and the names of the programs that hold one open."""

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, Generic, Protocol, TypeVar

PROC_ROOT: Final = Path("/proc")


class UsbDevice(Protocol):
    """Device as seen by a link that looks for it."""

    @property
    def identity(self) -> tuple[object, ...] | None:
        """Its identity wherever it is plugged in; None without a serial number."""
        ...

    @property
    def place(self) -> str | None:
        """Its socket, or what comes next to it."""
        ...


_Device = TypeVar("_Device", bound=UsbDevice)


class Recognised(Generic[_Device]):
    """Device that a link has opened, known by its identity, or by its place once two were seen to share that.

    Attributes:
        device: as it was seen last; None before, and without an identity.
    """

    def __init__(self) -> None:
        self.device: _Device | None = None
        self._shared = False

    def learn(self, device: _Device, present: Sequence[_Device]) -> None:
        """Remember a device among all that are present."""
        self.device = None if device.identity is None else device
        self._shared |= [one.identity for one in present].count(device.identity) > 1

    def find(self, present: Sequence[_Device]) -> _Device | None:
        """Return the remembered device among those that are present; None if it is missing, or cannot be told."""
        known = self.device
        same = [one for one in present if known is not None and one.identity == known.identity]
        self._shared |= len(same) > 1
        if self._shared and known is not None:
            same = [one for one in same if one.place == known.place]
        self.device = same[0] if len(same) == 1 else known
        return same[0] if len(same) == 1 else None


def holders(path: str, proc_root: Path = PROC_ROOT) -> list[str]:
    """List the other processes that have it open; those of other users are visible to root alone."""
    real_path = Path(path).resolve()
    return [
        f"{_name(process)} ({process.name})"
        for process in sorted(proc_root.glob("[0-9]*"), key=lambda process: int(process.name))
        if process.name != str(os.getpid()) and real_path in _opened(process)
    ]


def in_use(path: str, proc_root: Path = PROC_ROOT) -> str:
    """Return who holds a serial port, and what to do.

    ModemManager is root's, so that nobody else sees what it holds; it tries each new port for some seconds.
    """
    held = ", ".join(holders(path, proc_root)) or "this program, or one of another user"
    return (
        f"in use by {held}: end the program that holds it, such as slcand, xela_server or another edge-sr. After a "
        "plug-in it may be ModemManager, which lets go after some seconds: try again, or keep it away by the udev rule "
        'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6015", ENV{ID_MM_DEVICE_IGNORE}="1" with the adapter\'s own ids'
    )


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
