"""Surfaces to tap, by name: the paper's 18, random figures, and users' meshes.

A surface is a flat figure raised from a square base plate; its top is the plane z = 0. The paper does not state the
sizes of its nine letters, and three shapes in three forms: those here are our choice. A seed defines one random figure:
coordinates are rounded to whole micrometres, which removes the last digits in which machines differ.

Source: Wu and Liu 2024, Fig. 1c (two plates of nine surfaces).
"""

from functools import lru_cache
from math import cos, pi, radians, sin
from typing import Final, Literal, cast

import numpy as np
import shapely
import trimesh
from shapely import LinearRing, LineString, Polygon, affinity, set_precision, unary_union
from shapely.geometry.base import BaseGeometry

from train.errors import SurfaceError
from train.surfaces.depth_image import Relief
from train.surfaces.meshes import MESH, load_mesh, mesh_file

PLATE_MM: Final = 20.0
FIGURE_HEIGHT_MM: Final = 2.0
_PLATE_THICKNESS_MM: Final = 1.0
_W, _H = 4.0, 6.0  # half the width and height of a letter, between stroke centres
GLYPH_REACH_MM: Final = 8.0  # largest distance of a glyph's points from the plate's centre along x and y
POLYGON_REACH_MM: Final = 9.5
AREA_MM2: Final = (8.0, 250.0)  # smallest and largest contact area of a random figure
_CAPS: Final[tuple[Literal["round", "square", "flat"], ...]] = ("round", "square", "flat")
_JOINS: Final[tuple[Literal["round", "mitre", "bevel"], ...]] = ("round", "mitre", "bevel")

Points = list[tuple[float, float]]


def arc(centre: tuple[float, float], radii: tuple[float, float], start_deg: float, stop_deg: float) -> Points:
    """Return points along an ellipse's arc, both ends included; counterclockwise when `stop_deg` is the larger."""
    steps = 24
    angles = [radians(start_deg + (stop_deg - start_deg) * i / steps) for i in range(steps + 1)]
    return [(centre[0] + radii[0] * cos(a), centre[1] + radii[1] * sin(a)) for a in angles]


_STROKES: Final[dict[str, list[Points]]] = {
    "C": [arc((0, 0), (_W, _H), 45, 315)],
    "F": [[(_W, _H), (-_W, _H), (-_W, -_H)], [(-_W, 0.5), (0.6 * _W, 0.5)]],
    "I": [[(0, _H), (0, -_H)], [(-0.6 * _W, _H), (0.6 * _W, _H)], [(-0.6 * _W, -_H), (0.6 * _W, -_H)]],
    "L": [[(-_W, _H), (-_W, -_H), (_W, -_H)]],
    "O": [arc((0, 0), (_W, _H), 0, 360)],
    "P": [[(-_W, -_H), (-_W, _H), *arc((0, _H / 2), (_W, _H / 2), 90, -90), (-_W, 0)]],
    "S": [arc((0, _H / 2), (_W, _H / 2), 30, 270) + arc((0, -_H / 2), (_W, _H / 2), 90, -150)],
    "T": [[(-_W, _H), (_W, _H)], [(0, _H), (0, -_H)]],
    "U": [[(-_W, _H), *arc((0, -_H / 2), (_W, _H / 2), 180, 360), (_W, _H)]],
}
_CORNERS: Final = {"circle": 96, "square": 4, "triangle": 3}

LETTERS: Final = tuple(_STROKES)  # names of the nine surfaces on the first of the paper's contact plates
SHAPES: Final = tuple(f"{form} {shape}" for shape in _CORNERS for form in ("hollow", "large", "small"))
SURFACES: Final = LETTERS + SHAPES  # names of the 18 surfaces, nine on each plate


def surface_mesh(name: str) -> trimesh.Trimesh:
    """Return the mesh of a `figure` on its plate, closed bodies side by side, or a user's, centred on x = y = 0."""
    if name.startswith(MESH) and name != MESH:
        return load_mesh(*mesh_file(name))
    down = trimesh.transformations.translation_matrix([0, 0, -FIGURE_HEIGHT_MM])
    islands = shapely.get_parts(figure(name))
    raised = [trimesh.creation.extrude_polygon(island, FIGURE_HEIGHT_MM, transform=down) for island in islands]
    plate = trimesh.creation.box([PLATE_MM, PLATE_MM, _PLATE_THICKNESS_MM])
    plate.apply_translation([0, 0, -FIGURE_HEIGHT_MM - _PLATE_THICKNESS_MM / 2])
    return cast(trimesh.Trimesh, trimesh.util.concatenate([*raised, plate]))


@lru_cache(maxsize=64)
def relief(name: str) -> Relief:
    """Return a surface of `surface_mesh` to be drawn from above."""
    return Relief(name, surface_mesh(name))


def figure(name: str) -> BaseGeometry:
    """Return the outline in [mm] of one of SURFACES, of glyph:SEED or polygon:SEED; SurfaceError if there is none."""
    kind, _, seed = name.partition(":")
    if name in SURFACES:
        return _letter(name) if name in _STROKES else _shape(*name.split())
    if kind not in ("glyph", "polygon") or not (seed.isascii() and seed.isdigit()):
        raise SurfaceError(
            f"no surface {name!r}; there are {', '.join(SURFACES)}, and glyph:SEED, polygon:SEED (SEED 0 or more), "
            "mesh:PATH"
        )
    draw, reach_mm = (_glyph, GLYPH_REACH_MM) if kind == "glyph" else (_polygon, POLYGON_REACH_MM)
    rng = np.random.default_rng([int(seed), int(kind == "polygon")])
    outline = None
    while outline is None:  # one draw in four is too wide, too small or too large
        outline = _placed(rng, draw(rng), reach_mm)
    return outline


def _letter(name: str) -> BaseGeometry:
    strokes = [LineString(points).buffer(3.0 / 2, cap_style="square") for points in _STROKES[name]]
    return unary_union(strokes).simplify(0.01)  # where strokes meet, points 1e-15 mm apart would open the mesh


def _shape(form: str, shape: str) -> BaseGeometry:
    if form == "small":
        return _regular(_CORNERS[shape], 3.5)
    large = _regular(_CORNERS[shape], 7.0)
    return large if form == "large" else large.difference(large.buffer(-2.5, join_style="mitre"))


def _regular(corners: int, radius_mm: float) -> Polygon:
    """Return a regular polygon standing on a side, its corners at `radius_mm`."""
    first = -pi / 2 + pi / corners
    angles = [first + 2 * pi * i / corners for i in range(corners)]
    return Polygon([(radius_mm * cos(a), radius_mm * sin(a)) for a in angles])


def _glyph(rng: np.random.Generator) -> BaseGeometry:
    """Draw one to four random strokes of one width, like a letter of an unknown script."""
    half = (rng.uniform(3, 6), rng.uniform(3.5, 6.5))
    width_mm, cap, join = 2 + 2 * rng.random() ** 2, _CAPS[rng.integers(3)], _JOINS[rng.integers(3)]
    lattice = int(rng.integers(0, 4))  # 0: corners anywhere; 1, 2, 3: letter-like, on 2, 3 or 4 lines each way
    count = int(rng.integers(1, 5))
    places = np.zeros((count, 2))
    if count > 1 and rng.random() < 0.4:  # apart: each stroke half the size, in a quarter of its own
        places = rng.permutation([(-0.6, -0.6), (-0.6, 0.6), (0.6, -0.6), (0.6, 0.6)])[:count]
        half = (0.6 * half[0], 0.6 * half[1])
    strokes = []
    for right, up in places:
        stroke = _stroke(rng, half, lattice).buffer(width_mm / 2, cap_style=cap, join_style=join, quad_segs=6)
        strokes.append(affinity.translate(stroke, right * 2 * half[0], up * 2 * half[1]))
    drawn = unary_union(strokes)
    return affinity.rotate(drawn, rng.uniform(0, 360), origin=(0, 0)) if rng.random() < 0.5 else drawn


def _stroke(rng: np.random.Generator, half: tuple[float, float], lattice: int) -> LineString:
    """Draw a polyline, an arc or a closed loop with its corners within +-`half`."""
    kind = rng.random()
    if kind < 0.55:
        return LineString(_corners(rng, half, lattice, int(rng.integers(2, 5))))
    if kind < 0.65:
        return LinearRing(_corners(rng, half, lattice, int(rng.integers(3, 6))))
    radii = (half[0] * rng.uniform(0.6, 1), half[1] * rng.uniform(0.6, 1))
    centre = (rng.uniform(-1, 1) * (half[0] - radii[0]), rng.uniform(-1, 1) * (half[1] - radii[1]))
    if kind < 0.75:
        return LinearRing(arc(centre, radii, 0, 360))
    start_deg = rng.uniform(0, 360)
    return LineString(arc(centre, radii, start_deg, start_deg + rng.uniform(90, 300)))


def _corners(rng: np.random.Generator, half: tuple[float, float], lattice: int, count: int) -> Points:
    """Draw random corners; on the lattice, no two in a row are the same."""
    shares = rng.uniform(-1, 1, (count, 2))
    if lattice:
        places = [int(rng.integers((lattice + 1) ** 2))]
        while len(places) < count:
            step = int(rng.integers(1, (lattice + 1) ** 2))
            places.append((places[-1] + step) % (lattice + 1) ** 2)
        shares = np.array([divmod(place, lattice + 1) for place in places]) / lattice * 2 - 1
    return [(half[0] * x, half[1] * y) for x, y in shares]


def _polygon(rng: np.random.Generator) -> BaseGeometry:
    """Draw one or two random polygons or ellipses, full or hollow."""
    first = _blob(rng, 8.0)
    if rng.random() >= 0.3:
        return first
    way, far_mm = rng.uniform(0, 2 * pi), rng.uniform(4, 10)
    second = affinity.translate(_blob(rng, 5.0), far_mm * cos(way), far_mm * sin(way))
    return first.union(second) if rng.random() < 0.7 else first.difference(second)


def _blob(rng: np.random.Generator, largest_mm: float) -> BaseGeometry:
    """Draw a polygon of 3 to 8 corners or an ellipse round the origin, regular or not, full or hollow."""
    radius_mm, squeeze, turn_deg = rng.uniform(2.5, largest_mm), rng.uniform(0.4, 1), rng.uniform(0, 360)
    count = int(rng.integers(3, 10))
    if count == 9:
        outline = Polygon(arc((0, 0), (radius_mm, radius_mm * squeeze), 0, 360))
    else:
        shift, dent = np.zeros(count), np.ones(count)
        if rng.random() < 0.6:
            shift, dent = rng.uniform(-0.4, 0.4, count), rng.uniform(0.45, 1, count)
        angles = (np.arange(count) + shift) * 2 * pi / count
        corners = [(radius_mm * d * cos(a), radius_mm * d * sin(a)) for a, d in zip(angles, dent, strict=True)]
        outline = Polygon(corners)
        if rng.random() < 0.3:
            outline = affinity.scale(outline, 1, squeeze, origin=(0, 0))
    if rng.random() < 0.4:
        outline = outline.difference(outline.buffer(-rng.uniform(1.5, 3.5), join_style="mitre"))
    return affinity.rotate(outline, turn_deg, origin=(0, 0))


def _placed(rng: np.random.Generator, drawn: BaseGeometry, reach_mm: float) -> BaseGeometry | None:
    """Return the drawing without its finest detail, moved to a random place; None if too large, small or invalid."""
    fine = 0.25
    shut = drawn.buffer(fine, join_style="mitre").buffer(-2 * fine, join_style="mitre")
    cleaned = shut.buffer(fine, join_style="mitre").simplify(0.02)
    if not (cleaned.is_valid and AREA_MM2[0] <= cleaned.area <= AREA_MM2[1]):  # simplified outlines may cross
        return None
    left, low, right, high = cleaned.bounds
    slack = (reach_mm - (right - left) / 2, reach_mm - (high - low) / 2)
    if min(slack) < 0:
        return None
    x_mm, y_mm = rng.uniform(-0.7, 0.7) * slack[0], rng.uniform(-0.7, 0.7) * slack[1]
    placed = affinity.translate(cleaned, x_mm - (left + right) / 2, y_mm - (low + high) / 2)
    return set_precision(placed, 1e-3)
