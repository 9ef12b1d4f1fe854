"""What every link offers; adding a link is one file with this interface, and its form in `source`."""

from typing import Literal, NamedTuple, Protocol

from firmware_bridge.scan import Scan

SourceKind = Literal["device", "replay", "emulated"]
NoticeKind = Literal["lost", "silent", "back", "trouble", "well"]


class Notice(NamedTuple):
    """What a link has to tell beside its scans.

    Attributes:
        time_ns: monotonic time, in [ns].
        kind: "lost", the link is gone; "silent", it is there and gives no scan; "back", it gives scans again, and
            whatever was known of its sensors' readings is old; "trouble", it works, but reports something; "well", it
            no longer does.
        source: name of the link.
        text: in a user's words.
        sensors: how the names of the sensors begin that it is about.
    """

    time_ns: int
    kind: NoticeKind
    source: str
    text: str
    sensors: str = ""


class Link(Protocol):
    """A source of scans. Inherit it to get what is optional.

    A link opens on `__enter__` and closes on `__exit__`. One that was lost may be opened again after it was closed,
    any number of times: it then finds its device again, and forgets what it had half read.

    Attributes:
        name: the source as a user would write it, such as "slcan:/dev/ttyUSB0".
        kind: "device" for hardware, "replay" for a file, "emulated" for a pretended device.
        ended: no more scans will come, because the source is finite and is through.
        trouble: what the device reports that the user must know of, in plain words; None while all is well.
    """

    name: str
    kind: SourceKind
    ended: bool
    trouble: str | None = None

    def __enter__(self) -> "Link": ...

    def __exit__(self, *exc_info: object) -> None: ...

    def read(self, timeout_s: float) -> list[Scan]:
        """Scans that closed since the last call; waits at most `timeout_s` for the first.

        Raises:
            LinkLostError: the link was there and is gone.
        """
        ...

    def notices(self) -> list[Notice]:
        """What there is to tell since the last call, all of it from before the scans that the last `read` gave."""
        return []

    def counters(self) -> dict[str, int]:
        """What was received, skipped and missed so far, by name."""
        ...
