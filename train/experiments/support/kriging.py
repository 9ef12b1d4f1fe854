"""Patterns by kriging: pressure and traction as Gaussian fields, read by the taxels through the nominal pad.

Both fields have mean zero and covariance exp(-d^2 / (2 length^2)); traction is weaker by a coefficient of friction.
A pad's readings are linear in the fields while loads are light, and so is the deflection of its face: the pattern
expected from readings is one matrix. The method does not use that pressure is never negative, nor the contact area.

Source: Rasmussen and Williams 2006, Eq. 2.23, with linear functionals of the field in place of its values.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import USPA44
from train.freeze import SCALE
from train.physics.contact import ContactSolver
from train.physics.gripped import GrippedPad

FRICTION: Final = 0.4
"""Standard deviation of either traction component over that of the pressure."""
_LIGHT_N: Final = 0.05
"""Load on one cell, in [N]; readings are proportional to it within one per cent."""


class Kriging:
    """Linear readings and deflections of one pad.

    Args:
        pad: its cells and constants are used; its taxels must be those of USPA44.
    """

    def __init__(self, pad: GrippedPad) -> None:
        self._size, self._cell_mm = pad.size, pad.cell_mm
        self._solver = ContactSolver(pad.pad.layer, pad.size, pad.cell_mm)
        cells, light_mpa = pad.size**2, np.float32(_LIGHT_N / pad.cell_mm**2)
        one = (np.eye(cells, dtype=np.float32) * light_mpa).reshape(-1, *2 * (pad.size,))
        none = np.zeros_like(one)
        fields = [(one, None)] + [(none, np.stack(both, axis=1)) for both in ((one, none), (none, one))]
        readings = np.stack(
            [
                pad.skin.frames(pressure[None], None if traction is None else traction[None])[0].reshape(cells, -1).T
                for pressure, traction in fields
            ]
        )
        # (3, 48, size, size) in counts per MPa: pressure and the two tractions.
        self._readings = readings.reshape(len(fields), -1, pad.size, pad.size) / light_mpa

    def matrix(self, length_mm: float, noise: float) -> NDArray[np.float32]:
        """Return the matrix from readings (n, 48) in counts to deflections (n, pixels) in [mm].

        Args:
            length_mm: correlation length of the fields, in [mm].
            noise: variance of a reading's error over the mean variance of readings.
        """
        along_mm = np.arange(self._size) * self._cell_mm
        alike = np.exp(-0.5 * ((along_mm[:, None] - along_mm) / length_mm) ** 2)
        covered = alike @ self._readings @ alike
        covered[1:] *= FRICTION**2
        among = np.einsum("fixy,fjxy->ij", covered, self._readings)
        among += noise * np.trace(among) / len(among) * np.eye(len(among))
        deflected = self._solver.displacement_mm(covered[0])
        side = USPA44.rows * SCALE
        rim = (self._size - side) // 2
        pixels = deflected[:, rim : rim + side, rim : rim + side].reshape(len(among), -1)
        return np.linalg.solve(among, pixels).astype(np.float32)
