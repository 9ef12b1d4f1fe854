"""Poses of pads: in the object's plane and in the newest tap's axes, with their times, and a pad's course of them.

The axes are those of a pattern: x to the right, y down the rows; a turn goes from x to y, by the right-hand rule about
the axis that points into the page. With turn t, the pad's x axis lies along (cos t, sin t) in the object's plane. A
point p of the newest tap's pattern lies at R(t)^T (p - c) in that of an earlier tap whose relative pose has place c.
"""

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, fields, replace
from math import cos, hypot, inf, radians, sin
from typing import Final

PLACE_ERROR_MM: Final = 0.2
TURN_ERROR_DEG: Final = 1.0  # standard deviations of a pose on a gripper mounted by hand, where nothing else is stated
MOST: Final = 1e6
"""Largest coordinate in [mm] and turn in [deg], so that every difference of two is a number with a meaning."""


@dataclass(frozen=True, slots=True)
class PadPose:
    """Pose of a pad's centre in the object's plane; a ValueError for a number that is not finite or out of range."""

    x_mm: float
    y_mm: float
    turn_deg: float = 0.0  # from x to y
    error_mm: float = PLACE_ERROR_MM  # standard deviation of the place, along x and along y
    error_deg: float = TURN_ERROR_DEG  # standard deviation of the turn

    def __post_init__(self) -> None:
        for name, low in (("x_mm", -MOST), ("y_mm", -MOST), ("turn_deg", -MOST), ("error_mm", 0), ("error_deg", 0)):
            value = getattr(self, name)
            if not low <= value <= MOST:  # False of NaN
                raise ValueError(f"{name} is {value}, expected a number from {low:g} to {MOST:g}")

    def seen_from(self, newest: "PadPose") -> "PadPose":
        """Return this pose in the axes of a newer tap's pad, with the errors of both; the turn lies within 180 deg."""
        turn = radians(newest.turn_deg)
        x_mm, y_mm = self.x_mm - newest.x_mm, self.y_mm - newest.y_mm
        return PadPose(
            cos(turn) * x_mm + sin(turn) * y_mm,
            cos(turn) * y_mm - sin(turn) * x_mm,
            (self.turn_deg - newest.turn_deg + 180) % 360 - 180,
            hypot(self.error_mm, newest.error_mm),
            hypot(self.error_deg, newest.error_deg),
        )

    def away_mm(self, other: "PadPose", radius_mm: float) -> float:
        """Return how far the pad's points, `radius_mm` from its centre, moved from another pose: root mean square."""
        turned_mm = 2 * radius_mm * sin(radians(self.turn_deg - other.turn_deg) / 2)
        return hypot(self.x_mm - other.x_mm, self.y_mm - other.y_mm, turned_mm)


POSE_FIELDS: Final = tuple(field.name for field in fields(PadPose))


MOST_POSES: Final = 4096  # poses that are remembered: 40 s at 100 poses/s, longer than any tap lasts
GAP_NS: Final = 200_000_000  # longest time between two poses that is interpolated, in [ns]
AHEAD_NS: Final = 50_000_000
"""Longest time for which the course goes on after the last pose, in [ns]: a scan may arrive first."""


class PoseTrack:
    """Poses of one pad with their times, of which the newest MOST_POSES are remembered."""

    def __init__(self) -> None:
        self._times_ns: deque[int] = deque(maxlen=MOST_POSES)
        self._poses: deque[tuple[PadPose, bool]] = deque(maxlen=MOST_POSES)

    def __len__(self) -> int:
        return len(self._times_ns)

    def add(self, time_ns: int, pose: PadPose, *, holds: bool = False) -> bool:
        """Add the pose at a monotonic time in [ns], where the pad rests until the next one if it `holds`.

        False, and nothing is added, if one at the same time or later was added before.
        """
        if not time_ns > (self._times_ns[-1] if self._times_ns else -inf):  # nor where it is NaN
            return False
        self._times_ns.append(time_ns)
        self._poses.append((pose, holds))
        return True

    def at(self, time_ns: int) -> PadPose | None:
        """Return the pose at a time; None before the first pose, in a gap, and too long after the last one."""
        times_ns = self._times_ns
        # Nearly all scans are as new as the newest poses, so a search from the end is short.
        after = len(times_ns)
        if after and time_ns < times_ns[-1]:
            after = bisect_right(times_ns, time_ns)
        if not after:
            return None
        pose, holds = self._poses[after - 1]
        since_ns = time_ns - times_ns[after - 1]
        if holds or not since_ns:
            return pose
        if after < len(times_ns):
            return self._between(after - 1, after, time_ns)
        if since_ns > AHEAD_NS:
            return None
        ahead = self._ahead(since_ns)
        if ahead is None:
            return pose
        # As far as it is extrapolated it is uncertain.
        error_mm = hypot(ahead.error_mm, ahead.x_mm - pose.x_mm, ahead.y_mm - pose.y_mm)
        turned_deg = (ahead.turn_deg - pose.turn_deg + 180) % 360 - 180
        return replace(ahead, error_mm=error_mm, error_deg=hypot(ahead.error_deg, turned_deg))

    def _ahead(self, since_ns: int) -> PadPose | None:
        """Return the pose so long after the last one, by the course over at least as long before it; None if unknown.

        Poses that arrive in one burst lie microseconds apart by the time of their arrival, which shows no speed.
        """
        last = first = len(self._times_ns) - 1
        last_ns = self._times_ns[last]
        while first and last_ns - self._times_ns[first] < AHEAD_NS:
            if self._poses[first - 1][1] or last_ns - self._times_ns[first - 1] > GAP_NS:
                break
            first -= 1
        if last_ns - self._times_ns[first] < since_ns:
            return None
        return self._between(first, last, last_ns + since_ns)

    def _between(self, first: int, second: int, time_ns: int) -> PadPose | None:
        start_ns, end_ns = self._times_ns[first], self._times_ns[second]
        if end_ns - start_ns > GAP_NS:
            return None
        share = (time_ns - start_ns) / (end_ns - start_ns)
        start, end = self._poses[first][0], self._poses[second][0]
        turned_deg = (end.turn_deg - start.turn_deg + 180) % 360 - 180  # the shorter way round
        return PadPose(
            start.x_mm + share * (end.x_mm - start.x_mm),
            start.y_mm + share * (end.y_mm - start.y_mm),
            start.turn_deg + share * turned_deg,
            max(start.error_mm, end.error_mm),
            max(start.error_deg, end.error_deg),
        )


@dataclass(frozen=True, slots=True)
class TimedPose:
    """A pose with its monotonic time."""

    pose: PadPose
    time_ns: int
    sensor: str | None = None  # None for every sensor without poses of its own
    holds: bool = False  # the pad rests there until the next pose
    # Time of the first scan that was made with it at hand: it arrives after its own time, and a replay must wait, too.
    used_from_ns: int | None = None

    def later(self, by_ns: int) -> "TimedPose":
        """Return the same pose with later times."""
        used_from_ns = None if self.used_from_ns is None else self.used_from_ns + by_ns
        return replace(self, time_ns=self.time_ns + by_ns, used_from_ns=used_from_ns)
