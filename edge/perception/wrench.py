"""Force and torque on a pad from the traction on its face. No I/O.

The frame is that of the whole project: x to the right, y down the rows, and so, to be right-handed, z into the pad; its
origin is the middle of the face. Forces and torques act on the pad: pressing is a positive z force, and a twist, torque
about z, is positive if it turns x to y, clockwise for a viewer who looks at the pad from above.
"""

import math
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

LEAST_FORCE_N: Final = 0.1
"""Least z force for a centre of pressure, which noise would move about below it; a tap begins at ten times as much."""
_N_OF_KPA_MM2: Final = 1e-3


class Wrench(NamedTuple):
    """Total force and torque on a pad.

    Attributes:
        force_n: x, y, z in [N].
        torque_n_mm: about x, y, z through the middle of the face, in [N mm]; the last is the twist.
        centre_of_pressure_mm: x, y from the middle of the point where the z force alone would give the torques about x
            and y, in [mm]; None if hardly anything presses.
    """

    force_n: tuple[float, float, float]
    torque_n_mm: tuple[float, float, float]
    centre_of_pressure_mm: tuple[float, float] | None

    @property
    def shear_ratio(self) -> float | None:
        """Tangential over normal force, whatever the sensor's counts per newton; None if hardly anything presses."""
        x, y, z = self.force_n
        return math.hypot(x, y) / z if z >= LEAST_FORCE_N else None


def wrench_of(traction_kpa: NDArray[np.floating], pixel_mm: float) -> Wrench:
    """Sum a traction over the face to force and torque.

    Args:
        traction_kpa: (3, h, w) of x, y, z, constant within each pixel, the middle of the grid over that of the face,
            in [kPa].
        pixel_mm: side of a pixel, in [mm].
    """
    height, width = traction_kpa.shape[1:]
    fx, fy, fz, tx, ty, tz = (_sums(height, width, pixel_mm) @ traction_kpa.ravel()).tolist()
    centre = (-ty / fz, tx / fz) if fz >= LEAST_FORCE_N else None
    return Wrench((fx, fy, fz), (tx, ty, tz), centre)


@lru_cache(maxsize=8)
def _sums(height: int, width: int, pixel_mm: float) -> NDArray[np.float64]:
    """Return the matrix (6, 3 h w) that maps a flat traction to force and torque."""
    y_mm, x_mm = np.indices((height, width), dtype=np.float64).reshape(2, -1)
    x_mm, y_mm = (x_mm - (width - 1) / 2) * pixel_mm, (y_mm - (height - 1) / 2) * pixel_mm
    one, none = np.ones_like(x_mm), np.zeros_like(x_mm)
    rows = (
        *((one, none, none), (none, one, none), (none, none, one)),
        # (x, y, 0) cross (x, y, z of the traction)
        *((none, none, y_mm), (none, none, -x_mm), (-y_mm, x_mm, none)),
    )
    return np.array([np.concatenate(row) for row in rows]) * (_N_OF_KPA_MM2 * pixel_mm**2)
