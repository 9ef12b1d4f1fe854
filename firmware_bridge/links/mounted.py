"""Wrapper of a link that names its sensors after it and puts their taxels in place on the pad."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Self

from firmware_bridge.links.base import Link, Notice, Pace, SerialLine, SourceKind, Wait
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan


class MountedLink(Link):
    """Link with sensor names and places of taxels that the wrapped link does not have.

    Links that sort readings by their id take a `placed_map` instead of places, which costs no time.

    Attributes:
        wrapped: the wrapped link.
    """

    def __init__(self, link: Link, name: str = "", places: Mapping[str, Mounting] = MappingProxyType({})) -> None:
        """Wrap a link that is not open yet.

        Args:
            link: link that returns the scans.
            name: prefix of the sensors: "4" of "left" is "left/4"; without one they keep the names of the link.
            places: mountings of sensors whose taxels come in the order of an id map, by the link's name of each.
        """
        self.name = link.name
        self.kind: SourceKind = link.kind
        self.ended = link.ended
        self.patient = link.patient
        self.unix_offset_ns = link.unix_offset_ns
        self.origin = link.origin
        self.states_poses = link.states_poses
        self.wrapped = link
        self.prefix = f"{name}/" if name else ""
        self._prefix_text = f"{name}: " if name else ""
        self._places = dict(places)
        self.mountings = {f"{self.prefix}{sensor}": one for sensor, one in link.mountings.items()}

    def __enter__(self) -> Self:
        self.wrapped.__enter__()
        self.kind = self.wrapped.kind  # some links determine it only on opening
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.wrapped.__exit__(*exc_info)

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call, named and in place; waits at most `timeout_s`."""
        scans = self.wrapped.read(timeout_s)
        self.ended, self.trouble = self.wrapped.ended, self.wrapped.trouble
        if self._places:
            scans = [self._places[scan.sensor].place(scan) if scan.sensor in self._places else scan for scan in scans]
        return [replace(scan, sensor=f"{self.prefix}{scan.sensor}") for scan in scans] if self.prefix else scans

    def set_pace(self, pace: Pace) -> None:
        """Pass on how late scans may come, and for which of its own sensors not."""
        size = len(self.prefix)
        own = frozenset(name[size:] for name in pace.restless if name.startswith(self.prefix))
        self.wrapped.set_pace(pace._replace(restless=own))

    def wait_on(self) -> Wait | None:
        """Return the wait condition of the wrapped link."""
        return self.wrapped.wait_on()

    def can_ids(self) -> frozenset[int]:
        """Return the CAN ids of the wrapped link."""
        return self.wrapped.can_ids()

    def serial_line(self) -> SerialLine | None:
        """Return the serial line of the wrapped link."""
        return self.wrapped.serial_line()

    def notices(self) -> list[Notice]:
        """Return the notices of the wrapped link, with the user's name for it."""
        return [
            notice._replace(sensors=f"{self.prefix}{notice.sensors}", text=f"{self._prefix_text}{notice.text}")
            for notice in self.wrapped.notices()
        ]

    def poses(self) -> list[TimedPose]:
        """Return the poses of the wrapped link; those of all its sensors stay those of all."""
        poses = self.wrapped.poses()
        if not self.prefix:
            return poses
        return [one if one.sensor is None else replace(one, sensor=f"{self.prefix}{one.sensor}") for one in poses]

    def counters(self) -> dict[str, int]:
        """Return the counters of the wrapped link."""
        return self.wrapped.counters()
