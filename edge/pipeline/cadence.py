"""Cadence of the sensors' scans: period, deadline, missing scans, silence, and the pace of reading. No I/O, no clock.

Where the processor slept before, a scan costs what fetching its code takes. So the scans of many sensors are read
together a few times a period. While no sensor is touched, and every sink can wait, bytes are only taken once a period,
and made into scans together some periods later. Which scans they make, and with which times, does not depend on that:
each piece keeps the time at which it was taken.
"""

import math
from collections import deque
from collections.abc import Iterable
from typing import Final, NamedTuple

from edge.perception.event import Event
from edge.perception.result import Result
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import NS_PER_S, SENSOR_SILENT_NS

FEWEST_INTERVALS: Final = 5  # fewest intervals that give a period
GAP_PERIODS: Final = 1.5  # between two scans; jitter, and adapters that hold scans for 16 ms, stay below at 10 ms
SETTLING_SCANS: Final = 5  # at their pace after a gap, before the missing ones are counted by the least late of them
FEWEST_TOGETHER: Final = 4  # fewest sensors that are read together a few times a period
LONGEST_PERIOD_S: Final = 0.05  # period from which scans come too seldom to be read together, in [s]
RESTLESS_NS: Final = NS_PER_S  # time after a contact, in [ns], during which every scan is still read at once


class Cadence:
    """Cadence of one sensor: its period, and by that what did not come, since the wire does not number scans."""

    def __init__(self, rate_hz: float | None = None) -> None:
        self.last: Scan | None = None
        self.missed = 0  # scans that did not arrive, as far as gaps show
        self.silent = False  # it was reported
        self.since_ns = 0  # before which its silence does not count, as its link was away
        # Median of the newest intervals, which neither jitter nor a gap moves; None while too few have arrived.
        self.period_ns = self._stated_ns = None if rate_hz is None else round(NS_PER_S / rate_hz)
        self._intervals: deque[int] = deque(maxlen=31)
        self._forget_pace(None)

    @property
    def rate_hz(self) -> float | None:
        """Rate of the newest scans in [Hz]; None while too few have arrived."""
        return None if self.period_ns is None else NS_PER_S / self.period_ns

    def follow(self, scan: Scan) -> None:
        """Take the next scan."""
        before, self.last = self.last, scan
        if before is None:
            self._paced_from = scan
            return
        gap_ns = scan.on_bus_ns - before.on_bus_ns
        if gap_ns > 0 and (scan.device_ns is not None or not scan.unread_ns):  # those that waited came at no pace
            self._intervals.append(gap_ns)
            if self._stated_ns is None and len(self._intervals) >= FEWEST_INTERVALS:
                self.period_ns = sorted(self._intervals)[len(self._intervals) // 2]
        period_ns = self.period_ns
        # Half of the fastest sensor's: scans that are nearer waited somewhere.
        if period_ns and period_ns >= 500_000 and (self._before_gap is not None or gap_ns > GAP_PERIODS * period_ns):
            self._follow_gap(before, scan, gap_ns, period_ns)

    def _forget_pace(self, scan: Scan | None) -> None:
        self._before_gap: Scan | None = None  # scan before a gap whose missing ones are not counted yet
        self._paced_from = scan
        self._gap_period_ns = 0.0
        self._lateness: list[float] = []  # of the scans after it, in periods

    def _follow_gap(self, before: Scan, scan: Scan, gap_ns: int, period_ns: int) -> None:
        """Count the scans missing in a gap, once scans come at their pace again: late ones come in a burst."""
        first = self._before_gap
        if gap_ns > GAP_PERIODS * period_ns:
            if first is None:
                self._before_gap, self._gap_period_ns = before, self._mean_period_ns(before, period_ns)
            self._lateness.clear()
        elif first is not None and period_ns > GAP_PERIODS * self._gap_period_ns:
            self._forget_pace(scan)  # a wrong pace only looked like a gap: scans read late come in bursts
        elif first is not None and gap_ns >= self._gap_period_ns / 2:
            periods = (scan.on_bus_ns - first.on_bus_ns) / self._gap_period_ns
            self._lateness.append(periods - (scan.number - first.number))
            if len(self._lateness) == SETTLING_SCANS:
                self.missed += max(round(min(self._lateness)), 0)
                self._forget_pace(scan)

    def _mean_period_ns(self, scan: Scan, period_ns: int) -> float:
        """Return the mean period over all scans since the last gap, if there were enough, else the median."""
        first = self._paced_from or scan
        scans = scan.number - first.number
        mean_ns = (scan.on_bus_ns - first.on_bus_ns) / scans if scans else 0.0
        return mean_ns if scans >= 32 else max(period_ns, mean_ns)  # a median 1 % off misses a scan in each second


class ReadingPace(NamedTuple):
    """Times of reading, the same for all links."""

    every_s: float = 0.0  # time between two reads, in [s]; 0: as scans come
    reads: int = 1  # number of reads after which bytes are made into scans


class Cadences:
    """Cadences of all sensors, those that fall silent while another goes on, and the pace at which to read them."""

    def __init__(self, expected: Iterable[str] = (), *, recorded: bool = False, rate_hz: float | None = None) -> None:
        """Begin without a scan, with the sensors that should be there; a recording has no cable to check."""
        self.missed = self.late = 0  # patterns are late that were ready more than one period after their scan
        self.patience_s = 0.0  # longest time for which results of sensors at rest may wait
        self.waited_ns = 0.0  # a scan before it came late because of the pace, so that its pattern is not late
        self.pace = ReadingPace()
        self._recorded, self._rate_hz = recorded, rate_hz
        self._expected = set(expected)
        self._sensors: dict[str, Cadence] = {}
        self._absent: set[str] = set()
        self._first_ns: int | None = None
        self._newest_ns = self._restless_ns = -RESTLESS_NS

    def begin_anew(self, time_ns: int, sensors: str = "") -> None:
        """Restart the silence of sensors whose names begin so at `time_ns` [ns], when their link came back."""
        for name, cadence in self._sensors.items():
            if name.startswith(sensors):
                cadence.since_ns = time_ns

    def follow(self, result: Result) -> Event | None:
        """Take the next result of a sensor; return an event if the sensor was silent."""
        scan = result.scan
        cadence = self._sensors.get(scan.sensor)
        if cadence is None:
            cadence = self._sensors[scan.sensor] = Cadence(self._rate_hz)
            cadence.silent = scan.sensor in self._absent
            self._expected.discard(scan.sensor)
        if self._first_ns is None:
            self._first_ns = scan.time_ns
        last, missed = cadence.last, cadence.missed
        cadence.follow(scan)
        self.missed += cadence.missed - missed
        if result.latency_us is not None and cadence.period_ns is not None and scan.time_ns >= self.waited_ns:
            self.late += result.latency_us * 1e3 > cadence.period_ns
        self._newest_ns = max(self._newest_ns, scan.time_ns)
        if result.state != "idle" or scan.device_ns is None:  # only time stamps show pauses that a late read hides
            self._restless_ns = scan.time_ns
        if not cadence.silent:
            return None
        cadence.silent = False
        away_s = (scan.time_ns - (self._first_ns if last is None else last.time_ns)) / NS_PER_S
        return Event(scan.time_ns, "back", scan.sensor, f"sensor {scan.sensor} is back after {away_s:.1f} s")

    def look(self) -> list[Event]:
        """Return events of sensors silent while another is not, since a link reports its own; choose the pace anew."""
        rests = self._newest_ns - self._restless_ns > RESTLESS_NS
        if rests or self.pace.every_s or len(self._sensors) >= FEWEST_TOGETHER:
            self._choose_pace(rests=rests)
        if len(self._sensors) + len(self._expected) < 2 or self._first_ns is None:
            return []
        now_ns = self._newest_ns
        events: list[Event] = []
        for sensor, cadence in self._sensors.items():
            last = cadence.last
            if last is None or cadence.silent or now_ns - max(last.time_ns, cadence.since_ns) <= SENSOR_SILENT_NS:
                continue
            cadence.silent = True
            events.append(self._silence(sensor, last.time_ns))
        if self._expected and now_ns - self._first_ns > SENSOR_SILENT_NS:
            missing, self._expected = sorted(self._expected), set()
            self._absent.update(missing)
            events += [self._silence(sensor, self._first_ns) for sensor in missing]
        return events

    def _silence(self, sensor: str, since_ns: int) -> Event:
        why = "check its cable and its controller, since other sensors continue"
        why = "the recording has none" if self._recorded else why
        silent_s = (self._newest_ns - since_ns) / NS_PER_S
        return Event(self._newest_ns, "silent", sensor, f"no scan from sensor {sensor} for {silent_s:.1f} s: {why}")

    def _choose_pace(self, *, rests: bool) -> None:
        """Choose the pace for the sensors so far, by the fastest of them."""
        period_s = math.inf
        for cadence in self._sensors.values():
            period_s = min(period_s, (cadence.period_ns or math.inf) / NS_PER_S)
        pace, before = ReadingPace(), self.pace
        if rests and 0.005 <= period_s < min(LONGEST_PERIOD_S, self.patience_s / 2):  # faster ones never wait
            pace = ReadingPace(period_s, int(self.patience_s / period_s))
        elif len(self._sensors) >= FEWEST_TOGETHER and period_s < LONGEST_PERIOD_S:
            pace = ReadingPace(period_s / 4)
        if (pace.reads > 1) == (before.reads > 1) and abs(pace.every_s - before.every_s) < 0.1 * pace.every_s:
            return  # a measured period jitters
        if pace.reads > 1:
            self.waited_ns = math.inf
        elif before.reads > 1:
            self.waited_ns = self._newest_ns + 2 * NS_PER_S * before.every_s
        self.pace = pace
