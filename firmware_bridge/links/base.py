"""What every link offers; adding a link is one file with this interface, and its form in `parse`."""

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple, Protocol

from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan


class Wait(NamedTuple):
    """When to call `read(0)` next: once the descriptor is readable, and after `longest_s` in any case.

    Attributes:
        descriptor: of the open link.
        longest_s: in [s].
    """

    descriptor: int
    longest_s: float


SourceKind = Literal["device", "replay", "emulated"]
NoticeKind = Literal["lost", "silent", "back", "trouble", "well", "note"]


class Notice(NamedTuple):
    """What a link has to tell beside its scans.

    Attributes:
        time_ns: monotonic time, in [ns].
        kind: "lost", the link is gone; "silent", it is there and gives no scan; "back", it gives scans again, and
            whatever was known of its sensors' readings is old; "trouble", it works, but reports something; "well", it
            no longer does; "note", what is to be known of a recording.
        source: name of the link.
        text: in a user's words.
        sensors: how the names of the sensors begin that it is about.
    """

    time_ns: int
    kind: NoticeKind
    source: str
    text: str
    sensors: str = ""


class SerialLine(NamedTuple):
    """The serial port of a link, and the speed that it was opened with in [bit/s]."""

    port: str
    baud: int


class Link(Protocol):
    """A source of scans. Inherit it to get what is optional.

    A link opens on `__enter__` and closes on `__exit__`. One that was lost may be opened again after it was closed,
    any number of times: it then finds its device again, and forgets what it had half read.

    Attributes:
        name: the source as a user would write it, such as "slcan:/dev/ttyUSB0".
        kind: "device" for hardware, "replay" for a file, "emulated" for a pretended device.
        ended: no more scans will come, because the source is finite and is through.
        trouble: what the device reports that the user must know of, in plain words; None while all is well.
        patient: it waits for its reader, and has one scan for each `read`, of whatever time: nothing can be overtaken.
        unix_offset_ns: of a patient link: added to the time of a scan gives [ns] since 1970; None where that is not
            known.
        origin: of a recording, however often it was played and recorded again: what kind of source its scans come from;
            None where that is not known, or it is `kind`.
        mountings: of sensors whose scans come with their taxels in place, as a recording has them: how they sat.
    """

    name: str
    kind: SourceKind
    ended: bool
    trouble: str | None = None
    patient: bool = False
    unix_offset_ns: int | None = None
    origin: SourceKind | None = None
    mountings: Mapping[str, Mounting] = MappingProxyType({})

    def __enter__(self) -> "Link": ...

    def __exit__(self, *exc_info: object) -> None: ...

    def read(self, timeout_s: float) -> list[Scan]:
        """Scans that closed since the last call; waits at most `timeout_s` for the first.

        Raises:
            LinkLostError: the link was there and is gone.
        """
        ...

    def wait_on(self) -> Wait | None:
        """Return what to wait for before `read(0)`, which then does not wait; None where a read may take long.

        A link that waits for something else than a descriptor, or is about to open, takes a thread of its own.
        """
        return None

    def notices(self) -> list[Notice]:
        """What there is to tell since the last call, all of it from before the scans that the last `read` gave."""
        return []

    def counters(self) -> dict[str, int]:
        """What was received, skipped and missed so far, by name; also after it was closed."""
        ...

    def can_ids(self) -> frozenset[int]:
        """Return the standard CAN ids that came so far, of whatever device; none where the link sees no ids."""
        return frozenset()

    def serial_line(self) -> SerialLine | None:
        """Return the serial line of an open link; None where it has none."""
        return None


def one_origin(origins: Iterable[SourceKind | None]) -> SourceKind | None:
    """Of what is played together: one that is emulated makes all of it so; else what all of them are."""
    found = set(origins)
    if "emulated" in found:
        return "emulated"
    return found.pop() if len(found) == 1 else None
