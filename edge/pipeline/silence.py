"""Sensors that fall silent while others go on, and scans that left no trace. No I/O, no clock."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from edge.perception.event import Event
from edge.pipeline.deadline import Deadline
from firmware_bridge.scans.scan import Scan
from firmware_bridge.silence import SENSOR_SILENT_NS

GAP_PERIODS: Final = 1.5
"""Between two scans; jitter, and the 16 ms for which some adapters hold scans back, make less of 10 ms."""

SETTLING_SCANS: Final = 5
"""At their pace behind a gap, before what is missing in it is counted: of these the one that was least late tells."""
PACED_SCANS: Final = 32
"""Without a gap, from which on their mean period is better known than the median of the newest: by that, 1 % off, a
stall of a second would seem to have swallowed a scan."""
SHORTEST_PERIOD_NS: Final = 500_000
"""Twice as fast as any sensor is read: scans nearer to each other lay there, and tell no period."""


@dataclass(slots=True)
class _Gap:
    """Of a sensor: the scan before it, the period, and by how many periods a scan behind it is least too late."""

    before: Scan
    period_ns: float
    least: float = math.inf
    settled: int = 0


class Silence:
    """Follows when each sensor was heard.

    The wire numbers no scans: how many are missing between two is told by the sensor's own period, and exact only as
    far as that is.

    Attributes:
        missed: scans that did not come, as far as gaps show.
    """

    def __init__(self, expected: Iterable[str] = (), *, recorded: bool = False) -> None:
        """Begin without a scan.

        Args:
            expected: names of sensors that there should be.
            recorded: scans are of a recording, which has no cable to see to.
        """
        self._recorded = recorded
        self.missed = 0
        self._expected = set(expected)
        self._first_ns: int | None = None
        self._last: dict[str, Scan] = {}
        self._gaps: dict[str, _Gap] = {}
        self._paced_from: dict[str, Scan] = {}
        self._periods_ns: dict[str, float] = {}
        self._paces: dict[str, Deadline] = {}
        self._silent: set[str] = set()
        self._since_ns: dict[str, int] = {}

    def begin_anew(self, time_ns: int, sensors: str = "") -> None:
        """A link was away until `time_ns` [ns]: none of its sensors, whose names begin so, was silent before."""
        self._since_ns[sensors] = time_ns

    def follow(self, scan: Scan, period_ns: int | None) -> Event | None:
        """Take the next scan of a sensor, whose period is known or not; tells if the sensor is heard again."""
        before, self._last[scan.sensor] = self._last.get(scan.sensor), scan
        if before is None:
            self._expected.discard(scan.sensor)
            self._first_ns = scan.time_ns if self._first_ns is None else self._first_ns
            self._paced_from[scan.sensor] = scan
            return None
        if scan.device_ns is not None:  # by the device's own time, too, or bursts of a busy reader would look like gaps
            pace = self._paces.get(scan.sensor)
            if pace is None:
                pace = self._paces[scan.sensor] = Deadline()
            pace.follow(scan.device_ns)
            period_ns = pace.period_ns or period_ns
        if period_ns and period_ns >= SHORTEST_PERIOD_NS:
            self._follow_gap(before, scan, period_ns)
        if scan.sensor in self._silent:
            self._silent.remove(scan.sensor)
            away_s = (scan.time_ns - before.time_ns) / 1e9
            return Event(scan.time_ns, "back", scan.sensor, f"sensor {scan.sensor} is back after {away_s:.1f} s")
        return None

    def _follow_gap(self, before: Scan, scan: Scan, period_ns: int) -> None:
        """Count what is missing behind a gap, once scans come at their pace again: what was late comes in a burst."""
        gap_ns = scan.on_bus_ns - before.on_bus_ns
        gap = self._gaps.get(scan.sensor)
        if gap is not None and period_ns > GAP_PERIODS * gap.period_ns:
            del self._gaps[scan.sensor]  # it was of the pace, which was not known: what is read late comes in bursts
            self._periods_ns.pop(scan.sensor, None)
            self._paced_from[scan.sensor] = scan
        elif gap_ns > GAP_PERIODS * period_ns:
            if gap is not None:
                gap.least, gap.settled = math.inf, 0
            else:
                self._gaps[scan.sensor] = _Gap(before, self._mean_period_ns(before, period_ns))
        elif gap is not None and gap_ns >= gap.period_ns / 2:
            periods = (scan.on_bus_ns - gap.before.on_bus_ns) / gap.period_ns
            gap.least = min(gap.least, periods - (scan.number - gap.before.number))
            gap.settled += 1
            if gap.settled == SETTLING_SCANS:
                self.missed += max(round(gap.least), 0)
                del self._gaps[scan.sensor]
                self._paced_from[scan.sensor] = scan

    def _mean_period_ns(self, scan: Scan, period_ns: int) -> float:
        """Over all scans since the last gap, or before it, where there were enough.

        Over few, bursts make the median too small, and hardly the mean.
        """
        first = self._paced_from[scan.sensor]
        scans = scan.number - first.number
        mean_ns = (scan.on_bus_ns - first.on_bus_ns) / scans if scans else 0.0
        if scans >= PACED_SCANS:
            self._periods_ns[scan.sensor] = mean_ns
        return self._periods_ns.get(scan.sensor, max(period_ns, mean_ns))

    def look(self) -> list[Event]:
        """Sensors found silent since the last call, while another was heard; of all of them, the link tells."""
        if len(self._last) + len(self._expected) < 2 or self._first_ns is None:
            return []
        newest_ns = max(scan.time_ns for scan in self._last.values())
        events: list[Event] = []
        for sensor, scan in self._last.items():
            if newest_ns - self._heard_ns(sensor, scan.time_ns) > SENSOR_SILENT_NS and sensor not in self._silent:
                self._silent.add(sensor)
                events.append(self._silence(sensor, newest_ns, scan.time_ns, "the recording has none for so long"))
        if self._expected and newest_ns - self._first_ns > SENSOR_SILENT_NS:
            missing, self._expected = sorted(self._expected), set()
            why = "the recording has none of it, though there is a baseline or a force for it"
            events += [self._silence(sensor, newest_ns, self._first_ns, why) for sensor in missing]
        return events

    def _silence(self, sensor: str, now_ns: int, since_ns: int, why_recorded: str) -> Event:
        why = why_recorded if self._recorded else "see to its cable and its controller, since others go on"
        return Event(
            now_ns, "silent", sensor, f"no scan from sensor {sensor} for {(now_ns - since_ns) / 1e9:.1f} s: {why}"
        )

    def _heard_ns(self, sensor: str, time_ns: int) -> int:
        since_ns = [since_ns for sensors, since_ns in self._since_ns.items() if sensor.startswith(sensors)]
        return max([time_ns, *since_ns])
