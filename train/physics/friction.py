"""Friction between a rigid surface and the pad: sticking and slipping areas, and traction.

Inputs are the pressure, and the slide and turn of the surface since first contact. A cell in contact sticks, and
moves with the surface, or slips, and bears the traction mu p against its slip (Coulomb; Cattaneo 1938 and Mindlin
1949 for spheres). One step of monotone loading: pressure first, then slide and twist together, without history.

That is a convex problem: the least of 1/2 t C t - t g over tractions with |t| <= mu p in each cell, C the pad's
compliance and g the surface's movement. It is solved by spectral projected gradients (Birgin, Martinez and Raydan
2000), with one product with C per step. Slopes of the surface are taken as small. Friction does not resist here that
pressure alone spreads the surface, and the effect of traction on pressure is left out (Goodman 1962): exact for a thick
layer of nu = 0.5, while the pressure under a wide contact on a bonded one would lean by some tens of per cent.
"""

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from train.physics.elastic_layer import Layer, PadGrid, surface_tensor

_REMEMBERED: Final = 4
"""Number of past energies whose largest a step may not exceed: the method does not descend at every step."""


class FrictionSolver:
    """Solver of poses on a square grid over one pad, with the arguments of `train.physics.contact.ContactSolver`."""

    def __init__(self, layer: Layer, size: int, cell_mm: float, dtype: torch.dtype = torch.float32) -> None:
        def compliance(q_x: NDArray[np.floating], q_y: NDArray[np.floating]) -> NDArray[np.float64]:
            xx, yy, xy = surface_tensor(layer, q_x, q_y)
            # The highest wave is its own mirror image, so an odd transfer is zero there.
            xy[len(xy) // 2] = xy[:, -1] = 0.0
            return np.stack([xx, yy, xy])

        self.size = size
        self.cell_mm = cell_mm
        self._dtype = dtype
        self._grid = PadGrid(layer, size, cell_mm, dtype, compliance)

    def displacement_mm(self, traction_mpa: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the surface displacement (n, 2, size, size) under tractions of that shape, in [mm]."""
        return self._displace(torch.as_tensor(traction_mpa, dtype=self._dtype)).numpy().astype(np.float32)

    def solve(
        self,
        pressure_mpa: NDArray[np.floating],
        slide_mm: NDArray[np.floating],
        twist_rad: NDArray[np.floating],
        friction: NDArray[np.floating],
        tolerance: float = 1e-3,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Slide (n, 2) surfaces to the right and back, and turn them (n,) about the pad's centre from right to back.

        They touch with pressures (n, size, size), where these are above 0, and have coefficients of friction mu (n,).
        Returned are tractions on the pad to the right and back, (n, 2, size, size) in [MPa], and residuals (n,): the
        RMS error over the contact of the movement, which should vanish where cells stick, and oppose the traction where
        they slip, as a share of the surface's movement.
        """
        count = len(pressure_mpa)
        along_mm = (np.arange(self.size) - (self.size - 1) / 2) * self.cell_mm
        turn = twist_rad[:, None, None] * along_mm
        moved_mm = (
            np.broadcast_to(slide_mm[:, 0, None, None] - turn.mT, pressure_mpa.shape),
            np.broadcast_to(slide_mm[:, 1, None, None] + turn, pressure_mpa.shape),
        )
        limit_mpa = np.maximum(pressure_mpa, 0) * friction[:, None, None]
        traction_mpa = np.zeros((count, 2, self.size, self.size), dtype=np.float32)
        residual = np.zeros(count, dtype=np.float32)
        for poses, place in self._grid.boxes(limit_mpa > 0):
            found, error = self._projected_gradients(
                torch.as_tensor(limit_mpa[place], dtype=self._dtype)[:, None],
                torch.as_tensor(np.stack([part[place] for part in moved_mm], axis=1), dtype=self._dtype),
                tolerance,
            )
            for part, axis in zip(traction_mpa.swapaxes(0, 1), range(2), strict=True):
                part[place] = found[:, axis].numpy()
            residual[poses] = error.numpy()
        return traction_mpa, residual

    def _projected_gradients(
        self, limit: torch.Tensor, moved: torch.Tensor, tolerance: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return tractions (n, 2, height, width) and residuals; limits are (n, 1, height, width)."""
        touching = limit > 0
        wanted = torch.where(touching, moved, 0.0)
        cells = touching.sum(dim=(1, 2, 3)).clamp_min(1)
        scale = torch.sqrt(_dot(wanted, wanted)[:, 0, 0, 0] / cells).clamp_min(1e-30)
        cell = self._grid.cell_mm_per_mpa
        # The start takes the contact as moving together, with a response close to that of an even traction.
        response = self._displace(wanted)
        length = _dot(wanted, wanted) / _dot(wanted, response).clamp_min(1e-30)
        traction = _project(length * wanted, limit)
        slip = torch.where(touching, self._displace(traction) - wanted, 0.0)
        result, residual = traction.clone(), torch.zeros(len(traction), dtype=self._dtype)
        working = torch.arange(len(traction))
        energies = (_dot(traction, slip - wanted) / 2).expand(-1, _REMEMBERED, 1, 1).clone()
        steps = 0
        while True:
            short = cell * (traction - _project(traction - slip / cell, limit))
            error = torch.sqrt(_dot(short, short)[:, 0, 0, 0] / cells) / scale
            done = error < tolerance
            if steps == 60:
                done[:] = True
            if bool(done.any()):
                result[working[done]], residual[working[done]] = traction[done], error[done]
                if bool(done.all()):
                    break
                more = ~done
                working, limit, touching, wanted = working[more], limit[more], touching[more], wanted[more]
                cells, scale, traction, slip = cells[more], scale[more], traction[more], slip[more]
                length, energies = length[more], energies[more]
            steps += 1
            direction = _project(traction - length * slip, limit) - traction
            response = torch.where(touching, self._displace(direction), 0.0)
            curve = _dot(direction, response).clamp_min(1e-30)
            descent = _dot(direction, slip)
            before = _dot(traction, slip - wanted) / 2
            whole = before + descent + curve / 2
            # A whole step, unless it exceeds all of the last energies; then the minimum along it.
            share = torch.where(whole <= energies.amax(dim=1, keepdim=True), 1.0, (-descent / curve).clamp(0.0, 1.0))
            traction = traction + share * direction
            slip = slip + share * response
            energies[:, steps % _REMEMBERED] = (before + share * descent + share**2 * curve / 2)[:, 0]
            length = _dot(direction, direction) / curve
        return result, residual

    def _displace(self, traction: torch.Tensor) -> torch.Tensor:
        """Return the displacement within boxes (n, 2, height, width) under tractions in them."""
        height, width = traction.shape[2:]
        padded = (2 * height, 2 * width)
        xx, yy, xy = self._grid.spectrum(height, width)
        right, back = torch.fft.rfft2(traction, s=padded).unbind(dim=1)
        moved = torch.stack([xx * right + xy * back, xy * right + yy * back], dim=1)
        return torch.fft.irfft2(moved, s=padded)[:, :, :height, :width]


def _project(traction: torch.Tensor, limit: torch.Tensor) -> torch.Tensor:
    """Return the nearest tractions that friction can bear."""
    size = torch.sqrt(traction[:, :1] ** 2 + traction[:, 1:] ** 2)
    return traction * (limit / torch.maximum(size, limit).clamp_min(1e-30))


def _dot(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    return (one * other).sum(dim=(1, 2, 3), keepdim=True)
