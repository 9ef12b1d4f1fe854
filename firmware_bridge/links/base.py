"""Interface of every link, and the reader that opens one again when it is lost or silent.

A new link is one file with this interface, and its form in the registry (`registry.py`). The reader is also the border
where the errors of drivers and of network libraries stop: each is the loss of one link.
"""

import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal, NamedTuple, Protocol, Self, TypeVar

from firmware_bridge.errors import BridgeError, DeviceError, LinkLostError
from firmware_bridge.poses import TimedPose
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import LINK_SILENT_S

SourceKind = Literal["device", "replay", "emulated"]
NoticeKind = Literal["lost", "silent", "back", "trouble", "well", "note"]

SOON_RETRY_S: Final = 0.5  # pause between tries in the first minute: a link that is back is used within 1 s
LATE_RETRY_S: Final = 2.0
SOON_S: Final = 60.0  # time of an outage with frequent tries; later ones are rarer, to save the robot's processor

_Answer = TypeVar("_Answer")


class Notice(NamedTuple):
    """Message of a link in addition to its scans."""

    time_ns: int  # monotonic time, in [ns]
    # "silent": it is there and gives no scan; "back": it gives scans again, and all earlier readings are old;
    # "trouble": it works, but reports trouble; "well": it no longer does; "note": a remark, as on time stamps
    kind: NoticeKind
    text: str  # message to the user
    sensors: str = ""  # common prefix of the names of the sensors concerned


class Link(Protocol):
    """Source of scans. A subclass inherits the optional parts.

    A link opens on `__enter__` and closes on `__exit__`. One that was lost may be opened again after it was closed,
    any number of times: it then searches for its device again, and discards open scans.
    """

    name: str  # the source as a user would write it, such as "slcan:/dev/ttyUSB0"
    kind: SourceKind
    ended: bool = False  # True once a finite source has no more scans
    trouble: str | None = None  # trouble of the device to report to the user
    stamps_dropped: bool = False  # True once the device's time stamps have shown that they are no clock
    patient: bool = False  # True where it waits for its reader, and each `read` returns one scan, whatever its time
    unix_offset_ns: int | None = None  # offset from the times of a patient link's scans to [ns] since 1970
    # Kind of source of a recording's scans, however often it was played and recorded again; None if it equals `kind`.
    origin: SourceKind | None = None
    length_s: float | None = None  # length of a recording, in [s]
    mountings: Mapping[str, Mounting] = MappingProxyType({})  # of sensors whose taxels are in place already
    states_poses: bool = False  # True where poses of the sensors come with the scans
    prefix: str = ""  # beginning of the names of all its sensors: what the user calls it, and a slash
    lasts: bool = True  # True where it is opened again after a loss; a recording, or a demo, is over then
    fetches: bool = False  # True if the system keeps for a while what is not read, and `fetch` takes it

    def __enter__(self) -> "Link": ...

    def __exit__(self, *exc_info: object) -> None: ...

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; wait at most `timeout_s`; raise a LinkLostError if gone."""
        ...

    def fetch(self) -> None:
        """Take what the system has received, without waiting; the next `read` of the same thread makes scans of it."""

    def notices(self) -> list[Notice]:
        """Return the notices since the last call, all from before the scans that the last `read` returned."""
        return []

    def poses(self) -> list[TimedPose]:
        """Return the poses since the last call, all to be used for the scans that the last `read` returned."""
        return []

    def counters(self) -> dict[str, int]:
        """Return the counts of data received, skipped and missed so far, by name; also after it was closed."""
        ...

    def can_ids(self) -> frozenset[int]:
        """Return the standard CAN ids received so far, of any device; empty where the link sees no ids."""
        return frozenset()

    def serial_line(self) -> tuple[str, int] | None:
        """Return the serial port of an open link and its speed in [bit/s], None if it has no such line."""
        return None


def not_open() -> ValueError:
    """Return the error of a link that is read before it was opened, or after it was closed."""
    return ValueError("the link is not open: use it in a with statement")


LONG_UNREAD_NS: Final = 50_000_000  # without a read the process counts as stalled: over twice the longest wait


class Unread:
    """Tracker of the latest time at which a link was empty."""

    def __init__(self) -> None:
        self.empty_ns: int | None = None  # latest monotonic time at which its reader saw it empty, in [ns]
        self._stall_ns = 0, 0

    def note_data(self, begun_ns: int, ended_ns: int) -> None:
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


class LinkReader:
    """Reader that opens its link again whenever it is lost, and now and then while it is silent."""

    def __init__(
        self,
        link: Link,
        give_up_s: float = 0.0,
        *,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        """Prepare to read a link that is not open yet, and whose first opening must succeed.

        `give_up_s` is the longest outage or silence, in [s]; 0 allows no outage, but any silence. `sleep` returns True
        where reading is to end.
        """
        self.link = link
        self.outages = self.reopenings = 0  # losses and silences so far
        self._give_up_s = give_up_s if link.lasts else 0.0
        self._clock_ns, self._sleep = clock_ns, sleep
        self._entered = False
        self._reported: tuple[str | None, bool] = None, False  # its trouble, and whether its stamps are no clock
        self._notices: list[Notice] = []
        self._lost_ns: int | None = None  # beginning of an outage that has not ended
        self._silent = self._away = False
        self._silent_s = LINK_SILENT_S

    def __enter__(self) -> Self:
        self._guarded(self.link.__enter__)
        self._entered = True
        self._received_ns = self._clock_ns()
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._entered:
            self._entered = False
            with suppress(LinkLostError):  # it was lost anyway, or the run is over
                self._guarded(self.link.__exit__, None, None, None)

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; none while the link is away.

        One that is lost or silent is opened again by the next call; LinkLostError: it was away for longer than allowed.
        """
        if self._away or not self._entered:
            self._reopen()
            return []
        try:
            scans = self._guarded(self.link.read, timeout_s)
        except LinkLostError as error:
            self._lose(f"{error}")
            return []
        if (self.link.trouble, self.link.stamps_dropped) != self._reported:
            self._report()
        if scans:
            if self._lost_ns is not None:
                self._tell("back", f"{self.link.name} is back after {self._away_s():.1f} s")
                self._lost_ns, self._silent, self._silent_s = None, False, LINK_SILENT_S
            self._received_ns = self._clock_ns()
        elif self._give_up_s:
            self._suspect()
        return scans

    def notices(self) -> list[Notice]:
        """Return the events of the link since the last call, with the user's name for it."""
        notices, self._notices = self._notices + self.link.notices(), []
        if not (prefix := self.link.prefix):
            return notices
        return [
            notice._replace(sensors=prefix + notice.sensors, text=f"{prefix[:-1]}: {notice.text}") for notice in notices
        ]

    def counters(self) -> dict[str, int]:
        """Return the link's counters; of one that lasts, also its outages and reopenings."""
        losses = {"outages": self.outages, "reopenings": self.reopenings} if self.link.lasts else {}
        return self.link.counters() | losses

    def _away_s(self) -> float:
        return (self._clock_ns() - (self._received_ns if self._lost_ns is None else self._lost_ns)) / 1e9

    def _report(self) -> None:
        """Tell of a trouble that begins or ends, and of time stamps that are no clock."""
        link, (trouble, dropped) = self.link, self._reported
        self._reported = link.trouble, link.stamps_dropped
        if link.trouble != trouble:
            self._tell("well" if link.trouble is None else "trouble", link.trouble or f"{link.name} reports no trouble")
        if link.stamps_dropped and not dropped:
            self._tell(
                "note", f"{link.name}: its time stamps do not run as this machine's clock does, and are left out"
            )

    def _suspect(self) -> None:
        """Close a link that has been silent for long, less often each time, so that it is opened again."""
        if (self._clock_ns() - self._received_ns) / 1e9 < self._silent_s:
            return
        name = self.link.name
        if self._lost_ns is None:
            self._lost_ns, self._silent = self._received_ns, True
            self.outages += 1
            self._tell("silent", f"no scan from {name} for {self._silent_s:.1f} s: opening it again")
        if self._away_s() >= self._give_up_s:
            raise LinkLostError(
                f"{name} gave no scan for {self._away_s():.0f} s: check the sensor's power and its cable"
            )
        self._silent_s += min(self._silent_s, LATE_RETRY_S)
        self.__exit__()

    def _lose(self, why: str) -> None:
        """Begin, or go on with, an outage; raises LinkLostError if it lasts for too long."""
        self._away = True
        if not self._give_up_s:
            raise LinkLostError(why)
        if self._lost_ns is None or self._silent:
            self.outages += not self._silent
            self._lost_ns = self._clock_ns() if self._lost_ns is None else self._lost_ns
            self._silent = False
            self._tell("lost", f"{why}; trying again until it is back")
        elif self._away_s() >= self._give_up_s:
            raise LinkLostError(f"{self.link.name} was away for {self._give_up_s:g} s: {why}")

    def _reopen(self) -> None:
        """Open the link again: at once if it was silent, after a pause if it was lost."""
        self.__exit__()
        if self._away:
            if self._sleep(SOON_RETRY_S if self._away_s() < SOON_S else LATE_RETRY_S):
                return
            self._received_ns, self._silent_s = self._clock_ns(), LINK_SILENT_S  # its silence begins with the opening
        try:
            self._guarded(self.link.__enter__)
        except DeviceError as error:
            self._lose(f"{error}")
            return
        self._entered, self._away = True, False
        self.reopenings += 1

    def _guarded(self, call: Callable[..., _Answer], *arguments: object) -> _Answer:
        """Return what the link returns; any error that no link is expected to raise is a LinkLostError."""
        try:
            return call(*arguments)
        except BridgeError:
            raise
        except Exception as error:  # a library's, of any class: it must not end the links beside this one
            place = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{'/'.join(Path(place.filename).parts[-2:])}, line {place.lineno}"
            text = " ".join(f"{type(error).__name__} {error}".split())
            raise LinkLostError(f"{self.link.name}: link lost by an unforeseen {text} ({where})") from error

    def _tell(self, kind: NoticeKind, text: str) -> None:
        self._notices.append(Notice(self._clock_ns(), kind, text))
