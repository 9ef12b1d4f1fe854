"""Cadence of the sensors' scans: period, deadline, missing scans, silence, and the pace of reading. No I/O, no clock.

Where the processor slept before, a scan costs what fetching its code takes. So the scans of many sensors are read
together a few times a period. While no sensor is touched, and every sink can wait, bytes are only taken once a period,
and made into scans together some periods later. Which scans they make, and with which times, does not depend on that:
each piece keeps the time at which it was taken.
"""

import math
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

from edge.perception.event import Event
from edge.perception.result import Result
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import NS_PER_S, SENSOR_SILENT_NS

FEWEST_INTERVALS: Final = 5  # fewest intervals that give a period
LONGEST_BURST: Final = 500
"""Scans of a burst: five seconds of a sensor at 100 Hz; a longer one is the sensor's own pace."""
GAP_PERIODS: Final = 1.5
"""Periods between two scans that make a gap; jitter, and the 16 ms for which some adapters hold scans, stay below at
10 ms."""
SETTLING_SCANS: Final = 5
"""Scans at their pace after a gap before the missing ones are counted; the least late of them decides."""


class _Period:
    """Running median of the intervals between times, which neither jitter nor a gap moves, in [ns]."""

    def __init__(self) -> None:
        self.ns: int | None = None
        self._intervals: deque[int] = deque()
        self._sorted: list[int] = []
        self._last_ns: int | None = None
        self._hurried = 0

    def follow(self, time_ns: int) -> None:
        """Take the next time; one that stands still gives no interval."""
        last_ns, self._last_ns = self._last_ns, time_ns
        if last_ns is None or time_ns <= last_ns:
            return
        interval_ns = time_ns - last_ns
        # Held up somewhere, it came right behind the one before; unless all of late did. Bursts of all sixteen frames,
        # 16 ms apart, are further apart.
        hurried = self.ns is not None and interval_ns * 8 < self.ns
        self._hurried = self._hurried + 1 if hurried else 0
        if self._hurried > LONGEST_BURST:
            self._intervals.clear()
            self._sorted.clear()
            self.ns = None
        elif hurried:
            return
        if len(self._intervals) == 31:
            del self._sorted[bisect_left(self._sorted, self._intervals.popleft())]
        self._intervals.append(interval_ns)
        insort(self._sorted, interval_ns)
        if len(self._sorted) >= FEWEST_INTERVALS:
            self.ns = self._sorted[len(self._sorted) // 2]


@dataclass(slots=True)
class _Gap:
    """Gap of a sensor: the scan before it, the period, and the least lateness in periods of the scans after it."""

    before: Scan
    period_ns: float
    least: float = math.inf
    settled: int = 0


class Cadence:
    """Cadence of one sensor: its period, and what did not come, which shows as a gap.

    The wire does not number scans: the number missing between two follows from the sensor's own period, and is only as
    exact as that.

    Attributes:
        last: newest scan; None before the first.
        missed: scans that did not arrive, as far as gaps show.
        period_ns: time between scans, in [ns]; None as long as too few have arrived.
    """

    def __init__(self, rate_hz: float | None = None) -> None:
        """Begin without a scan; `rate_hz` is the sensor's rate in [Hz], None if unknown."""
        self.last: Scan | None = None
        self.missed = 0
        self.period_ns = self._known_ns = None if rate_hz is None else round(NS_PER_S / rate_hz)
        self._arrivals, self._stamps = _Period(), _Period()
        self._gap: _Gap | None = None
        self._paced_from: Scan | None = None
        self._mean_ns: float | None = None

    def forget(self) -> None:
        """Forget the scans: a recording goes on elsewhere, and none is missing."""
        self.last = self._gap = self._paced_from = None

    def follow(self, scan: Scan) -> None:
        """Take the next scan."""
        if not scan.unread_ns:  # scans that waited unread came at no pace
            self._arrivals.follow(scan.time_ns)
            self.period_ns = self._known_ns or self._arrivals.ns
        if scan.device_ns is not None:
            self._stamps.follow(scan.device_ns)
        before, self.last = self.last, scan
        if before is None:
            self._paced_from = scan
            return
        period_ns = self.period_ns
        if scan.device_ns is not None:  # else bursts of a busy reader would look like gaps
            period_ns = self._stamps.ns or period_ns
        if period_ns and period_ns >= 500_000:  # half of the fastest sensor's: scans that are nearer waited somewhere
            self._follow_gap(before, scan, period_ns)

    def _follow_gap(self, before: Scan, scan: Scan, period_ns: int) -> None:
        """Count the scans missing in a gap, once scans come at their pace again: late ones come in a burst."""
        gap_ns, gap = scan.on_bus_ns - before.on_bus_ns, self._gap
        if gap is not None and period_ns > GAP_PERIODS * gap.period_ns:
            # A wrong pace only looked like a gap: scans read late come in bursts.
            self._gap, self._mean_ns, self._paced_from = None, None, scan
        elif gap_ns > GAP_PERIODS * period_ns:
            if gap is not None:
                gap.least, gap.settled = math.inf, 0
            else:
                self._gap = _Gap(before, self._mean_period_ns(before, period_ns))
        elif gap is not None and gap_ns >= gap.period_ns / 2:
            periods = (scan.on_bus_ns - gap.before.on_bus_ns) / gap.period_ns
            gap.least = min(gap.least, periods - (scan.number - gap.before.number))
            gap.settled += 1
            if gap.settled == SETTLING_SCANS:
                self.missed += max(round(gap.least), 0)
                self._gap, self._paced_from = None, scan

    def _mean_period_ns(self, scan: Scan, period_ns: int) -> float:
        """Return the mean period over all scans since the last gap, or before it, if there were enough.

        Over few scans, bursts make the median too small, and hardly the mean. Over many the mean is more exact: with a
        median that is 1 % off, a stall of a second would seem to have swallowed a scan.
        """
        first = self._paced_from or scan
        scans = scan.number - first.number
        mean_ns = (scan.on_bus_ns - first.on_bus_ns) / scans if scans else 0.0
        if scans >= 32:
            self._mean_ns = mean_ns
        return self._mean_ns or max(period_ns, mean_ns)


class Cadences:
    """Cadences of all sensors, and those that fall silent while another goes on.

    Attributes:
        missed: scans of all sensors that did not arrive, as far as gaps show.
    """

    def __init__(self, expected: Iterable[str] = (), *, recorded: bool = False, rate_hz: float | None = None) -> None:
        """Begin without a scan, with the sensors that should be there; a recording has no cable to check."""
        self.missed = 0
        self._recorded = recorded
        self._rate_hz = rate_hz
        self._expected = set(expected)
        self._sensors: dict[str, Cadence] = {}
        self._first_ns: int | None = None
        self._silent: set[str] = set()
        self._since_ns: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._sensors)

    def late(self, sensor: str, latency_us: float) -> bool:
        """Return whether a pattern was ready later than one period after its scan, in [us]; never without a period."""
        period_ns = self._sensors[sensor].period_ns
        return period_ns is not None and latency_us * 1e3 > period_ns

    @property
    def shortest_period_s(self) -> float:
        """Shortest period of a sensor, in [s]; infinite as long as none is known."""
        return min((one.period_ns or math.inf for one in self._sensors.values()), default=math.inf) / NS_PER_S

    def begin_anew(self, time_ns: int, sensors: str = "") -> None:
        """Restart the silence of sensors whose names begin so at `time_ns` [ns], when their link came back."""
        self._since_ns[sensors] = time_ns

    def forget(self, sensors: str = "") -> None:
        """Forget the scans of sensors whose names begin so: a recording goes on elsewhere."""
        for name, cadence in self._sensors.items():
            if name.startswith(sensors):
                cadence.forget()

    def follow(self, scan: Scan) -> Event | None:
        """Take the next scan of a sensor; return an event if it was silent."""
        sensor = scan.sensor
        cadence = self._sensors.get(sensor)
        if cadence is None:
            cadence = self._sensors[sensor] = Cadence(self._rate_hz)
        since_ns = cadence.last.time_ns if cadence.last is not None else self._first_ns
        if cadence.last is None:
            self._expected.discard(sensor)
            self._first_ns = scan.time_ns if self._first_ns is None else self._first_ns
        missed = cadence.missed
        cadence.follow(scan)
        self.missed += cadence.missed - missed
        if sensor not in self._silent:
            return None
        self._silent.remove(sensor)
        away_s = (scan.time_ns - (scan.time_ns if since_ns is None else since_ns)) / 1e9
        return Event(scan.time_ns, "back", sensor, f"sensor {sensor} is back after {away_s:.1f} s")

    def look(self) -> list[Event]:
        """Return events of sensors newly silent while another is not; the link reports a silence of all of them."""
        if len(self._sensors) + len(self._expected) < 2 or self._first_ns is None:
            return []
        last_ns = {name: one.last.time_ns for name, one in self._sensors.items() if one.last is not None}
        newest_ns = max(last_ns.values(), default=self._first_ns)
        events: list[Event] = []
        for sensor, time_ns in last_ns.items():
            if newest_ns - self._received_ns(sensor, time_ns) > SENSOR_SILENT_NS and sensor not in self._silent:
                self._silent.add(sensor)
                events.append(self._silence(sensor, newest_ns, time_ns, "the recording has none in that time"))
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


class Rate:
    """Rate of scans in [Hz], smoothed over about twenty scans; None before the second one."""

    def __init__(self) -> None:
        self.rate_hz: float | None = None
        self._period_ns: float | None = None
        self._last_ns: int | None = None

    def add(self, time_ns: int) -> None:
        """Take the time of the next scan, in [ns]."""
        if self._last_ns is not None and time_ns > self._last_ns:
            period_ns = time_ns - self._last_ns
            if self._period_ns is None:
                self._period_ns = period_ns
            self._period_ns += 0.05 * (period_ns - self._period_ns)
            self.rate_hz = 1e9 / self._period_ns
        self._last_ns = time_ns


LONGEST_PERIOD_S: Final = 0.05  # period from which scans come too seldom to be read together, in [s]
RESTLESS_NS: Final = 1_000_000_000  # time after a contact, in [ns], during which every scan is still read at once


class Pace(NamedTuple):
    """Times of reading, the same for all links."""

    every_s: float = 0.0  # time between two reads, in [s]; 0: as scans come
    reads: int = 1  # number of reads after which bytes are made into scans


class PaceSetter:
    """Chooser of the pace, by the results.

    Attributes:
        pace: the pace chosen last.
    """

    def __init__(self, patience_s: float) -> None:
        """Begin with reading as scans come; those at rest may wait for `patience_s` [s]."""
        self.pace = Pace()
        self._patience_s = patience_s
        self._restless_ns = self._newest_ns = -RESTLESS_NS
        self._waited_ns = 0.0

    def follow(self, result: Result) -> None:
        """Take the next result; only time stamps show pauses that a late read hides."""
        self._newest_ns = result.scan.time_ns
        if result.state != "idle" or result.scan.device_ns is None:
            self._restless_ns = self._newest_ns

    def waited(self, scan: Scan) -> bool:
        """Return True if a scan came late because of the pace, so that its pattern is no worse for being late."""
        return scan.time_ns < self._waited_ns

    def choose(self, sensors: int, period_s: float) -> Pace:
        """Return the pace for so many sensors of this shortest period in [s]."""
        pace, before = Pace(), self.pace
        rests = self._newest_ns - self._restless_ns > RESTLESS_NS
        if rests and 0.005 <= period_s < min(LONGEST_PERIOD_S, self._patience_s / 2):  # faster ones never wait
            pace = Pace(period_s, int(self._patience_s / period_s))
        elif sensors >= 4 and period_s < LONGEST_PERIOD_S:
            pace = Pace(period_s / 4)
        if (pace.reads > 1) == (before.reads > 1) and abs(pace.every_s - before.every_s) < 0.1 * pace.every_s:
            return before  # a measured period jitters
        if pace.reads > 1:
            self._waited_ns = math.inf
        elif before.reads > 1:
            self._waited_ns = self._newest_ns + 2e9 * before.every_s
        self.pace = pace
        return pace
