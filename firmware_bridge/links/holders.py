"""Names of the programs that hold a device open, from procfs."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Final

PROC_ROOT: Final = Path("/proc")


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
