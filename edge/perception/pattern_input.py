"""Inputs of the patterns that are due, and the queue in which they wait for a call of the model."""

import math
from collections.abc import Hashable, Sequence
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from edge.inference.pose_input import scheduled_rows
from edge.perception.result import MADE, Result, overtaken, replace
from edge.perception.sensor_state import Sensor

SMOOTHING: Final = 0.1
"""Share of the newest call in the time that a pattern is expected to take."""


class Due(NamedTuple):
    """Input of a pattern that is due.

    Attributes:
        sensor: state of the sensor.
        window: (taps, 3, rows, cols) in zeroed counts, newest tap first.
        slots: places of these taps in the window of the sensor's tracker.
        poses: (taps, 5) as model input; None for a model that takes no poses.
        tap: number of the newest tap.
        made_by: what distinguishes the pattern from others of the same readings and poses.
    """

    sensor: Sensor
    window: NDArray[np.float32]
    slots: Sequence[int]
    poses: NDArray[np.float32] | None
    tap: int
    made_by: Hashable

    @classmethod
    def alone(cls, sensor: Sensor, readings: NDArray[np.float32], taps: int, made_by: Hashable) -> Self:
        """Return the input of readings (3, rows, cols) that are no tap, in a window of so many."""
        window = np.zeros((taps, *readings.shape), dtype=np.float32)
        window[0] = readings
        return cls(sensor, window, (0,), None if sensor.poses is None else scheduled_rows(1, 0.0), -1, made_by)

    def unchanged(self, result: Result) -> Result | None:
        """Return the result with the sensor's last pattern, or None if a new pattern is needed."""
        before = self.sensor.last
        if before is None or not self.sensor.last_reading.holds(self.window[0], self.made_by, self.poses):
            return None
        made = {name: getattr(before, name) for name in MADE}
        window = result.window
        if window is not None and before.window is not None and before.taps_used < len(window):
            # The pattern is of fewer taps than there are, where one did not belong.
            window = np.concatenate([window[:1], before.window[1:]])
        made |= {"taps_used": before.taps_used, "poses": before.poses, "reused_from": before.scan.number}
        return replace(result, **made, window=window)


class DueQueue:
    """Queue of one pattern a sensor, that of its newest scan: no sensor waits longer because another sends more."""

    def __init__(self) -> None:
        # A newer scan keeps the place of the one it overtakes: the sensor that has waited longest is the first.
        self._waiting: dict[str, tuple[Result, Due]] = {}
        self._pattern_us = 0.0

    def __len__(self) -> int:
        return len(self._waiting)

    def join(self, sensor: str, result: Result, due: Due) -> list[Result]:
        """Let a scan's pattern wait in the sensor's place; return the result that it overtakes, if any."""
        before = self._waiting.get(sensor)
        self._waiting[sensor] = result, due
        return [] if before is None else [overtaken(before[0])]

    def leave(self, sensor: str) -> list[Result]:
        """Give up the sensor's place, since its newest scan needs none; return the result that waited, if any."""
        before = self._waiting.pop(sensor, None) if self._waiting else None
        return [] if before is None else [overtaken(before[0])]

    def take(self, longest_us: float | None) -> list[tuple[Result, Due]]:
        """Return those that have waited longest, one at least, as many as are inferred in so long, in [us].

        Of calls that are needed for all of them, each takes as many.
        """
        count = len(self._waiting)
        if longest_us is not None and count:
            count = math.ceil(count / max(1, math.ceil(count * self._pattern_us / longest_us)))
        return [self._waiting.pop(sensor) for sensor in list(self._waiting)[:count]]

    def took(self, pattern_us: float) -> None:
        """Learn the time that each pattern of a call took, in [us]."""
        self._pattern_us += (SMOOTHING if self._pattern_us else 1.0) * (pattern_us - self._pattern_us)
