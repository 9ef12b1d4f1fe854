"""Contact area and indentation of the pad on a finer grid than the cells on which pressure is solved."""

from collections.abc import Callable, Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from train.physics.contact import BARE, REACH, ContactSolver, Cover

_WALL_MM: Final = 0.1
"""Depth below a cell's highest part from which a part of it carries no load, in [mm]."""
_STEEP: Final = 2.0
"""Depth in indentations from which a shape counts as steep: its edge then follows from the pressure alone."""


def carrying(depth_mm: NDArray[np.floating], cells: int) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return the depth of each cell's carrying part, and its share of the cell, both (n, cells, cells).

    Args:
        depth_mm: (n, m, m) with m a multiple of `cells`, below the highest part, in [mm].
        cells: along a side.
    """
    samples = depth_mm.shape[1] // cells
    parts = depth_mm.reshape(len(depth_mm), cells, samples, cells, samples)
    carries = parts < parts.min(axis=(2, 4), keepdims=True) + _WALL_MM
    count = carries.sum(axis=(2, 4))
    return np.where(carries, parts, 0).sum(axis=(2, 4)) / count, (count / samples**2).astype(np.float32)


def which_of(covers: Sequence[Cover]) -> Iterable[tuple[Cover, NDArray[np.int64]]]:
    """Yield each cover once, with the numbers of the presses that have it."""
    for cover in dict.fromkeys(covers):
        yield cover, np.array([number for number, one in enumerate(covers) if one == cover])


def pressed_in(
    solver_of: Callable[[Cover], ContactSolver],
    covers: Sequence[Cover],
    depth_mm: NDArray[np.float32],
    cells_mm: NDArray[np.float32],
    pressure_mpa: NDArray[np.float32],
    on_pad_mpa: NDArray[np.float32],
    indentation_mm: NDArray[np.float32],
    pattern_cells: int,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the depth of the pad below the highest part and the contact area, on pixels of half a cell.

    A cell's own deflection under its pressure, less its gap, is positive inside a contact and negative outside; the
    contact's edge is where it passes through zero between the cells' centres. In contact with a rigid shape the pad
    follows the shape; under a soft one its place follows from its own layer's deflection.

    Args:
        solver_of: solver of a cover.
        covers: (n,).
        depth_mm: (n, m, m), depth of the shape below its highest part, in [mm].
        cells_mm: (n, size, size), of each cell's carrying part, in [mm].
        pressure_mpa: (n, size, size), on the shape, in [MPa].
        on_pad_mpa: (n, size, size), on the pad, in [MPa].
        indentation_mm: (n,), in [mm].
        pattern_cells: cells along the pattern's side, in the middle of the pad.
    """
    size = cells_mm.shape[1]
    rim, pixels = size - pattern_cells, 2 * pattern_cells
    middle = (slice(None), slice(rim, rim + pixels), slice(rim, rim + pixels))
    fine_mm, fine_share = carrying(depth_mm, 2 * size)
    fine_mm, fine_share = fine_mm[middle], fine_share[middle]
    indented_mm = indentation_mm[:, None, None]
    close_mm = np.empty_like(pressure_mpa)
    for cover, which in which_of(covers):
        solver = solver_of(cover)
        gap_mm = solver.displacement_mm(pressure_mpa[which]) - (indented_mm[which] - cells_mm[which])
        close_mm[which] = pressure_mpa[which] * np.float32(solver.cell_compliance_mm_per_mpa) - gap_mm
    close_mm = np.where(cells_mm > _STEEP * indented_mm, np.minimum(pressure_mpa, 0), close_mm)
    to_pixels = _between(size, pixels)
    touching = (to_pixels @ close_mm @ to_pixels.T > 0) & (fine_mm < REACH * indented_mm)
    # The press always reaches the highest part, whichever cells that lies between.
    bottom = fine_mm <= fine_mm.min(axis=(1, 2), keepdims=True) + 1e-4
    touching = (touching | bottom) & _mostly(fine_share)
    touching |= bottom & ~touching.any(axis=(1, 2), keepdims=True)  # a tip thinner than half a pixel
    covered = np.array([cover != BARE for cover in covers])
    if covered.any():
        sunk_mm = to_pixels @ solver_of(BARE).displacement_mm(on_pad_mpa[covered]) @ to_pixels.T
        fine_mm[covered] = np.clip(indented_mm[covered] - sunk_mm, 0, indented_mm[covered])
    return fine_mm, touching


def _mostly(share: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the pixels whose carrying part is more than half, and every other one of those with exactly half.

    The mean place of an edge is then correct; with all of these it would lie a quarter of a pixel further out.
    """
    rows, cols = np.indices(share.shape[1:])
    return np.where((rows + cols) % 2, share > 0.5, share >= 0.5)


def _between(size: int, pixels: int) -> NDArray[np.float32]:
    """Return weights (pixels, size) of linear interpolation from cells to pixels of half a cell, both centred."""
    place = ((np.arange(pixels) - (pixels - 1) / 2) / 2 + (size - 1) / 2)[:, None]
    return np.maximum(1 - np.abs(place - np.arange(size)), 0).astype(np.float32)
