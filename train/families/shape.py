"""Shape under the pad: its height at any place, and its position under the pad."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Lengths = NDArray[np.float32]
"""Lengths at places on a grid, in [mm]."""
Height = Callable[[Lengths, Lengths], Lengths]
"""Height in [mm] at x and y in [mm], NOWHERE_MM off the shape; higher parts touch the pad first."""

NOWHERE_MM: Final = -1e3
"""Height where there is no shape, out of any press's reach."""


@dataclass(frozen=True, slots=True)
class Lie:
    """Position, turn and tilt of a shape under the pad.

    Attributes:
        x_mm: place of the shape's origin, to the right of the pad's centre.
        y_mm: place of the shape's origin, below the pad's centre, down the rows.
        angle_deg: turn of the shape.
        slope_x: rise of the shape along the pad's x, in [mm/mm].
        slope_y: rise of the shape along the pad's y, in [mm/mm].
    """

    x_mm: float = 0.0
    y_mm: float = 0.0
    angle_deg: float = 0.0
    slope_x: float = 0.0
    slope_y: float = 0.0

    def seen(self, height: Height, x_mm: Lengths, y_mm: Lengths) -> Lengths:
        """Return the heights of the shape, placed like this, at places on the pad."""
        turn = np.radians(self.angle_deg)
        cosine, sine = np.float32(np.cos(turn)), np.float32(np.sin(turn))
        right, down = x_mm - np.float32(self.x_mm), y_mm - np.float32(self.y_mm)
        across, along = cosine * right + sine * down, cosine * down - sine * right
        raised = height(across.astype(np.float32, copy=False), along.astype(np.float32, copy=False))
        if self.slope_x or self.slope_y:
            raised = raised + np.float32(self.slope_x) * x_mm + np.float32(self.slope_y) * y_mm
        return raised.astype(np.float32, copy=False)


def where(inside: NDArray[np.bool_], height: NDArray[np.floating] | float) -> Lengths:
    """Return the height inside a shape, NOWHERE_MM elsewhere."""
    return np.where(inside, height, np.float32(NOWHERE_MM)).astype(np.float32, copy=False)


def raised(inside: NDArray[np.bool_], height_mm: float) -> Lengths:
    """Return a figure raised by `height_mm` from a plate at height 0."""
    return np.where(inside, np.float32(height_mm), np.float32(0))


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
