"""Contact of a rigid surface with the pad: contact area, pressure, and the traction of friction.

Pressure >= 0, gap >= 0, and one of them zero in every cell (Polonsky and Keer 1999: conjugate gradients on the touching
cells, which change from step to step). The load of a cell at a surface's edge is proportional to its covered share:
readings then change continuously while the surface moves, where whole cells alone make them jump by 1 to 2 %
(docs/decisions.md).

Friction follows from the pressure, and the slide and turn of the surface since first contact. A cell in contact sticks,
and moves with the surface, or slips, and bears the traction mu p against its slip (Coulomb). One step of monotone
loading: pressure first, then slide and twist together, without history. That is a convex problem: the least of
1/2 t C t - t g over tractions with |t| <= mu p in each cell, C the pad's compliance and g the surface's movement, by
spectral projected gradients (Birgin, Martinez and Raydan 2000). Friction does not resist here that pressure alone
spreads the surface, and the effect of traction on pressure is left out (Goodman 1962): exact for a thick layer of nu =
0.5, while the pressure under a wide contact on a bonded one would lean by some tens of per cent.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import USPA44
from train.physics.elastic_layer import Layer, PadGrid, SideGive, surface_compliance, surface_tensor, waves


@dataclass(frozen=True, slots=True)
class Cover:
    """Compliance of the object, and a cloth or glove between it and the pad."""

    soft_mpa: float = 0.0  # shear modulus of a soft object, thick and incompressible; 0 for a rigid one
    cloth_mm: float = 0.0  # thickness of the cloth; 0 for none
    cloth_mpa: float = 1.0  # its modulus under even pressure

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
        padded = (2 * size, 2 * size)
        q_x, q_y = waves(2 * size, cell_mm)
        spectrum = np.fft.rfft2(pressure, s=padded)
        spread = np.fft.irfft2(spectrum * self._spread(np.hypot(q_x, q_y)), s=padded)
        return np.maximum(spread[:size, :size], 0).astype(np.float32)

    def _spread(self, q_per_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share of a pressure wave that a cloth transmits, (1 + q t) exp(-q t): Johnson 1985, Eq. 2.23."""
        depth = q_per_mm * self.cloth_mm
        return (1 + depth) * np.exp(-depth)


BARE: Final = Cover()

_MAX_STEPS: Final = 200
# Depth in indentations up to which cells may touch: next to a contact the pad bulges, by at most 0.39 of it.
REACH: Final = 1.5


class ContactSolver:
    """Solver of poses on a square grid over one pad, `size` cells a side; `sides` is the amplitude of free ones."""

    def __init__(
        self,
        layer: Layer,
        size: int,
        cell_mm: float,
        dtype: torch.dtype = torch.float32,
        cover: Cover = BARE,
        sides: float = 0.0,
    ) -> None:
        self.size = size
        self.cell_mm = cell_mm
        self._grid = PadGrid(layer, size, cell_mm, dtype, lambda q_x, q_y: cover.compliance(layer, np.hypot(q_x, q_y)))
        self._dtype = dtype
        self._side_give = SideGive.of(sides, layer, size, cell_mm, dtype) if sides else None

    @property
    def cell_compliance_mm_per_mpa(self) -> float:
        """Displacement of a cell under its own pressure alone, in [mm/MPa]."""
        return self._grid.cell_mm_per_mpa

    def displacement_mm(self, pressure_mpa: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the surface displacement downwards under pressures (n, size, size), in [mm]."""
        pressure = torch.as_tensor(pressure_mpa, dtype=self._dtype)
        return self._respond(pressure, torch.zeros(()), self._side_give).numpy().astype(np.float32)

    def solve(
        self,
        depth_mm: NDArray[np.floating],
        indentation_mm: float | NDArray[np.floating] = 1.0,
        tolerance: float = 1e-3,
        covered: NDArray[np.floating] | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Press surfaces into the pad, and return the pressures (n, size, size) in [MPa] and the residuals (n,).

        Depths (n, size, size) are below the point of first contact, whose indentation is above 0, one for all or (n,).
        `covered`, (n, size, size), is the share of each cell that the surface covers, above 0 wherever a cell is
        reached; None for 1 everywhere. Pressures are means over cells. A residual is the RMS gap where pressure acts or
        surfaces overlap, over the indentation.
        """
        indentation = np.broadcast_to(np.asarray(indentation_mm, dtype=np.float64), len(depth_mm))
        pressure_mpa = np.zeros(depth_mm.shape, dtype=np.float32)
        residual = np.zeros(len(depth_mm), dtype=np.float32)
        for poses, place in self._grid.boxes(depth_mm < REACH * indentation[:, None, None]):
            press = torch.as_tensor(indentation[poses, None, None], dtype=self._dtype)
            depth = torch.as_tensor(depth_mm[place], dtype=self._dtype)
            share = torch.ones(()) if covered is None else torch.as_tensor(covered[place], dtype=self._dtype)
            # The pressure on the covered share is 1 / share times the cell's mean.
            give = self.cell_compliance_mm_per_mpa * torch.where(share > 0, 1 / share - 1, 0.0)
            sides = None if self._side_give is None else self._side_give.boxes(*place[1:])
            pressure, error = self._conjugate_gradients(depth, press, tolerance, give, sides)
            pressure_mpa[place] = pressure.numpy()
            residual[poses] = error.numpy()
        return pressure_mpa, residual

    def _conjugate_gradients(
        self,
        depth: torch.Tensor,
        press: torch.Tensor,
        tolerance: float,
        give: torch.Tensor,
        sides: SideGive | None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return pressures and residuals of boxes (n, height, width) pressed in by (n, 1, 1).

        `give` is the additional displacement per pressure of partly covered cells, in [mm/MPa].
        """
        reachable = depth < REACH * press
        wanted = torch.where(reachable, press - depth, 0.0)
        pressure = wanted.clamp_min(0) / (self.cell_compliance_mm_per_mpa + give)
        give = give.expand_as(pressure)
        result, residual = pressure.clone(), torch.zeros(len(pressure), dtype=self._dtype)
        working = torch.arange(len(pressure))
        gap = torch.where(reachable, self._respond(pressure, give, sides) - wanted, 0.0)
        direction = torch.zeros_like(pressure)
        energy_before = torch.ones_like(press)
        keep = torch.zeros_like(press)
        steps = 0
        while True:
            touching = pressure > 0
            gap_touching = torch.where(touching, gap, 0.0)
            wrong = touching | (gap < 0)
            error = _rms(torch.where(wrong, gap, 0.0), wrong) / press[:, 0, 0]
            done = error < tolerance
            if steps == _MAX_STEPS:
                done[:] = True
            if bool(done.any()):
                result[working[done]], residual[working[done]] = pressure[done], error[done]
                if bool(done.all()):
                    break
                more = ~done
                working, wanted, reachable, press = working[more], wanted[more], reachable[more], press[more]
                give, sides = give[more], None if sides is None else sides[more]
                pressure, gap, direction, touching = pressure[more], gap[more], direction[more], touching[more]
                gap_touching, energy_before, keep = gap_touching[more], energy_before[more], keep[more]
            steps += 1
            energy = _total(gap_touching**2)
            direction = torch.where(touching, gap + keep * (energy / energy_before) * direction, 0.0)
            energy_before = energy.clamp_min(1e-30)
            response = self._respond(direction, give, sides)
            length = _total(gap_touching * direction) / _total(response * direction).clamp_min(1e-30)
            stepped = pressure - length * direction
            pressure = stepped.clamp_min(0.0)
            # A cell without pressure that would overlap the surface returns to the contact; the search then restarts.
            returning = (pressure <= 0) & (gap < 0) & reachable
            pressure = torch.where(returning, -length.abs() * gap, pressure)
            keep = (~returning.flatten(1).any(dim=1)).to(self._dtype)[:, None, None]
            # Where no cell was cut off or returned, the step was linear, and so is the gap's.
            bent = (returning | (stepped < 0)).flatten(1).any(dim=1)
            gap = torch.where(reachable, gap - length * response, 0.0)
            if bool(bent.any()):
                again = self._respond(pressure[bent], give[bent], None if sides is None else sides[bent]) - wanted[bent]
                gap[bent] = torch.where(reachable[bent], again, 0.0)
        return result, residual

    def _respond(self, pressure: torch.Tensor, give: torch.Tensor, sides: SideGive | None) -> torch.Tensor:
        """Return the displacement including the partial cells' compliance and the free sides."""
        height, width = pressure.shape[1:]
        padded = (2 * height, 2 * width)
        wave = torch.fft.rfft2(pressure, s=padded) * self._grid.spectrum(height, width)
        displacement = torch.fft.irfft2(wave, s=padded)[:, :height, :width] + give * pressure
        return displacement if sides is None else displacement + sides.displacement_mm(pressure)


def _total(maps: torch.Tensor) -> torch.Tensor:
    return maps.sum(dim=(1, 2), keepdim=True)


def _rms(maps: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
    return torch.sqrt((maps**2).sum(dim=(1, 2)) / where.sum(dim=(1, 2)).clamp_min(1))


_REMEMBERED: Final = 4  # past energies whose largest a step may not exceed: the method does not descend at every step


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

        They touch with pressures (n, size, size) and have coefficients of friction mu (n,). Returned are tractions on
        the pad to the right and back, (n, 2, size, size) in [MPa], and residuals (n,): the RMS over the contact of what
        moves against Coulomb's law, as a share of the surface's movement.
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
            traction, error = self._projected_gradients(
                torch.as_tensor(limit_mpa[place], dtype=self._dtype)[:, None],
                torch.as_tensor(np.stack([part[place] for part in moved_mm], axis=1), dtype=self._dtype),
                tolerance,
            )
            for part, axis in zip(traction_mpa.swapaxes(0, 1), range(2), strict=True):
                part[place] = traction[:, axis].numpy()
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


def _dot(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    return (first * second).sum(dim=(1, 2, 3), keepdim=True)
