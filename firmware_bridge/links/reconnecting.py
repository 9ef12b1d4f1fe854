"""Wrapper that gives a link its user's name, puts its taxels in place, and opens it again when it is lost or silent.

It is also the border where the errors of drivers and of network libraries stop: each is the loss of one link.
"""

import math
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Final, TypeVar

from firmware_bridge.errors import BridgeError, DeviceError, LinkLostError
from firmware_bridge.links.base import Link, Notice, NoticeKind, SerialLine
from firmware_bridge.poses import PadPose, TimedPose
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import LINK_SILENT_S

SOON_RETRY_S: Final = 0.5
"""Longest pause between tries in the first minute, in [s]: with the opening, a link that is back is used within 1 s."""
LATE_RETRY_S: Final = 2.0
SOON_S: Final = 60.0
"""Time of an outage with frequent tries, in [s]; later ones are rarer, to save the robot's processor."""

_Answer = TypeVar("_Answer")


class LastingLink(Link):
    """Link that opens the wrapped link again whenever it is lost, and now and then while it is silent."""

    def __init__(
        self,
        link: Link,
        give_up_s: float | None = math.inf,
        *,
        name: str = "",
        places: Mapping[str, Mounting] = MappingProxyType({}),
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        """Wrap a link that is not open yet, and whose first opening must succeed.

        `give_up_s` is the longest outage or silence, in [s]; 0 allows no outage, but any silence, and None is for a
        source that is not opened again, and counts no outages. With a `name` sensor "4" is "NAME/4". `places` are
        mountings of sensors whose taxels come in the order of an id map, by the link's name of each; links that sort
        readings by their id take a `placed_map` instead, which costs no time.
        """
        self.name = link.name
        self.kind = link.kind
        self.ended = link.ended
        self.patient = link.patient
        self.unix_offset_ns = link.unix_offset_ns
        self.origin = link.origin
        self.length_s = link.length_s
        self.states_poses = link.states_poses
        self.fetches = link.fetches
        self.prefix = f"{name}/" if name else ""
        self.mountings = {f"{self.prefix}{sensor}": one for sensor, one in link.mountings.items()}
        self._told_as = f"{name}: " if name else ""
        self._places = dict(places)
        self._link = link
        self._give_up_s = give_up_s
        self._clock_ns = clock_ns
        self._sleep = sleep
        self._entered = self._open = False
        self._away = False
        self._lost_ns: int | None = None
        self._retry_ns = 0
        self._delay_s = 0.1
        self._received_ns = 0
        self._silent_s = LINK_SILENT_S
        self._silent = False
        self._outages = 0
        self._reopenings = 0
        self._notices: list[Notice] = []

    def __enter__(self) -> "LastingLink":
        self._guarded(self._link.__enter__)
        self.kind = self._link.kind
        self._entered = self._open = True
        self._received_ns = self._clock_ns()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._open = False
        if self._entered:
            self._entered = False
            with suppress(LinkLostError):  # it was lost anyway, or the run is over
                self._guarded(self._link.__exit__, *exc_info)

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; an empty list while the link is away.

        The next call closes and opens a link that is lost or silent, which may take long. It raises
        LinkLostError where it was away for longer than allowed.
        """
        if not self._open:
            self._come_back(timeout_s)
            return []
        try:
            scans = self._guarded(self._link.read, timeout_s)
        except LinkLostError as error:
            self._close(f"{error}")
            return []
        self.ended = self._link.ended
        if self._link.trouble != self.trouble:
            self.trouble = self._link.trouble
            self._tell("well" if self.trouble is None else "trouble", self.trouble or f"{self.name} reports no trouble")
        if self._link.stamps_dropped and not self.stamps_dropped:
            self.stamps_dropped = True
            text = "its time stamps do not run as this machine's clock does, and are left out"
            self._tell("note", f"{self.name}: {text}")
        if scans:
            now_ns = self._clock_ns()
            if self._lost_ns is not None or self._silent:
                self._end_outage(now_ns)
            self._received_ns = now_ns
            if self._places:
                scans = [self._places[one.sensor].place(one) if one.sensor in self._places else one for one in scans]
            if self.prefix:
                scans = [replace(scan, sensor=f"{self.prefix}{scan.sensor}") for scan in scans]
        else:
            self._suspect()
        return scans

    def fetch(self) -> None:
        """Take what the system has received of a link that is open."""
        if self._open:
            self._link.fetch()

    def notices(self) -> list[Notice]:
        """Return the events of the link since the last call, with the user's name for it."""
        notices, self._notices = self._notices + self._link.notices(), []
        return [
            notice._replace(sensors=f"{self.prefix}{notice.sensors}", text=notice.text and self._told_as + notice.text)
            for notice in notices
        ]

    def poses(self) -> list[TimedPose]:
        """Return the poses since the last call; those of all its sensors stay those of all."""
        poses = self._link.poses()
        if not self.prefix:
            return poses
        return [one if one.sensor is None else replace(one, sensor=f"{self.prefix}{one.sensor}") for one in poses]

    def steer(self) -> Callable[[PadPose | None], None] | None:
        """Return the wrapped link's function that takes where to tap next."""
        return self._link.steer()

    def counters(self) -> dict[str, int]:
        """Return the wrapped link's counters; of one that lasts, also its outages (losses, silences) and reopenings."""
        counters = self._link.counters()
        if self._give_up_s is None:
            return counters
        return counters | {"outages": self._outages, "reopenings": self._reopenings}

    def can_ids(self) -> frozenset[int]:
        """Return the CAN ids of the wrapped link."""
        return self._link.can_ids()

    def serial_line(self) -> SerialLine | None:
        """Return the serial line of the wrapped link."""
        return self._link.serial_line()

    def _away_s(self, now_ns: int) -> float:
        return (now_ns - (self._received_ns if self._lost_ns is None else self._lost_ns)) / 1e9

    def _end_outage(self, now_ns: int) -> None:
        self._tell("back", f"{self.name} is back after {self._away_s(now_ns):.1f} s")
        self._lost_ns, self._silent = None, False
        self._delay_s, self._silent_s = 0.1, LINK_SILENT_S

    def _suspect(self) -> None:
        """Schedule another opening of a silent link, less often each time."""
        now_ns = self._clock_ns()
        if self.ended or not self._give_up_s or now_ns - self._received_ns < self._silent_s * 1e9:
            return
        if not self._silent and self._lost_ns is None:
            self._silent = True
            self._outages += 1
            self._tell("silent", f"no scan from {self.name} for {self._silent_s:.1f} s: opening it again")
        away_s = self._away_s(now_ns)
        if away_s >= self._give_up_s:
            raise LinkLostError(f"{self.name} gave no scan for {away_s:.0f} s: check the sensor's power and its cable")
        self._silent_s += min(self._silent_s, LATE_RETRY_S)
        self._open = False

    def _reopen(self, now_ns: int) -> None:
        try:
            self._guarded(self._link.__enter__)
        except DeviceError as error:
            self._close(f"{error}", now_ns)
        else:
            self._reopenings += 1
            self._entered = self._open = True
            if self._link.kind != self.kind:  # every result would go on to state the first kind
                raise LinkLostError(f"{self.name} was {self.kind} and came back as {self._link.kind}: start again")

    def _close(self, why: str, now_ns: int | None = None) -> None:
        now_ns = self._clock_ns() if now_ns is None else now_ns
        self._open = False
        self._away = True
        if not self._give_up_s:
            raise LinkLostError(why)
        if self._lost_ns is None:
            self._outages += not self._silent
            self._lost_ns = now_ns if not self._silent else self._received_ns
            self._tell("lost", f"{why}; trying again until it is back")
        elif now_ns - self._lost_ns >= self._give_up_s * 1e9:
            raise LinkLostError(f"{self.name} was away for {self._give_up_s:g} s: {why}")
        longest_s = SOON_RETRY_S if now_ns - self._lost_ns < SOON_S * 1e9 else LATE_RETRY_S
        self._retry_ns = now_ns + int(min(self._delay_s, longest_s) * 1e9)
        self._delay_s = min(2 * self._delay_s, LATE_RETRY_S)

    def _come_back(self, timeout_s: float) -> None:
        """Close the link if it is still open, and open it again: at once if it was silent, else when a try is due."""
        self.__exit__(None, None, None)
        if not self._away:
            self._reopen(self._clock_ns())
            return
        wait_s = (self._retry_ns - self._clock_ns()) / 1e9
        if wait_s > 0:
            self._sleep(min(wait_s, timeout_s))
        now_ns = self._clock_ns()
        if now_ns >= self._retry_ns:
            self._received_ns, self._silent_s = now_ns, LINK_SILENT_S  # its silence begins with the opening
            self._away = False
            self._reopen(now_ns)

    def _guarded(self, call: Callable[..., _Answer], *arguments: object) -> _Answer:
        """Return what the wrapped link returns; any error that no link is expected to raise is a LinkLostError."""
        try:
            return call(*arguments)
        except BridgeError:
            raise
        except Exception as error:  # a library's, of any class: it must not end the links beside this one
            place = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{'/'.join(Path(place.filename).parts[-2:])}, line {place.lineno}"
            text = " ".join(f"{type(error).__name__} {error}".split())
            raise LinkLostError(f"{self.name}: link lost by an unforeseen {text} ({where})") from error

    def _tell(self, kind: NoticeKind, text: str) -> None:
        self._notices.append(Notice(self._clock_ns(), kind, text))
