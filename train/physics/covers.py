"""Compliant covers: a soft object, or a cloth or glove over the pad."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import USPA44
from train.physics.elastic_layer import Layer, surface_compliance


@dataclass(frozen=True, slots=True)
class Cover:
    """Compliance of the object, and a cloth between it and the pad.

    Attributes:
        soft_mpa: shear modulus of a soft object, thick and incompressible; 0 for a rigid one.
        cloth_mm: thickness of a cloth or glove over the pad; 0 for no cloth.
        cloth_mpa: its modulus under even pressure.
    """

    soft_mpa: float = 0.0
    cloth_mm: float = 0.0
    cloth_mpa: float = 1.0

    def compliance(self, layer: Layer, q_per_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the joint compliance of pad and cover at wave numbers, in [mm/MPa]."""
        compliance = surface_compliance(layer, q_per_mm)
        if self.cloth_mm:
            compliance = compliance * self._spread(q_per_mm) ** 2 + self.cloth_mm / self.cloth_mpa
        if self.soft_mpa:  # as thick as the pad is wide, incompressible
            compliance = compliance + 0.5 / (self.soft_mpa * np.hypot(q_per_mm, 2 / USPA44.width_mm))
        return compliance

    def passed_on(self, pressure: NDArray[np.float32], cell_mm: float) -> NDArray[np.float32]:
        """Return the pressure on the pad (size, size) under a cloth that spreads the pressure on its upper side."""
        if not self.cloth_mm:
            return pressure
        size = len(pressure)
        padded = 2 * size
        q_y = 2 * np.pi * np.fft.fftfreq(padded, cell_mm)
        q_x = 2 * np.pi * np.fft.rfftfreq(padded, cell_mm)
        spectrum = np.fft.rfft2(pressure, s=(padded, padded))
        spread = np.fft.irfft2(spectrum * self._spread(np.hypot(q_x[None], q_y[:, None])), s=(padded, padded))
        return np.maximum(spread[:size, :size], 0).astype(np.float32)

    def _spread(self, q_per_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share of a pressure wave that a cloth transmits: (1 + q t) exp(-q t).

        Source: Johnson 1985, Eq. 2.23, the pressure at a depth in a half-space.
        """
        depth = q_per_mm * self.cloth_mm
        return (1 + depth) * np.exp(-depth)


BARE: Final = Cover()
