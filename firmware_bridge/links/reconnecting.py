"""Reader of a link for its source: opens it again when it is lost or silent, and tells what happened to it.

It is also the border where the errors of drivers and of network libraries stop: each is the loss of one link.
"""

import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final, Self, TypeVar

from firmware_bridge.errors import BridgeError, DeviceError, LinkLostError
from firmware_bridge.links.base import Link, Notice, NoticeKind
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import LINK_SILENT_S

FIRST_RETRY_S: Final = 0.1
SOON_RETRY_S: Final = 0.5
"""Longest pause between tries in the first minute, in [s]: with the opening, a link that is back is used within 1 s."""
LATE_RETRY_S: Final = 2.0
SOON_S: Final = 60.0
"""Time of an outage with frequent tries, in [s]; later ones are rarer, to save the robot's processor."""

_Answer = TypeVar("_Answer")


class LinkReader:
    """Reader that opens its link again whenever it is lost, and now and then while it is silent.

    Attributes:
        link: the link.
        outages: number of losses and silences so far.
        reopenings: number of times that it was opened again.
    """

    def __init__(
        self,
        link: Link,
        give_up_s: float = 0.0,
        *,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        """Prepare to read a link that is not open yet, and whose first opening must succeed.

        `give_up_s` is the longest outage or silence, in [s]; 0 allows no outage, but any silence, as for a link that
        does not last. `sleep` waits for a time in [s], and returns True where reading is to end.
        """
        self.link = link
        self.outages = self.reopenings = 0
        self._give_up_s = give_up_s if link.lasts else 0.0
        self._clock_ns, self._sleep = clock_ns, sleep
        self._entered = False
        self._kind = link.kind
        self._trouble: str | None = None
        self._stamps_dropped = False
        self._notices: list[Notice] = []
        self._lost_ns: int | None = None  # beginning of an outage that has not ended
        self._silent = self._away = False
        self._begin_outage_times()

    def __enter__(self) -> Self:
        self._guarded(self.link.__enter__)
        self._entered = True
        self._kind = self.link.kind
        self._received_ns = self._clock_ns()
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._entered:
            self._entered = False
            with suppress(LinkLostError):  # it was lost anyway, or the run is over
                self._guarded(self.link.__exit__, None, None, None)

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; none while the link is away.

        A link that is lost or silent is closed and opened again by the next call, which may take long. It raises
        LinkLostError where it was away for longer than allowed.
        """
        if self._away or not self._entered:
            self._reopen()
            return []
        try:
            scans = self._guarded(self.link.read, timeout_s)
        except LinkLostError as error:
            self._lose(f"{error}")
            return []
        self._report()
        if scans:
            if self._lost_ns is not None:
                self._tell("back", f"{self.link.name} is back after {self._away_s():.1f} s")
                self._lost_ns, self._silent = None, False
                self._begin_outage_times()
            self._received_ns = self._clock_ns()
        elif self._give_up_s and not self.link.ended:
            self._suspect()
        return scans

    def notices(self) -> list[Notice]:
        """Return the events of the link since the last call, with the user's name for it."""
        notices, self._notices = self._notices + self.link.notices(), []
        prefix = self.link.prefix
        if not prefix:
            return notices
        return [one._replace(sensors=f"{prefix}{one.sensors}", text=f"{prefix[:-1]}: {one.text}") for one in notices]

    def counters(self) -> dict[str, int]:
        """Return the link's counters; of one that lasts, also its outages (losses, silences) and reopenings."""
        told = {"outages": self.outages, "reopenings": self.reopenings} if self.link.lasts else {}
        return self.link.counters() | told

    def _begin_outage_times(self) -> None:
        self._delay_s, self._silent_s = FIRST_RETRY_S, LINK_SILENT_S

    def _away_s(self) -> float:
        return (self._clock_ns() - (self._received_ns if self._lost_ns is None else self._lost_ns)) / 1e9

    def _report(self) -> None:
        """Tell of a trouble that begins or ends, and of time stamps that are no clock."""
        link = self.link
        if link.trouble != self._trouble:
            self._trouble = link.trouble
            self._tell("well" if link.trouble is None else "trouble", link.trouble or f"{link.name} reports no trouble")
        if link.stamps_dropped and not self._stamps_dropped:
            self._stamps_dropped = True
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
            if self._sleep(min(self._delay_s, SOON_RETRY_S if self._away_s() < SOON_S else LATE_RETRY_S)):
                return
            self._delay_s = min(2 * self._delay_s, LATE_RETRY_S)
            self._received_ns, self._silent_s = self._clock_ns(), LINK_SILENT_S  # its silence begins with the opening
        try:
            self._guarded(self.link.__enter__)
        except DeviceError as error:
            self._lose(f"{error}")
            return
        self._entered, self._away = True, False
        self.reopenings += 1
        if self.link.kind != self._kind:  # every result would go on to state the first kind
            raise LinkLostError(f"{self.link.name} was {self._kind} and came back as {self.link.kind}: start again")

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
