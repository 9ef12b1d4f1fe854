"""Whole pad with its free sides by linear finite elements, the data to which the correction is fitted.

A quarter of the pad is solved four times: even and odd about either middle plane. The rigid face is larger than the
pad. The extra of train.physics.fem_reference is required.
"""

from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu

from firmware_bridge.pad_geometry import USPA44
from train.physics.elastic_layer import Layer
from train.physics.fem_reference import rest_tangent
from train.physics.magnets import MOVEMENT, Magnet

CELL_MM: Final = USPA44.pixel_pitch_mm(10)
"""Size of the elements over the pad's face, and of the contact's cells, in [mm]."""
PATCH: Final = 3
"""Cells along a side of a patch that is loaded evenly."""
PATCHES: Final = 14
_QUARTER: Final = PATCHES // 2
_RATIO: Final = 2.5
"""Ratio of the tallest element's height to the lowest's, which lie at the face and at the board."""


@dataclass(frozen=True, slots=True)
class FlatPress:
    """A flat face pressed in by 1 mm, by linear theory.

    Attributes:
        stiffness_n_per_mm: of the whole pad.
        pressure: (nodes, nodes) over a quarter of the face, as a share of the mean; row = y, column = x.
        nodes_mm: (nodes,), from the centre.
        movement: (4, 5), MOVEMENT of the four magnets of the quarter, x changing fastest.
    """

    stiffness_n_per_mm: float
    pressure: NDArray[np.float64]
    nodes_mm: NDArray[np.float64]
    movement: NDArray[np.float64]


class WholePad:
    """Square pad that is bonded to its board, under a frictionless or bonded face.

    Args:
        layer: thickness and material.
        cells_high: elements between the board and the magnets, and as many above; fineness over the thickness.
        every: cells per element along x and y, 1 or 5; 5 is for tests alone.
    """

    def __init__(self, layer: Layer, cells_high: int = 5, every: int = 1) -> None:
        magnet = Magnet()
        aspect = magnet.thickness_mm / magnet.diameter_mm
        self._shape = (aspect**2 - 1) / (aspect**2 + 1)
        half_mm = USPA44.width_mm / 2
        cells = round(half_mm / CELL_MM - 0.5)
        self.nodes_mm = np.append(np.arange(0, cells, every) * CELL_MM, half_mm)
        below = magnet.height_mm * _steps(cells_high)
        above = layer.thickness_mm - (layer.thickness_mm - magnet.height_mm) * _steps(cells_high)[::-1]
        self._z_mm = np.concatenate([below, above[1:]])
        self._level = cells_high
        self._tangent = rest_tangent(self.nodes_mm, self.nodes_mm, self._z_mm, layer).tocsc()
        self._grid = (len(self._z_mm), len(self.nodes_mm), len(self.nodes_mm), 3)

    def flat(self, bonded: bool = False) -> FlatPress:
        """Press a flat face in by 1 mm, free to slip or bonded."""
        held = self._held(even_x=True, even_y=True)
        held[-1, :, :, 2] = True
        if bonded:
            held[-1] = True
        moved = np.zeros(self._grid)
        moved[-1, :, :, 2] = -1.0
        free = ~held.ravel()
        moved.ravel()[free] = self._factors(free).solve(-(self._tangent @ moved.ravel())[free])
        push_n = -(self._tangent @ moved.ravel()).reshape(self._grid)[-1, :, :, 2]
        shares_mm = np.gradient(self.nodes_mm)
        shares_mm[[0, -1]] /= 2
        stiffness = 4 * float(push_n.sum())
        pressure = push_n / np.outer(shares_mm, shares_mm) / (stiffness / USPA44.width_mm**2)
        return FlatPress(stiffness, pressure, self.nodes_mm, self._movement(moved[..., None])[..., 0])

    def patches(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Load the face patch by patch, free elsewhere.

        Returns:
            Mean displacement of each patch under an even pressure on each, (196, 196) in [mm/MPa]; and MOVEMENT of the
            16 magnets, (16, 5, 196) in [mm/MPa] and [1/MPa].
        """
        loads_n = self._loads()
        mean = loads_n / (PATCH * CELL_MM) ** 2
        surface = np.zeros((PATCHES,) * 4)
        magnets = np.zeros((4, 4, len(MOVEMENT), PATCHES, PATCHES))
        signs = (1, -1)
        for even_x, even_y in product(signs, signs):
            free = ~self._held(even_x > 0, even_y > 0).ravel()
            forces = np.zeros((*self._grid, len(loads_n)))
            forces[-1, :, :, 2] = -np.moveaxis(loads_n, 0, -1)
            moved = np.zeros((free.size, len(loads_n)))
            moved[free] = self._factors(free).solve(np.ascontiguousarray(forces.reshape(moved.shape)[free]))
            moved = moved.reshape(forces.shape)
            face = np.tensordot(mean, -moved[-1, :, :, 2], 2).reshape((_QUARTER,) * 4)
            inside = self._movement(moved).reshape(2, 2, len(MOVEMENT), _QUARTER, _QUARTER)
            for at_x, at_y, load_x, load_y in product(signs, repeat=4):
                weight = (at_x * load_x if even_x < 0 else 1) * (at_y * load_y if even_y < 0 else 1) / 4
                rows, columns, below, beside = (_half(sign, _QUARTER) for sign in (at_y, at_x, load_y, load_x))
                surface[np.ix_(rows, columns, below, beside)] += weight * face
                flip = np.array([at_x, at_y, 1, at_x, at_y])[:, None, None]
                place = np.ix_(_half(at_y, 2), _half(at_x, 2), range(len(MOVEMENT)), below, beside)
                magnets[place] += weight * flip * inside
        return surface.reshape(PATCHES**2, -1), magnets.reshape(16, len(MOVEMENT), -1)

    def _held(self, even_x: bool, even_y: bool) -> NDArray[np.bool_]:
        """Return a mask of the nodes' directions that do not move: on the board, and in the middle planes."""
        held = np.zeros(self._grid, dtype=bool)
        held[0] = True
        held[:, :, 0] |= np.array([even_x, not even_x, not even_x])
        held[:, 0] |= np.array([not even_y, even_y, not even_y])
        return held

    def _factors(self, free: NDArray[np.bool_]) -> SuperLU:
        system = self._tangent[free][:, free].tocsc()
        return splu(system, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def _loads(self) -> NDArray[np.float64]:
        """Return forces of 1 MPa on each patch of the quarter on the nodes of the face, (49, nodes, nodes)."""
        loads_n = np.zeros((_QUARTER**2, len(self.nodes_mm), len(self.nodes_mm)))
        for patch, (row, column) in enumerate(product(range(_QUARTER), repeat=2)):
            for y, x in product(range(PATCH), repeat=2):
                top, left = PATCH * row + y, PATCH * column + x
                loads_n[patch, top : top + 2, left : left + 2] += CELL_MM**2 / 4
        return loads_n

    def _movement(self, moved: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return MOVEMENT (4, 5, k) of the quarter's magnets, which lean as in train.physics.taxel_response."""
        plane = moved[self._level]
        down = -plane[:, :, 2]
        slope_x, slope_y = (np.gradient(down, self.nodes_mm, axis=axis) for axis in (1, 0))
        rise = np.gradient(moved[self._level - 1 : self._level + 2], self._heights(), axis=0)[1]
        tilt, follow = (1 + self._shape) / 2, (1 - self._shape) / 2
        lean_x, lean_y = tilt * rise[:, :, 0] + follow * slope_x, tilt * rise[:, :, 1] + follow * slope_y
        fields = np.stack([plane[:, :, 0], plane[:, :, 1], down, lean_x, lean_y], axis=2)
        at = [int(np.abs(self.nodes_mm - place * USPA44.pitch_mm).argmin()) for place in (0.5, 1.5)]
        return fields[np.ix_(at, at)].reshape(4, len(MOVEMENT), -1)

    def _heights(self) -> NDArray[np.float64]:
        return self._z_mm[self._level - 1 : self._level + 2]


def _steps(count: int) -> NDArray[np.float64]:
    """Return numbers from 0 to 1, in steps that grow by _RATIO."""
    steps = np.geomspace(1, _RATIO, count)
    return np.append(0.0, np.cumsum(steps) / steps.sum())


def _half(sign: int, count: int) -> range:
    """Return the places of a half, from the middle outwards, among twice as many."""
    return range(count, 2 * count) if sign > 0 else range(count - 1, -1, -1)
