"""Patterns that a network predicts for a frozen set, and the interval that it predicts for each pixel."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.test_set import FrozenSet
from train.errors import CheckpointError
from train.learning.checkpoint import infer
from train.learning.interval_fit import LEVEL, half_width_mm
from train.networks.blocks import PatternNet
from train.report import Row, with_interval


@dataclass(frozen=True, slots=True)
class Intervals:
    """Patterns and deviations predicted for the n frames of a frozen set, with the truth.

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
        """Return a mask (n, H, W), true where the truth lies within the interval."""
        return np.abs(self.truth - self.pattern) <= half_width_mm(self.deviation, level)

    def width_percent(self) -> NDArray[np.floating]:
        """Return the width of the intervals, (n, H, W), in [% of the frame's indentation]."""
        return 200 * half_width_mm(self.deviation) / self.frozen.indentation_mm[:, None, None]

    def cells(self) -> Row:
        """Return coverage and mean width of the 90 % interval, each with its interval by tap, as cells of a row."""
        return {
            "covered %": with_interval(100 * self.covered().mean(axis=(1, 2)), self.frozen.tap, 1),
            "width %": with_interval(self.width_percent().mean(axis=(1, 2)), self.frozen.tap, 1),
        }


def intervals(net: PatternNet, frozen: FrozenSet, given: int | None = None) -> Intervals:
    """Run a network on every frame, with the newest `given` taps or all that it takes.

    Raises:
        CheckpointError: the network predicts no deviations.
    """
    pattern, deviation = infer(net, frozen.windows(net.taps, given))
    if deviation is None:
        raise CheckpointError(f"{type(net).__name__} gives no deviations: take a compact network")
    return Intervals(frozen, frozen.patterns(), pattern, deviation)
