"""The 18 contact surfaces of the paper as meshes: nine letters, and three shapes in three forms.

A surface is a flat figure raised from a square base plate. Lengths in [mm]; the figure's top is the
plane z = 0, the plate's top lies FIGURE_HEIGHT_MM below it.

Source: Wu and Liu 2024, Fig. 1c; the figures' exact sizes are not given there and are ours.
"""

from collections.abc import Callable
from math import cos, pi, radians, sin
from typing import Final

import trimesh
from shapely import LineString, Polygon, unary_union
from shapely.geometry.base import BaseGeometry

PLATE_MM: Final = 20.0
FIGURE_HEIGHT_MM: Final = 2.0
_PLATE_THICKNESS_MM: Final = 1.0
_STROKE_MM: Final = 3.0
_WALL_MM: Final = 2.5
_LARGE_RADIUS_MM: Final = 7.0
_SMALL_RADIUS_MM: Final = 3.5
_W: Final = 4.0
"""Half the width of a letter's strokes, centre to centre."""
_H: Final = 6.0
"""Half their height."""

Points = list[tuple[float, float]]


def _arc(centre: tuple[float, float], radii: tuple[float, float], start_deg: float, stop_deg: float) -> Points:
    steps = 24
    angles = [radians(start_deg + (stop_deg - start_deg) * i / steps) for i in range(steps + 1)]
    return [(centre[0] + radii[0] * cos(a), centre[1] + radii[1] * sin(a)) for a in angles]


_LETTERS: Final[dict[str, list[Points]]] = {
    "C": [_arc((0, 0), (_W, _H), 45, 315)],
    "F": [[(_W, _H), (-_W, _H), (-_W, -_H)], [(-_W, 0.5), (0.6 * _W, 0.5)]],
    "I": [[(0, _H), (0, -_H)], [(-0.6 * _W, _H), (0.6 * _W, _H)], [(-0.6 * _W, -_H), (0.6 * _W, -_H)]],
    "L": [[(-_W, _H), (-_W, -_H), (_W, -_H)]],
    "O": [_arc((0, 0), (_W, _H), 0, 360)],
    "P": [[(-_W, -_H), (-_W, _H), *_arc((0, _H / 2), (_W, _H / 2), 90, -90), (-_W, 0)]],
    "S": [_arc((0, _H / 2), (_W, _H / 2), 30, 270) + _arc((0, -_H / 2), (_W, _H / 2), 90, -150)],
    "T": [[(-_W, _H), (_W, _H)], [(0, _H), (0, -_H)]],
    "U": [[(-_W, _H), *_arc((0, -_H / 2), (_W, _H / 2), 180, 360), (_W, _H)]],
}


def _letter(name: str) -> BaseGeometry:
    strokes = [LineString(points).buffer(_STROKE_MM / 2, cap_style="square") for points in _LETTERS[name]]
    return unary_union(strokes).simplify(0.01)  # where strokes meet, points 1e-15 mm apart would open the mesh


def _regular(corners: int, radius_mm: float) -> Polygon:
    """A regular polygon standing on a side, its corners at `radius_mm`."""
    first = -pi / 2 + pi / corners
    angles = [first + 2 * pi * i / corners for i in range(corners)]
    return Polygon([(radius_mm * cos(a), radius_mm * sin(a)) for a in angles])


_CORNERS: Final = {"circle": 96, "square": 4, "triangle": 3}


def _shape(name: str, form: str) -> BaseGeometry:
    if form == "small":
        return _regular(_CORNERS[name], _SMALL_RADIUS_MM)
    large = _regular(_CORNERS[name], _LARGE_RADIUS_MM)
    return large if form == "large" else large.difference(large.buffer(-_WALL_MM, join_style="mitre"))


_FIGURES: Final[dict[str, Callable[[], BaseGeometry]]] = {
    **{name: (lambda name=name: _letter(name)) for name in _LETTERS},
    **{
        f"{form} {name}": (lambda name=name, form=form: _shape(name, form))
        for name in _CORNERS
        for form in ("hollow", "large", "small")
    },
}

SURFACES: Final = tuple(_FIGURES)
"""Names of the 18 surfaces."""


def surface_mesh(name: str) -> trimesh.Trimesh:
    """The mesh of one surface, figure and base plate as closed bodies side by side.

    Raises:
        ValueError: no surface of that name.
    """
    if name not in _FIGURES:
        raise ValueError(f"no surface {name!r}; there are {', '.join(SURFACES)}")
    figure = trimesh.creation.extrude_polygon(_FIGURES[name](), FIGURE_HEIGHT_MM)
    figure.apply_translation([0, 0, -FIGURE_HEIGHT_MM])
    plate = trimesh.creation.box([PLATE_MM, PLATE_MM, _PLATE_THICKNESS_MM])
    plate.apply_translation([0, 0, -FIGURE_HEIGHT_MM - _PLATE_THICKNESS_MM / 2])
    return figure + plate
