"""What a network says of a frozen set: its patterns, and the interval in which it says each pixel lies."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.test_set import FrozenSet
from train.errors import CheckpointError
from train.learning.checkpoint import infer
from train.learning.interval_calibration import LEVEL, half_width_mm
from train.networks.blocks import PatternNet
from train.report import Row, with_interval


@dataclass(frozen=True, slots=True)
class Intervals:
    """Patterns of a frozen set's n frames with their deviations, beside the truth.

    Attributes:
        frozen: the frames.
        truth: (n, H, W) in [mm].
        pattern: (n, H, W) in [mm].
        deviation: (n, H, W) above 0, in [mm].
    """

    frozen: FrozenSet
    truth: NDArray[np.float32]
    pattern: NDArray[np.float32]
    deviation: NDArray[np.float32]

    def covered(self, level: float = LEVEL) -> NDArray[np.bool_]:
        """Pixels whose truth lies within the interval, (n, H, W)."""
        return np.abs(self.truth - self.pattern) <= half_width_mm(self.deviation, level)

    def width_percent(self, level: float = LEVEL) -> NDArray[np.floating]:
        """How wide the intervals are, (n, H, W) in [% of the frame's indentation]: light taps count as firm ones."""
        return 200 * half_width_mm(self.deviation, level) / self.frozen.indentation_mm[:, None, None]

    def cells(self) -> Row:
        """Coverage and mean width of the 90 % interval, each with its interval by tap, as cells of a row."""
        return {
            "covered %": with_interval(100 * self.covered().mean(axis=(1, 2)), self.frozen.tap, 1),
            "width %": with_interval(self.width_percent().mean(axis=(1, 2)), self.frozen.tap, 1),
        }


def intervals(net: PatternNet, frozen: FrozenSet, given: int | None = None) -> Intervals:
    """Ask a network about every frame, with the newest `given` taps or all it takes.

    Raises:
        CheckpointError: the network gives no deviations.
    """
    pattern, deviation = infer(net, frozen.windows(net.taps, given))
    if deviation is None:
        raise CheckpointError(f"{type(net).__name__} gives no deviations: take a compact network")
    return Intervals(frozen, frozen.patterns(), pattern, deviation)
