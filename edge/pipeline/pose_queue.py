"""Poses as messages, and those that wait for the loop: any thread puts, a slow loop loses the oldest."""

import json
import threading
from collections import deque
from collections.abc import Mapping
from typing import Any, Final

from edge.validation import as_float
from firmware_bridge.poses.pad_pose import PLACE_ERROR_MM, TURN_ERROR_DEG, PadPose
from firmware_bridge.poses.timed_pose import TimedPose
from firmware_bridge.scans.scan import is_sensor_name

FURTHEST_AHEAD_NS: Final = 1_000_000_000
"""Longest time that a pose may lie ahead of now, in [ns]: all others until then would come too late."""
_FIELDS: Final = ("cmd", "x_mm", "y_mm", "turn_deg", "error_mm", "error_deg", "sensor", "time_ns", "holds")


LONGEST_BYTES: Final = 4096
"""Bytes of one message: ten times those of a pose."""


def json_object(message: str | bytes) -> dict[str, Any] | None:
    """Return the object of JSON in a stranger's message; None where it is another thing, or too long."""
    try:
        parsed = json.loads(message) if len(message) <= LONGEST_BYTES else None
    except (ValueError, RecursionError):
        return None
    return parsed if isinstance(parsed, dict) else None


class PoseError(ValueError):
    """A pose that cannot be taken, with a line for the user and a short name of the reason."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


def pose_of_fields(fields: Mapping[str, Any], now_ns: int) -> TimedPose:
    """Return the pose in parsed JSON such as {"cmd": "pose", "x_mm": 1.5, "y_mm": 0}, of its arrival if it has no time.

    Raises:
        PoseError: a field is missing, unknown, of another kind or out of range.
    """
    if fields.get("cmd", "pose") != "pose":
        raise PoseError("cmd", f"cmd is {_shown(fields['cmd'])}, expected pose: only poses are taken here")
    unknown = sorted(map(str, fields.keys() - set(_FIELDS)))
    if unknown:
        raise PoseError("unknown", f"it has {_shown(unknown[0])}, expected some of {', '.join(_FIELDS)}")
    number = dict.fromkeys(("x_mm", "y_mm"), None) | {
        "turn_deg": 0.0,
        "error_mm": PLACE_ERROR_MM,
        "error_deg": TURN_ERROR_DEG,
    }
    values = {name: _number(name, fields.get(name, default)) for name, default in number.items()}
    sensor, holds, time_ns = fields.get("sensor"), fields.get("holds", False), fields.get("time_ns", now_ns)
    if not (sensor is None or (isinstance(sensor, str) and is_sensor_name(sensor))):
        raise PoseError("sensor", f"sensor is {_shown(sensor)}, expected the name of a sensor, or null")
    if not isinstance(holds, bool):
        raise PoseError("holds", f"holds is {_shown(holds)}, expected true or false")
    if not isinstance(time_ns, int) or isinstance(time_ns, bool) or not 0 <= time_ns < 2**63:
        raise PoseError("time_ns", f"time_ns is {_shown(time_ns)}, expected a whole number of nanoseconds")
    try:
        pose = PadPose(**values)
    except ValueError as error:
        raise PoseError("range", str(error)) from error
    return in_time(TimedPose(pose, time_ns, sensor, holds), now_ns)


def in_time(timed: TimedPose, now_ns: int) -> TimedPose:
    """Return a pose that does not lie far ahead of now, or raise a PoseError."""
    ahead_ns = timed.time_ns - now_ns
    if ahead_ns > FURTHEST_AHEAD_NS:
        raise PoseError(
            "time_ns",
            f"time_ns is {ahead_ns / 1e9:.3g} s ahead of now, expected CLOCK_MONOTONIC of this machine, as in "
            "records: leave it out for the time of arrival",
        )
    return timed


def _number(name: str, value: object) -> float:
    number = as_float(value)
    if number is None:
        raise PoseError(name, f"{name} is {'missing' if value is None else _shown(value)}, expected a number")
    return number


def _shown(value: object) -> str:
    """Return a value of a stranger in a few printable characters."""
    try:
        return ascii(value)[:40]
    except ValueError:
        return "a number of too many digits"


WAITING_POSES: Final = 1024
"""Poses that may wait, a second at 1000 poses/s: four times as long as the loop ever waits for a scan."""


class PoseQueue:
    """Queue of poses from all sources of them, bounded; and of the reasons for which others are refused.

    Attributes:
        refused: poses that could not be taken.
        dropped: poses that waited too long, behind too many others.
        begun: True once there was a pose, or a reason to report; most runs have none, and follow none.
    """

    def __init__(self) -> None:
        self.begun = False
        self.refused = 0
        self.dropped = 0
        self._lock = threading.Lock()
        self._waiting: deque[TimedPose] = deque()
        self._reasons: dict[str, str] = {}

    def put(self, pose: TimedPose) -> None:
        """Put a pose; if too many wait, the oldest is dropped."""
        with self._lock:
            if len(self._waiting) >= WAITING_POSES:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(pose)
            self.begun = True

    def put_fields(self, fields: Mapping[str, Any], now_ns: int) -> None:
        """Put the pose in parsed JSON that arrived at `now_ns` [ns], or refuse it."""
        try:
            self.put(pose_of_fields(fields, now_ns))
        except PoseError as error:
            self.refuse(error)

    def put_json(self, text: bytes, now_ns: int, sensor: str | None = None) -> None:
        """Put the pose in a message of JSON, of this sensor if it names none, or refuse it."""
        parsed = json_object(text)
        if parsed is None:
            self.refuse(PoseError("json", f'{text[:40]!a} is not JSON such as {{"x_mm": 1.5, "y_mm": 0}}'))
            return
        if parsed.get("sensor") is None:
            parsed["sensor"] = sensor
        self.put_fields(parsed, now_ns)

    def refuse(self, error: PoseError) -> None:
        """Count a pose that cannot be taken."""
        with self._lock:
            self.refused += 1
            self.begun = True
            self._reasons.setdefault(error.reason, f"a pose is refused: {error}")

    def warn(self, reason: str, text: str) -> None:
        """Put a line on poses that are taken all the same; `reason` is a short name of it."""
        with self._lock:
            self.begun = True
            self._reasons.setdefault(reason, text)

    def take(self) -> list[TimedPose]:
        """Return the poses that wait, in the order in which they came."""
        if not self._waiting:
            return []
        with self._lock:
            poses, self._waiting = list(self._waiting), deque()
        return poses

    def take_reasons(self) -> dict[str, str]:
        """Return a line for each reason since the last call, by its short name."""
        if not self._reasons:
            return {}
        with self._lock:
            reasons, self._reasons = self._reasons, {}
        return reasons
