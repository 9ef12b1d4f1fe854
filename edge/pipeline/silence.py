"""Detection of sensors that fall silent while others go on, and count of missing scans. No I/O, no clock."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from edge.perception.event import Event
from edge.pipeline.deadline import Deadline
from firmware_bridge.scans.scan import Scan
from firmware_bridge.silence import SENSOR_SILENT_NS

GAP_PERIODS: Final = 1.5
"""Periods between two scans that make a gap; jitter, and the 16 ms for which some adapters hold scans, stay below at
10 ms."""

SETTLING_SCANS: Final = 5
"""Scans at their pace after a gap before the missing ones are counted; the least late of them decides."""
PACED_SCANS: Final = 32
"""Scans without a gap from which on their mean period is more exact than the median of the newest: with that, 1 % off,
a stall of a second would seem to have swallowed a scan."""
SHORTEST_PERIOD_NS: Final = 500_000
"""Shortest period of a sensor, half of that of the fastest: scans nearer to each other waited somewhere, and give no
period."""


@dataclass(slots=True)
class _Gap:
    """Gap of a sensor: the scan before it, the period, and the least lateness in periods of the scans after it."""

    before: Scan
    period_ns: float
    least: float = math.inf
    settled: int = 0


class Silence:
    """Watch on the arrival of each sensor's scans.

    The wire does not number scans: the number missing between two follows from the sensor's own period, and is only as
    exact as that.

    Attributes:
        missed: scans that did not arrive, as far as gaps show.
    """

    def __init__(self, expected: Iterable[str] = (), *, recorded: bool = False) -> None:
        """Begin without a scan.

        Args:
            expected: names of sensors that should be there.
            recorded: True if the scans are of a recording, which has no cable to check.
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
        """Restart the silence of sensors whose names begin so at `time_ns` [ns], when their link came back."""
        self._since_ns[sensors] = time_ns

    def forget(self, sensors: str = "") -> None:
        """Forget the scans of sensors whose names begin so: a recording goes on elsewhere, and none is missing."""
        for kept in (self._last, self._gaps, self._paced_from):
            for name in [name for name in kept if name.startswith(sensors)]:
                del kept[name]

    def follow(self, scan: Scan, period_ns: int | None) -> Event | None:
        """Take the next scan of a sensor with its period in [ns], if available; return an event if it was silent."""
        before, self._last[scan.sensor] = self._last.get(scan.sensor), scan
        if before is None:
            self._expected.discard(scan.sensor)
            self._first_ns = scan.time_ns if self._first_ns is None else self._first_ns
            self._paced_from[scan.sensor] = scan
            return self._back(scan, self._first_ns)
        if scan.device_ns is not None:  # by the device's own time, too, or bursts of a busy reader would look like gaps
            pace = self._paces.get(scan.sensor)
            if pace is None:
                pace = self._paces[scan.sensor] = Deadline()
            pace.follow(scan.device_ns)
            period_ns = pace.period_ns or period_ns
        if period_ns and period_ns >= SHORTEST_PERIOD_NS:
            self._follow_gap(before, scan, period_ns)
        return self._back(scan, before.time_ns)

    def _back(self, scan: Scan, since_ns: int) -> Event | None:
        if scan.sensor not in self._silent:
            return None
        self._silent.remove(scan.sensor)
        away_s = (scan.time_ns - since_ns) / 1e9
        return Event(scan.time_ns, "back", scan.sensor, f"sensor {scan.sensor} is back after {away_s:.1f} s")

    def _follow_gap(self, before: Scan, scan: Scan, period_ns: int) -> None:
        """Count the scans missing in a gap, once scans come at their pace again: late ones come in a burst."""
        gap_ns = scan.on_bus_ns - before.on_bus_ns
        gap = self._gaps.get(scan.sensor)
        if gap is not None and period_ns > GAP_PERIODS * gap.period_ns:
            del self._gaps[scan.sensor]  # a wrong pace only looked like a gap: scans read late come in bursts
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
        """Return the mean period over all scans since the last gap, or before it, if there were enough.

        Over few scans, bursts make the median too small, and hardly the mean.
        """
        first = self._paced_from[scan.sensor]
        scans = scan.number - first.number
        mean_ns = (scan.on_bus_ns - first.on_bus_ns) / scans if scans else 0.0
        if scans >= PACED_SCANS:
            self._periods_ns[scan.sensor] = mean_ns
        return self._periods_ns.get(scan.sensor, max(period_ns, mean_ns))

    def look(self) -> list[Event]:
        """Return events of sensors newly silent while another is not; the link reports a silence of all of them."""
        if len(self._last) + len(self._expected) < 2 or self._first_ns is None:
            return []
        newest_ns = max(scan.time_ns for scan in self._last.values())
        events: list[Event] = []
        for sensor, scan in self._last.items():
            if newest_ns - self._received_ns(sensor, scan.time_ns) > SENSOR_SILENT_NS and sensor not in self._silent:
                self._silent.add(sensor)
                events.append(self._silence(sensor, newest_ns, scan.time_ns, "the recording has none in that time"))
        if self._expected and newest_ns - self._first_ns > SENSOR_SILENT_NS:
            missing, self._expected = sorted(self._expected), set()
            self._silent.update(missing)
            why = "the recording has none of it, though there is a baseline or a force for it"
            events += [self._silence(sensor, newest_ns, self._first_ns, why) for sensor in missing]
        return events

    def _silence(self, sensor: str, now_ns: int, since_ns: int, why_recorded: str) -> Event:
        why = why_recorded if self._recorded else "check its cable and its controller, since other sensors continue"
        return Event(
            now_ns, "silent", sensor, f"no scan from sensor {sensor} for {(now_ns - since_ns) / 1e9:.1f} s: {why}"
        )

    def _received_ns(self, sensor: str, time_ns: int) -> int:
        since_ns = [since_ns for sensors, since_ns in self._since_ns.items() if sensor.startswith(sensors)]
        return max([time_ns, *since_ns])
