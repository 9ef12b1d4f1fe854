"""Free sides of a pad, absent from the infinite layer: near them the pad is softer and bulges outwards.

The effect of a load on a side falls with the load's distance d' from the side, and spreads along the side by a bell
curve. The added displacement falls with distance d alike, so that the addition is symmetric and never negative:

    u(d, y) += amplitude / (G h) sum_sides sum_k a_k exp(-(d + d') / (h b_k)) exp(-(y - y')^2 / (2 (h c_k)^2)) F(d', y')

The magnets' movement gains a term of the same kind, with its own lengths. All constants are fitted to finite elements
of a frictionless 20 mm pad at four Poisson ratios (docs/decisions.md), with the same values for all four.
Amplitude 0 is the infinite layer. Lengths in [mm], forces in [N].
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from train.physics.elastic_layer import Layer

_WIDTH_MM: Final = 20.0
_GIVES: Final = ((0.959, 0.3415, 0.2247), (0.0255, 1.590, 0.6034))  # terms (a, b, c) of the surface's compliance


@dataclass(frozen=True, slots=True)
class FreeSides:
    """Four free sides of a square pad; amplitude 1 is as in the finite elements, 0 an infinite layer."""

    amplitude: float = 1.0

    def profiles(self, layer: Layer, cells_mm: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return shares of the added compliance across and along a pair of sides, for cells (size,) from the centre.

        They are across (terms, 2, size), lower side first, and along (terms, size, size) in [mm/N]: a force at (x', y')
        adds across(x) across(x') along(y, y') to the displacement at (x, y), for each side and term.
        """
        scale, thickness_mm = self.amplitude / (layer.shear_modulus_mpa * layer.thickness_mm), layer.thickness_mm
        apart_mm = cells_mm[:, None] - cells_mm
        across = [_fall(cells_mm, reach * thickness_mm) for _, reach, _ in _GIVES]
        along = [scale * factor * _bell(apart_mm, spread * thickness_mm) for factor, _, spread in _GIVES]
        return np.stack(across), np.stack(along)

    def movement(
        self, layer: Layer, cells_mm: NDArray[np.floating], magnets_mm: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """Return the MOVEMENT of the magnets that the sides add, (taxels, 5, size, size) in [mm/N] and [1/N].

        Loaded cells are at places (size,) from the centre along x as along y, magnets at x and y (taxels, 2).
        """
        scale, thickness_mm = self.amplitude / (layer.shear_modulus_mpa * layer.thickness_mm), layer.thickness_mm

        # Factor, decay lengths to magnet and load, width along the side; unit; signs at lower and upper side.
        parts = (
            ((0.1703, 1.117, 0.592, 0.593), scale, (-1.0, 1.0)),  # their way to the side
            ((0.0404, 0.690, 1.147, 0.420), scale, (1.0, 1.0)),  # down
            ((1.000, 0.431, 0.317, 0.463), scale / thickness_mm, (-1.0, 1.0)),  # their axes, tops towards the side
        )

        def by_sides(at_mm: NDArray[np.floating], beside_mm: NDArray[np.floating]) -> list[NDArray[np.float64]]:
            """Return the parts of the two sides at the ends of one axis; magnets are at `at_mm` along it."""
            added = []
            for (factor, *lengths), unit, signs in parts:
                inward_mm, reach_mm, spread_mm = (thicknesses * thickness_mm for thicknesses in lengths)
                falls = _fall(at_mm, inward_mm), _fall(cells_mm, reach_mm)
                bell = _bell(beside_mm[:, None] - cells_mm, spread_mm)
                added.append(unit * factor * np.einsum("s,st,sc,tr->trc", signs, *falls, bell))
            return added

        x_mm, y_mm = magnets_mm.T
        right, down_by_x, lean_x = by_sides(x_mm, y_mm)
        back, down_by_y, lean_y = (part.swapaxes(1, 2) for part in by_sides(y_mm, x_mm))
        return np.stack([right, back, down_by_x + down_by_y, lean_x, lean_y], axis=1)


class SideGive:
    """Compliance of the surface on boxes of a grid: a few small matrix products in a step of the contact solver.

    The profiles of `FreeSides` are (n, terms, 2, width) and (n, terms, 2, height) across at the boxes' columns and
    rows, (terms, height, height) and (terms, width, width) along, in [mm/MPa].
    """

    def __init__(self, across: tuple[torch.Tensor, torch.Tensor], along: tuple[torch.Tensor, torch.Tensor]) -> None:
        self._across = across
        self._along = along

    @classmethod
    def of(
        cls, sides: FreeSides, layer: Layer, size: int, cell_mm: float, dtype: torch.dtype = torch.float32
    ) -> "SideGive":
        """Return the compliance of the whole grid."""
        across, along = sides.profiles(layer, (np.arange(size) - (size - 1) / 2) * cell_mm)
        falls, bells = torch.as_tensor(across[None], dtype=dtype), torch.as_tensor(along * cell_mm**2, dtype=dtype)
        return cls((falls, falls), (bells, bells))

    def boxes(self, rows: NDArray[np.integer], columns: NDArray[np.integer]) -> "SideGive":
        """Return the part for boxes of one shape with these rows (n, height, 1) and columns (n, 1, width)."""
        across = (
            fall[0][:, :, torch.as_tensor(cells)].permute(2, 0, 1, 3)
            for fall, cells in zip(self._across, (columns[:, 0], rows[:, :, 0]), strict=True)
        )
        counts = (rows.shape[1], columns.shape[2])
        along = (bell[:, :count, :count] for bell, count in zip(self._along, counts, strict=True))
        return SideGive((next(across), next(across)), (next(along), next(along)))

    def __getitem__(self, which: torch.Tensor) -> "SideGive":
        """Return the part for some of the boxes."""
        return SideGive((self._across[0][which], self._across[1][which]), self._along)

    def displacement_mm(self, pressure_mpa: torch.Tensor) -> torch.Tensor:
        """Return the displacement that the sides add under pressures (n, height, width)."""
        by_x = self._pair(pressure_mpa, self._across[0], self._along[0])
        return by_x + self._pair(pressure_mpa.mT, self._across[1], self._along[1]).mT

    @staticmethod
    def _pair(pressure: torch.Tensor, across: torch.Tensor, along: torch.Tensor) -> torch.Tensor:
        """Return the displacement from the two sides at the ends of the last axis."""
        terms, sides = across.shape[1:3]
        fall = across.expand(len(pressure), -1, -1, -1).flatten(1, 2)  # (n, terms sides, width)
        seen = (fall @ pressure.mT).unflatten(1, (terms, sides))  # (n, terms, sides, height)
        return (seen @ along).flatten(1, 2).mT @ fall


def _fall(places_mm: NDArray[np.floating], length_mm: float) -> NDArray[np.float64]:
    """Return exponentials (2, ...) that decay from either side inwards."""
    return np.exp(-(_WIDTH_MM / 2 + np.stack([places_mm, -places_mm])) / length_mm)


def _bell(apart_mm: NDArray[np.floating], spread_mm: float) -> NDArray[np.float64]:
    return np.exp(-(apart_mm**2) / (2 * spread_mm**2))
