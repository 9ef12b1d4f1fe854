"""Surfaces to tap, by name: the paper's 18, random figures, domes and cylinders, and users' meshes.

A surface is a flat or round figure raised from a square base plate. Lengths in [mm]; the figure's top is the
plane z = 0, the plate's top lies FIGURE_HEIGHT_MM below it.

Source: Wu and Liu 2024, Fig. 1c (two plates of nine surfaces), Sec. VII (spheres and cylinders as future work).
"""

from collections.abc import Callable
from functools import lru_cache
from math import acos, asin, sin
from typing import Final, cast

import numpy as np
import shapely
import trimesh
from shapely.geometry.base import BaseGeometry

from train.errors import SurfaceError
from train.surfaces.meshes import load_mesh, mesh_file
from train.surfaces.paper_figures import LETTERS, SHAPES, figure
from train.surfaces.random_figures import glyph, polygon

PLATE_MM: Final = 20.0
FIGURE_HEIGHT_MM: Final = 2.0
REACH_MM: Final = 0.5
"""Depth below the top beyond which no press reaches, in [mm]."""
_PLATE_THICKNESS_MM: Final = 1.0

PLATES: Final = (LETTERS, SHAPES)
"""Names of the surfaces on the paper's two contact plates, nine each."""
SURFACES: Final = LETTERS + SHAPES
"""Names of the 18 surfaces."""

_FLAT_TOLERANCE: Final = 1e-3
"""Tolerance in [mm] off the plane, and in slope off the vertical: negligible against a press of 0.5 mm."""
_RADII_MM: Final = (1.0, 1000.0)
"""Radii of domes and cylinders. Smaller caps span under four cells of the contact grid; larger ones are planes."""
_ROUND_MM: Final = 1.5
"""Height of a dome's or cylinder's round part: three times a press's reach, because the pad heaps up around it."""
_FACETS: Final = 32
"""Facets from the top to the edge of the round part. Sagitta R (step angle)^2 / 8, at most .5 um for every radius."""
_SECTORS: Final = 128
"""Sectors of a dome. At depth d the chord lies d (pi / sectors)^2 below the sphere: .3 um at a press's reach."""

_RANDOM: Final[dict[str, Callable[[int], BaseGeometry]]] = {"glyph": glyph, "polygon": polygon}


def surface_mesh(name: str) -> trimesh.Trimesh:
    """Return the mesh of one surface, figure and base plate as closed bodies side by side, centred on x = y = 0.

    Args:
        name: one of SURFACES; `glyph:SEED` or `polygon:SEED`, random figures; `sphere:RADIUS_MM`, a dome;
            `cylinder:RADIUS_MM`, lying, its axis along y; a user's file as `mesh_name` names it, without a plate.

    Raises:
        SurfaceError: no surface of that name.
        MeshError: the user's file cannot be used.
    """
    kind, _, detail = name.partition(":")
    if name in SURFACES:
        return _on_plate(_raised(figure(name)))
    if kind in _RANDOM and detail.isascii() and detail.isdigit():
        return _on_plate(_raised(_RANDOM[kind](int(detail))))
    if kind == "sphere":
        return _on_plate([_dome(_radius_mm(name, detail))])
    if kind == "cylinder":
        return _on_plate([_lying_cylinder(_radius_mm(name, detail))])
    if kind == "mesh" and detail:
        return load_mesh(*mesh_file(name))
    raise SurfaceError(
        f"no surface {name!r}; there are {', '.join(SURFACES)}, and glyph:SEED, polygon:SEED (SEED 0 or more), "
        "sphere:RADIUS_MM, cylinder:RADIUS_MM, mesh:PATH"
    )


def is_random_figure(name: str) -> bool:
    """Return True if a surface's name is that of a figure drawn from a seed."""
    return name.partition(":")[0] in _RANDOM


def is_flat(mesh: trimesh.Trimesh) -> bool:
    """Return True if all that a press can reach lies in the plane of the mesh's top; walls may be vertical.

    A flat surface's contact is linear in the indentation and solved once, a curved one's at every depth.
    """
    corners = np.asarray(mesh.triangles, dtype=np.float64)
    below_mm = corners[:, :, 2].max() - corners[:, :, 2]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    on_top = below_mm.max(axis=1) < _FLAT_TOLERANCE
    upright = np.abs(normals[:, 2]) <= _FLAT_TOLERANCE * np.linalg.norm(normals, axis=1)
    return bool((on_top | upright | (below_mm.min(axis=1) > REACH_MM)).all())


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


def _radius_mm(name: str, detail: str) -> float:
    try:
        radius_mm = float(detail)
    except ValueError:
        radius_mm = float("nan")
    if not _RADII_MM[0] <= radius_mm <= _RADII_MM[1]:
        raise SurfaceError(f"surface {name!r} needs a radius of {_RADII_MM[0]:g} to {_RADII_MM[1]:g} mm")
    return radius_mm


def _round_profile(radius_mm: float) -> list[tuple[float, float]]:
    """Return (distance from the axis, z) from the top down to the edge of the round part, in [mm]."""
    steepest = acos(max(1 - _ROUND_MM / radius_mm, 0.0))
    widest = asin(min(PLATE_MM / radius_mm, 1.0))  # a blunt body ends where no pad on the plate reaches
    angles = [min(steepest, widest) * i / _FACETS for i in range(_FACETS + 1)]
    return [(radius_mm * sin(a), -2 * radius_mm * sin(a / 2) ** 2) for a in angles]


def _dome(radius_mm: float) -> trimesh.Trimesh:
    profile = _round_profile(radius_mm)
    edge_mm = profile[-1][0]
    outline = [*profile, (edge_mm, -FIGURE_HEIGHT_MM), (0.0, -FIGURE_HEIGHT_MM)]
    return trimesh.creation.revolve(np.array(outline[::-1]), sections=_SECTORS)


def _lying_cylinder(radius_mm: float) -> trimesh.Trimesh:
    right = _round_profile(radius_mm)
    edge_mm = right[-1][0]
    left = [(-x, z) for x, z in right[:0:-1]]
    outline = [*left, *right, (edge_mm, -FIGURE_HEIGHT_MM), (-edge_mm, -FIGURE_HEIGHT_MM)]
    length_mm = 2 * PLATE_MM
    upright = np.array([[1, 0, 0, 0], [0, 0, -1, length_mm / 2], [0, 1, 0, 0], [0, 0, 0, 1]])
    return trimesh.creation.extrude_polygon(shapely.Polygon(outline), length_mm, transform=upright)
