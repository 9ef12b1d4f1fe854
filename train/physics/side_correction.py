"""Free sides of a pad, absent from the infinite layer: near them the pad is softer and bulges outwards.

The effect of a load on a side falls with the load's distance d' from the side, and spreads along the side by a bell
curve. The added displacement falls with distance d alike, so that the addition is symmetric and never negative:

    u(d, y) += amplitude / (G h) sum_sides sum_k a_k exp(-(d + d') / (h b_k)) exp(-(y - y')^2 / (2 (h c_k)^2)) F(d', y')

The magnets' movement gains a term of the same kind, with its own lengths. All constants are fitted to finite elements
of a frictionless 20 mm pad at four Poisson ratios (docs/decisions.md), with the same values for all four.
Amplitude 0 is the infinite layer. Lengths in [mm], forces in [N].
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from train.physics.elastic_layer import Layer
from train.physics.magnets import MOVEMENT


class Give(NamedTuple):
    """One term of the surface's compliance: factor on 1 / (G h), and lengths in thicknesses."""

    factor: float
    reach: float
    spread: float


class Drift(NamedTuple):
    """Term of the magnets' movement in one direction: factor on 1 / (G h), and lengths in thicknesses.

    Attributes:
        factor: for a slope it is on 1 / (G h^2).
        inward: decay length from the side to the magnet.
        reach: decay length from the side to the load.
        spread: width along the side.
    """

    factor: float
    inward: float
    reach: float
    spread: float


GIVES: Final = (Give(0.959, 0.3415, 0.2247), Give(0.0255, 1.590, 0.6034))
DOWN: Final = Drift(0.0404, 0.690, 1.147, 0.420)
OUT: Final = Drift(0.1703, 1.117, 0.592, 0.593)
LEAN: Final = Drift(1.000, 0.431, 0.317, 0.463)


@dataclass(frozen=True, slots=True)
class FreeSides:
    """Four free sides of a square pad.

    Attributes:
        amplitude: 1 as in the finite elements, 0 for an infinite layer.
        width_mm: of the pad, from side to side.
        gives: terms of the surface.
        down: term of the magnets, towards the board.
        out: term of the magnets, towards the side.
        lean: term of the magnets' axes, their tops towards the side.
    """

    amplitude: float = 1.0
    width_mm: float = 20.0
    gives: tuple[Give, ...] = GIVES
    down: Drift = DOWN
    out: Drift = OUT
    lean: Drift = LEAN

    def __post_init__(self) -> None:
        if not self.amplitude >= 0:
            raise ValueError(f"amplitude is {self.amplitude}, expected 0 or more: below 0 a pad could push back")

    def profiles(self, layer: Layer, cells_mm: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return shares of the added compliance across and along a pair of sides.

        Args:
            layer: the pad.
            cells_mm: (size,), places of the cells from the centre.

        Returns:
            across (terms, 2, size), lower side first, and along (terms, size, size) in [mm/N]: a force at (x', y') adds
            across(x) across(x') along(y, y') to the displacement at (x, y), for each side and term.
        """
        scale = self.amplitude / (layer.shear_modulus_mpa * layer.thickness_mm)
        apart_mm = cells_mm[:, None] - cells_mm
        across = [self._fall(cells_mm, give.reach * layer.thickness_mm) for give in self.gives]
        along = [scale * give.factor * _bell(apart_mm, give.spread * layer.thickness_mm) for give in self.gives]
        return np.stack(across), np.stack(along)

    def movement(
        self, layer: Layer, cells_mm: NDArray[np.floating], magnets_mm: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """Return the MOVEMENT of the magnets that the sides add, (taxels, 5, size, size) in [mm/N] and [1/N].

        Args:
            layer: the pad.
            cells_mm: (size,), places of the loaded cells from the centre, along x as along y.
            magnets_mm: (taxels, 2), x and y.
        """
        scale = self.amplitude / (layer.shear_modulus_mpa * layer.thickness_mm)
        parts = {
            "down_mm": (self.down, scale),
            "mm": (self.out, scale),
            "lean": (self.lean, scale / layer.thickness_mm),
        }
        x_mm, y_mm = magnets_mm.T
        added = np.zeros((len(magnets_mm), len(MOVEMENT), len(cells_mm), len(cells_mm)))
        for name, (drift, unit) in parts.items():
            inward_mm, reach_mm, spread_mm = (thicknesses * layer.thickness_mm for thicknesses in drift[1:])
            near = self._fall(cells_mm, reach_mm)  # (2, size)
            sides = np.ones(2) if name == "down_mm" else np.array([-1.0, 1.0])
            by_x, by_y = (
                unit * drift.factor * np.einsum("s,st,sc,tr->trc", sides, self._fall(at_mm, inward_mm), near, bell)
                for at_mm, bell in (
                    (x_mm, _bell(y_mm[:, None] - cells_mm, spread_mm)),
                    (y_mm, _bell(x_mm[:, None] - cells_mm, spread_mm)),
                )
            )
            by_y = by_y.swapaxes(1, 2)
            if name == "down_mm":
                added[:, MOVEMENT.index("down_mm")] = by_x + by_y
            else:
                first, second = ("right_mm", "back_mm") if name == "mm" else ("lean_x", "lean_y")
                added[:, MOVEMENT.index(first)], added[:, MOVEMENT.index(second)] = by_x, by_y
        return added

    def _fall(self, places_mm: NDArray[np.floating], length_mm: float) -> NDArray[np.float64]:
        """Return exponentials (2, ...) that decay from either side inwards."""
        return np.exp(-(self.width_mm / 2 + np.stack([places_mm, -places_mm])) / length_mm)


class SideGive:
    """Compliance of the surface on boxes of a grid: a few small matrix products in a step of the contact solver.

    Args:
        across: (n, terms, 2, width) and (n, terms, 2, height), the profiles at the boxes' columns and rows.
        along: (terms, height, height) and (terms, width, width), in [mm/MPa].
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

    def boxes(self, top: NDArray[np.integer], left: NDArray[np.integer], shape: tuple[int, int]) -> "SideGive":
        """Return the part for boxes of one shape that begin at these rows and columns, (n,)."""
        columns, rows = (
            fall[0][:, :, torch.as_tensor(first[:, None] + np.arange(count))].permute(2, 0, 1, 3)
            for fall, first, count in zip(self._across, (left, top), shape[::-1], strict=True)
        )
        beside, below = (bell[:, :count, :count] for bell, count in zip(self._along, shape, strict=True))
        return SideGive((columns, rows), (beside, below))

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


def _bell(apart_mm: NDArray[np.floating], spread_mm: float) -> NDArray[np.float64]:
    return np.exp(-(apart_mm**2) / (2 * spread_mm**2))
