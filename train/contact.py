"""Contact of a rigid surface with the pad: which cells touch, and at what pressure.

Pressure >= 0, gap >= 0, and one of them zero in every cell (Polonsky and Keer 1999: conjugate gradients on
the touching cells, which change from step to step). Displacement from pressure is a convolution, done by FFT
on a padded grid. Many poses are solved side by side.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from train.layer import Layer, surface_compliance

_MAX_STEPS: Final = 200
_PADDED_LENGTHS: Final = 2
"""Grid with padding over grid: the response of a bonded layer dies within a few thicknesses."""


@dataclass(frozen=True, slots=True)
class ContactResult:
    """Solution of a batch of poses.

    Attributes:
        pressure_mpa: (n, size, size), in [MPa].
        displacement_mm: (n, size, size), surface displacement downwards, in [mm].
        steps: conjugate-gradient steps taken.
        residual: (n,) root mean square gap error where pressure acts, as a share of the indentation.
    """

    pressure_mpa: NDArray[np.float32]
    displacement_mm: NDArray[np.float32]
    steps: int
    residual: NDArray[np.float32]


class ContactSolver:
    """Solves poses on a square grid over one pad.

    Args:
        layer: the pad.
        size: cells along a side.
        cell_mm: their size, in [mm].
        dtype: torch.float32 or torch.float64.
    """

    def __init__(self, layer: Layer, size: int, cell_mm: float, dtype: torch.dtype = torch.float32) -> None:
        self.size = size
        self.cell_mm = cell_mm
        self._padded = _PADDED_LENGTHS * size
        q_x = 2 * np.pi * np.fft.rfftfreq(self._padded, cell_mm)
        q_y = 2 * np.pi * np.fft.fftfreq(self._padded, cell_mm)
        compliance = surface_compliance(layer, np.hypot(q_x[None, :], q_y[:, None]))
        self._compliance = torch.as_tensor(compliance, dtype=dtype)
        self._dtype = dtype

    def displace(self, pressure_mpa: torch.Tensor) -> torch.Tensor:
        """Surface displacement downwards of pressures (n, size, size), in [mm]."""
        spectrum = torch.fft.rfft2(pressure_mpa, s=(self._padded, self._padded))
        moved = torch.fft.irfft2(spectrum * self._compliance, s=(self._padded, self._padded))
        return moved[:, : self.size, : self.size]

    def solve(
        self, depth_mm: NDArray[np.float32], indentation_mm: float = 1.0, tolerance: float = 1e-3
    ) -> ContactResult:
        """Press surfaces of the given depths into the pad.

        For flat surfaces the solution is linear in the indentation: one solve serves all depths of a tap.

        Args:
            depth_mm: (n, size, size), how far each cell lies below the highest point, in [mm].
            indentation_mm: how deep the highest point is pressed in, > 0, in [mm].
            tolerance: residual at which a pose is done.

        Raises:
            ValueError: shapes or values do not fit.
        """
        if depth_mm.shape[1:] != (self.size, self.size):
            raise ValueError(f"depth images of shape {depth_mm.shape}, expected (n, {self.size}, {self.size})")
        if not indentation_mm > 0:
            raise ValueError(f"indentation is {indentation_mm} mm, expected a positive depth")
        wanted = indentation_mm - torch.as_tensor(depth_mm, dtype=self._dtype)
        reachable = wanted > 0
        pressure = torch.where(reachable, wanted / self._compliance.mean(), 0.0)
        direction = torch.zeros_like(pressure)
        energy_before = torch.ones(len(pressure), 1, 1, dtype=self._dtype)
        keep = torch.zeros(len(pressure), 1, 1, dtype=self._dtype)
        residual = torch.full((len(pressure),), torch.inf, dtype=self._dtype)
        steps = 0
        while steps < _MAX_STEPS:
            steps += 1
            gap = torch.where(reachable, self.displace(pressure) - wanted, 0.0)
            touching = pressure > 0
            gap_touching = torch.where(touching, gap, 0.0)
            residual = _rms(gap_touching, touching) / indentation_mm
            if bool((residual < tolerance).all()):
                break
            energy = _total(gap_touching**2)
            direction = torch.where(touching, gap + keep * (energy / energy_before) * direction, 0.0)
            energy_before = energy.clamp_min(1e-30)
            response = torch.where(touching, self.displace(direction), 0.0)
            length = _total(gap_touching * direction) / _total(response * direction).clamp_min(1e-30)
            pressure = torch.where(touching, pressure - length * direction, 0.0).clamp_min(0.0)
            # A cell that lifted off although it would sink in comes back; the search then starts afresh.
            returning = (pressure <= 0) & (gap < 0) & reachable
            pressure = torch.where(returning, -length.abs() * gap, pressure)
            keep = (~returning.flatten(1).any(dim=1)).to(self._dtype)[:, None, None]
        return ContactResult(
            pressure.numpy().astype(np.float32),
            self.displace(pressure).numpy().astype(np.float32),
            steps,
            residual.numpy().astype(np.float32),
        )


def _total(maps: torch.Tensor) -> torch.Tensor:
    return maps.sum(dim=(1, 2), keepdim=True)


def _rms(maps: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
    return torch.sqrt((maps**2).sum(dim=(1, 2)) / where.sum(dim=(1, 2)).clamp_min(1))
