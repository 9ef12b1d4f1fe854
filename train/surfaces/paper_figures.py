"""Outlines of the 18 figures of the paper: nine letters, and three shapes in three forms. Lengths in [mm].

Source: Wu and Liu 2024, Fig. 1c; the paper does not state the figures' exact sizes, and those here are our choice.
"""

from math import cos, pi, radians, sin
from typing import Final

from shapely import LineString, Polygon, unary_union
from shapely.geometry.base import BaseGeometry

_STROKE_MM: Final = 3.0
_WALL_MM: Final = 2.5
_LARGE_RADIUS_MM: Final = 7.0
_SMALL_RADIUS_MM: Final = 3.5
_W: Final = 4.0
"""Half the width of a letter, between stroke centres."""
_H: Final = 6.0
"""Half the height of a letter, between stroke centres."""

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

LETTERS: Final = tuple(_STROKES)
SHAPES: Final = tuple(f"{form} {shape}" for shape in _CORNERS for form in ("hollow", "large", "small"))


def figure(name: str) -> BaseGeometry:
    """Return the outline of one of LETTERS or SHAPES, centred on the origin, in [mm]."""
    return _letter(name) if name in _STROKES else _shape(*name.split())


def _letter(name: str) -> BaseGeometry:
    strokes = [LineString(points).buffer(_STROKE_MM / 2, cap_style="square") for points in _STROKES[name]]
    return unary_union(strokes).simplify(0.01)  # where strokes meet, points 1e-15 mm apart would open the mesh


def _shape(form: str, shape: str) -> BaseGeometry:
    if form == "small":
        return _regular(_CORNERS[shape], _SMALL_RADIUS_MM)
    large = _regular(_CORNERS[shape], _LARGE_RADIUS_MM)
    return large if form == "large" else large.difference(large.buffer(-_WALL_MM, join_style="mitre"))


def _regular(corners: int, radius_mm: float) -> Polygon:
    """Return a regular polygon standing on a side, its corners at `radius_mm`."""
    first = -pi / 2 + pi / corners
    angles = [first + 2 * pi * i / corners for i in range(corners)]
    return Polygon([(radius_mm * cos(a), radius_mm * sin(a)) for a in angles])
