"""Input of a pattern that is due."""

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.perception.sensor_state import Sensor


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
