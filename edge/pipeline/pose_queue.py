"""Poses that wait for the loop: any thread puts, the oldest are dropped where the loop is too slow."""

import json
import threading
from collections import deque
from collections.abc import Mapping
from typing import Any, Final

from edge.pipeline.pose_fields import PoseError, pose_of_fields
from firmware_bridge.poses.timed_pose import TimedPose

WAITING_POSES: Final = 1024
"""Poses that may wait, a second at 1000 poses/s: four times as long as the loop ever waits for a scan."""
LONGEST_BYTES: Final = 4096
"""Bytes of one message: ten times those of a pose."""


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
        try:
            parsed = json.loads(text) if len(text) <= LONGEST_BYTES else None
        except (ValueError, RecursionError):
            parsed = None
        if not isinstance(parsed, dict):
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
