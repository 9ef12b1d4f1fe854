"""Surfaces to tap, by name: the paper's 18, random figures, and users' meshes.

A surface is a flat figure raised from a square base plate. Lengths in [mm]; the figure's top is the
plane z = 0, the plate's top lies FIGURE_HEIGHT_MM below it.

Source: Wu and Liu 2024, Fig. 1c (two plates of nine surfaces).
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Final, cast

import numpy as np
import shapely
import trimesh
from shapely.geometry.base import BaseGeometry

from train.errors import SurfaceError
from train.surfaces.meshes import load_mesh, mesh_file
from train.surfaces.random_figures import LETTERS, SHAPES, figure, glyph, polygon

PLATE_MM: Final = 20.0
FIGURE_HEIGHT_MM: Final = 2.0
_PLATE_THICKNESS_MM: Final = 1.0

PLATES: Final = (LETTERS, SHAPES)
"""Names of the surfaces on the paper's two contact plates, nine each."""
SURFACES: Final = LETTERS + SHAPES
"""Names of the 18 surfaces."""

_RANDOM: Final[dict[str, Callable[[int], BaseGeometry]]] = {"glyph": glyph, "polygon": polygon}


def surface_mesh(name: str) -> trimesh.Trimesh:
    """Return the mesh of one surface, figure and base plate as closed bodies side by side, centred on x = y = 0.

    Args:
        name: one of SURFACES; `glyph:SEED` or `polygon:SEED`, random figures; a user's file as `mesh_name` names it,
            without a plate.

    Raises:
        SurfaceError: no surface of that name.
    """
    kind, _, detail = name.partition(":")
    if name in SURFACES:
        return _on_plate(_raised(figure(name)))
    if kind in _RANDOM and detail.isascii() and detail.isdigit():
        return _on_plate(_raised(_RANDOM[kind](int(detail))))
    if kind == "mesh" and detail:
        return load_mesh(*mesh_file(name))
    raise SurfaceError(
        f"no surface {name!r}; there are {', '.join(SURFACES)}, and glyph:SEED, polygon:SEED (SEED 0 or more), "
        "mesh:PATH"
    )


def _raised(outline: BaseGeometry) -> list[trimesh.Trimesh]:
    """Extrude every island of an outline from the plate up to z = 0."""
    down = np.eye(4)
    down[2, 3] = -FIGURE_HEIGHT_MM
    islands = shapely.get_parts(outline)
    return [trimesh.creation.extrude_polygon(island, FIGURE_HEIGHT_MM, transform=down) for island in islands]


def _on_plate(bodies: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    plate = _plate(max(PLATE_MM, *(extent for body in bodies for extent in body.extents[:2])))
    return cast(trimesh.Trimesh, trimesh.util.concatenate([*bodies, plate]))


@lru_cache(maxsize=8)
def _plate(side_mm: float) -> trimesh.Trimesh:
    plate = trimesh.creation.box([side_mm, side_mm, _PLATE_THICKNESS_MM])
    plate.apply_translation([0, 0, -FIGURE_HEIGHT_MM - _PLATE_THICKNESS_MM / 2])
    return plate
