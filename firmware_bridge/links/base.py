"""Interface of every link; a new link is one file with this interface, and its form in the registry (`registry.py`)."""

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple, Protocol

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.poses import PadPose, TimedPose
from firmware_bridge.scans.frame_scans import FrameScans
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan

SourceKind = Literal["device", "replay", "emulated"]
NoticeKind = Literal["lost", "silent", "back", "trouble", "well", "note"]


class Notice(NamedTuple):
    """Message of a link in addition to its scans.

    Attributes:
        time_ns: monotonic time, in [ns].
        kind: "lost", the link is gone; "silent", it is there and gives no scan; "back", it gives scans again, and
            all earlier readings of its sensors are old; "trouble", it works, but reports trouble; "well", it no
            longer does; "note", a remark on a recording or on time stamps.
        text: message to the user.
        sensors: common prefix of the names of the sensors concerned.
    """

    time_ns: int
    kind: NoticeKind
    text: str
    sensors: str = ""


class SerialLine(NamedTuple):
    """The serial port of a link, and the speed that it was opened with in [bit/s]."""

    port: str
    baud: int


class Link(Protocol):
    """Source of scans. A subclass inherits the optional parts.

    A link opens on `__enter__` and closes on `__exit__`. One that was lost may be opened again after it was closed,
    any number of times: it then searches for its device again, and discards open scans.

    Attributes:
        name: the source as a user would write it, such as "slcan:/dev/ttyUSB0".
        kind: "device" for hardware, "replay" for a file, "emulated" for an emulated device.
        ended: True once a finite source has no more scans.
        trouble: trouble of the device to report to the user; None if there is none.
        stamps_dropped: True once the device's time stamps have shown that they are no clock.
        patient: True where the link waits for its reader, and returns one scan for each `read`, whatever its time.
        unix_offset_ns: offset from the times of a patient link's scans to [ns] since 1970; None if it is not available.
        origin: kind of source of a recording's scans, however often it was played and recorded again; None if it is
            not available, or equals `kind`.
        length_s: length of a recording, in [s]; None of anything else.
        mountings: mountings of the sensors whose scans come with their taxels in place, as in a recording.
        states_poses: True where poses of the sensors come with the scans.
        prefix: beginning of the names of all its sensors: what the user calls it, and a slash.
        lasts: True where it is opened again after a loss; a recording, or a demo, is over then.
        fetches: True if the system keeps for a while what is not read, and `fetch` takes it.
    """

    name: str
    kind: SourceKind
    ended: bool = False
    trouble: str | None = None
    stamps_dropped: bool = False
    patient: bool = False
    unix_offset_ns: int | None = None
    origin: SourceKind | None = None
    length_s: float | None = None
    mountings: Mapping[str, Mounting] = MappingProxyType({})
    states_poses: bool = False
    prefix: str = ""
    lasts: bool = True
    fetches: bool = False

    def __enter__(self) -> "Link": ...

    def __exit__(self, *exc_info: object) -> None: ...

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; waits at most `timeout_s` for the first.

        Raises:
            LinkLostError: the link was there and is gone.
        """
        ...

    def fetch(self) -> None:
        """Take what the system has received, without waiting; the next `read` makes scans of it.

        The thread that reads may call it, as often as it likes, where `fetches` is True.
        """

    def notices(self) -> list[Notice]:
        """Return the notices since the last call, all from before the scans that the last `read` returned."""
        return []

    def poses(self) -> list[TimedPose]:
        """Return the poses since the last call, all to be used for the scans that the last `read` returned."""
        return []

    def steer(self) -> Callable[[PadPose | None], None] | None:
        """Return the function that takes where to tap next, None for no proposal; None where there is no robot."""
        return None

    def counters(self) -> dict[str, int]:
        """Return the counts of data received, skipped and missed so far, by name; also after it was closed."""
        ...

    def can_ids(self) -> frozenset[int]:
        """Return the standard CAN ids received so far, of any device; empty where the link sees no ids."""
        return frozenset()

    def serial_line(self) -> SerialLine | None:
        """Return the serial line of an open link, None if it has no such line."""
        return None


def not_open() -> ValueError:
    """Return the error of a link that is read before it was opened, or after it was closed."""
    return ValueError("the link is not open: use it in a with statement")


def one_origin(origins: Iterable[SourceKind | None]) -> SourceKind | None:
    """Return the common origin of recordings played together: "emulated" if one is; None if they differ otherwise."""
    found = set(origins)
    if "emulated" in found:
        return "emulated"
    return found.pop() if len(found) == 1 else None


LONG_UNREAD_NS: Final = 50_000_000
"""Time without a read from which the process counts as stalled, in [ns]: more than twice the longest wait of a link."""


class Unread:
    """Tracker of the latest time at which a link was empty.

    Attributes:
        empty_ns: latest monotonic time at which its reader saw it empty, in [ns]; None before that.
    """

    def __init__(self) -> None:
        self.empty_ns: int | None = None
        self._stall_ns = 0, 0

    def found(self, begun_ns: int, ended_ns: int) -> None:
        """Note that data came during a read from `begun_ns` to `ended_ns`, in [ns] of monotonic time."""
        if self.empty_ns is not None and begun_ns - self.empty_ns > LONG_UNREAD_NS:
            return  # the process stalled: until all data is read, the duration of a read is no evidence
        if ended_ns - begun_ns > 1_000_000:  # so no data was waiting when it began
            self.empty_ns = begun_ns

    def mark(self, scans: Sequence[Scan], time_ns: int, clock_begun_ns: int | None) -> list[Scan]:
        """Return the scans read at `time_ns` [ns], each with the longest time it may have waited, if that is long.

        A clock that was set, at `clock_begun_ns`, by data that may have waited has no reliable times: it gives none.
        """
        if self.empty_ns is not None and time_ns - self.empty_ns > LONG_UNREAD_NS:
            self._stall_ns = self.empty_ns, time_ns
        begun_ns, ended_ns = self._stall_ns
        marked: list[Scan] = []
        for scan in scans:  # one that was read then may come only now
            if begun_ns + LONG_UNREAD_NS < scan.time_ns <= ended_ns:
                no_clock = clock_begun_ns is not None and clock_begun_ns >= begun_ns
                device_ns = None if no_clock else scan.device_ns
                marked.append(replace(scan, unread_ns=scan.time_ns - begun_ns, device_ns=device_ns))
            else:
                marked.append(scan)
        return marked


class FrameLink(Link):
    """Link to an adapter that gives frames one by one, which is asked for them until a scan closes."""

    def __init__(self, scans: FrameScans, triggers: Sequence[CanFrame], clock_ns: Callable[[], int]) -> None:
        self._stages = scans
        self._triggers = tuple(triggers)
        self._clock_ns = clock_ns
        self._unread = Unread()
        self._counting = threading.Lock()  # counters are of whole pieces, whichever thread asks

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; raises LinkLostError if the adapter is gone."""
        now_ns = self._clock_ns()
        end_ns = now_ns + int(timeout_s * 1e9)
        while True:
            begun_ns, scans = self._clock_ns(), list[Scan]()
            piece = self._fetch(max(0.0, (end_ns - now_ns) / 1e9))
            now_ns = self._clock_ns()
            if piece is None:
                self._unread.empty_ns = min(now_ns, end_ns)  # this thread may not have run for long after the wait
            else:
                self._unread.found(begun_ns, now_ns)
                with self._counting:
                    fed = self._take(piece, now_ns)
                scans = self._unread.mark(fed, now_ns, self._stages.clock.begun_ns)
            self.trouble = self._stages.errors.trouble(now_ns)
            self.stamps_dropped |= self._stages.clock.dropped
            if scans or now_ns >= end_ns:
                return scans

    def can_ids(self) -> frozenset[int]:
        """Return the standard CAN ids received so far."""
        return self._stages.can_ids

    def _fetch(self, timeout_s: float) -> Any:
        """Return the next piece, None if none came in time."""
        raise NotImplementedError

    def _take(self, piece: Any, time_ns: int) -> list[Scan]:
        """Return the scans that close within a piece."""
        raise NotImplementedError
