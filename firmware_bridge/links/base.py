"""What every link offers; adding a link is one file with this interface."""

from typing import Literal, Protocol

from firmware_bridge.scan import Scan

SourceKind = Literal["device", "replay", "emulated"]


class Link(Protocol):
    """A source of scans.

    A link opens on `__enter__` and closes on `__exit__`.

    Attributes:
        name: the source as a user would write it, such as "slcan:/dev/ttyUSB0".
        kind: "device" for hardware, "replay" for a file, "emulated" for a pretended device.
        ended: no more scans will come, because the source is finite and is through.
    """

    name: str
    kind: SourceKind
    ended: bool

    def __enter__(self) -> "Link": ...

    def __exit__(self, *exc_info: object) -> None: ...

    def read(self, timeout_s: float) -> list[Scan]:
        """Scans that closed since the last call; waits at most `timeout_s` for the first.

        Raises:
            LinkLostError: the link was there and is gone.
        """
        ...

    def counters(self) -> dict[str, int]:
        """What was received, skipped and missed so far, by name."""
        ...
