"""All families of shapes by name, their frequencies, and the drawing of one shape under the pad."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from train.errors import MeshError, SurfaceError
from train.families.shapes import NOWHERE_MM, SHAPES, SLOPE, Lie, drawn, log_uniform
from train.physics.contact import BARE, Cover
from train.physics.gripped import SAMPLES, GrippedPad, Taps
from train.surfaces.depth_image import Pose, depth_image
from train.surfaces.meshes import MESH
from train.surfaces.named_surfaces import SURFACES, relief
from train.surfaces.poses import over_surface, random_poses

FIGURES: Final = ("paper", "glyph", "polygon")  # families of flat figures on a plate: the paper's 18, and random ones

SHARES: Final[Mapping[str, float]] = {  # relative frequency of each family in training
    "paper": 20,
    "glyph": 14,
    "polygon": 14,
    "flat": 6,
    "block": 6,
    "edge": 4,
    "corner": 3,
    "slot": 4,
    "step": 2,
    "dome": 3,
    "cylinder": 4,
    "cone": 2,
    "ridge": 2,
    "wire": 3,
    "saddle": 2,
    "relief": 4,
    "grating": 4,
    "solid": 6,
    "two": 4,
    "soft": 5,
    "glove": 5,
}
_PAIRED: Final = ("block", "edge", "dome", "cylinder", "wire", "cone", "solid")  # of which two may be under the pad
_LEVEL: Final = 0.3  # share of shapes that lie level; the others tilt by up to three degrees, most by less than one
_REACH_MM: Final = 6.0
_FIGURE_SLOPE: Final = float(np.tan(np.radians(0.5)))


@dataclass(frozen=True, slots=True)
class Tapped:
    """One shape under K taps, newest first."""

    heights_mm: NDArray[np.float32]  # (K, m, m) at the pad's places
    cover: Cover  # of the shape or the pad
    poses: NDArray[np.float64]  # (K, 3) of the pad in the newest tap's axes: x, y in [mm], turn in [deg]
    angle_deg: NDArray[np.float64]  # (K,), turn of the pad seen from above, for the earth's field


def draw_shape(rng: np.random.Generator, family: str, pad: GrippedPad, poses: NDArray[np.float64]) -> Tapped:
    """Draw one shape of a family, and where it lies, tapped from poses (K, 3) in the newest tap's axes.

    A family is a key of SHARES, a figure of the paper, or `mesh:PATH`, a user's surface.
    """
    if family in FIGURES or family in SURFACES or family.startswith(MESH):
        return _draw_figure(rng, family, pad, poses)
    if family in ("soft", "glove"):
        rigid = draw_shape(rng, str(rng.choice([name for name in SHARES if name not in ("soft", "glove")])), pad, poses)
        if family == "soft":
            return replace(rigid, cover=Cover(soft_mpa=round(log_uniform(rng, 0.05, 2), 3)))
        return replace(rigid, cover=Cover(cloth_mm=rng.uniform(0.2, 1.0), cloth_mpa=log_uniform(rng, 0.3, 3)))
    names = rng.choice(_PAIRED, 2) if family == "two" else [family]
    heights = [drawn(rng, SHAPES[name]) for name in names]
    lies = [_lie(rng, family, index) for index in range(len(names))]
    x, y = np.broadcast_arrays(*pad.places_mm)

    def seen_from(pose: NDArray[np.float64]) -> NDArray[np.float32]:
        seen = [_under(lie, pose).seen(height, x, y) for height, lie in zip(heights, lies, strict=True)]
        return np.maximum.reduce(seen)

    maps, met = _that_meet(poses, seen_from)
    return Tapped(maps, BARE, met, -met[:, 2])


def _that_meet(
    poses: NDArray[np.float64], seen_from: Callable[[NDArray[np.float64]], NDArray[np.float32]]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return the heights from each pose, and the poses: one that misses the shape moves half-way to the newest."""
    maps, met = [], poses.copy()
    for pose in met:
        heights_mm = seen_from(pose)
        for _ in range(6):
            if heights_mm.max() > NOWHERE_MM / 2:
                break
            pose[:2] /= 2
            heights_mm = seen_from(pose)
        maps.append(heights_mm)
    return np.stack(maps), met


def _lie(rng: np.random.Generator, family: str, index: int) -> Lie:
    """Draw the place of a shape; the second of two lies on the pad's other side, at nearly the same height."""
    x_mm, y_mm = rng.uniform(-_REACH_MM, _REACH_MM, 2)
    if family == "two":
        x_mm = (4 + rng.uniform(0, 4)) * (1 if index else -1)
    slope = np.zeros(2)
    if rng.random() > _LEVEL:
        way = rng.uniform(0, 2 * np.pi)
        slope = SLOPE * rng.random() ** 2 * np.array([np.cos(way), np.sin(way)])
    if family == "two":
        slope = slope / 5
    return Lie(float(x_mm), float(y_mm), float(rng.uniform(0, 360)), float(slope[0]), float(slope[1]))


def _under(lie: Lie, pose: NDArray[np.float64]) -> Lie:
    """Return a shape's place under a pad at a pose, of its place under the newest tap."""
    turn = -np.radians(pose[2])
    cosine, sine = np.cos(turn), np.sin(turn)
    x_mm, y_mm = lie.x_mm - pose[0], lie.y_mm - pose[1]
    right, down = cosine * x_mm - sine * y_mm, sine * x_mm + cosine * y_mm
    slope_x, slope_y = cosine * lie.slope_x - sine * lie.slope_y, sine * lie.slope_x + cosine * lie.slope_y
    return Lie(float(right), float(down), lie.angle_deg - float(pose[2]), float(slope_x), float(slope_y))


def _draw_figure(rng: np.random.Generator, family: str, pad: GrippedPad, poses: NDArray[np.float64]) -> Tapped:
    name = family
    if family == "paper":
        name = str(rng.choice(SURFACES))
    elif family in FIGURES:
        name = f"{family}:{int(rng.integers(1_000_000, 2**40))}"
    newest = random_poses(rng, 1)[0]

    def seen_from(pose: NDArray[np.float64]) -> NDArray[np.float32]:
        over = over_surface(newest, *pose.tolist())
        try:
            return heights_of(name, over, pad)
        except MeshError:
            raise
        except ValueError as error:  # a user's mesh is a ring, or smaller than the poses' reach
            if pose[:2].any():
                return np.full((pad.size * SAMPLES,) * 2, NOWHERE_MM, dtype=np.float32)
            raise SurfaceError(f"{error}; tap a surface that has no hole as wide as the pad") from error

    heights, met = _that_meet(poses, seen_from)
    if rng.random() > _LEVEL:
        slope = rng.uniform(-_FIGURE_SLOPE, _FIGURE_SLOPE, 2).astype(np.float32)
        heights = heights + slope[0] * pad.places_mm[0] + slope[1] * pad.places_mm[1]
    return Tapped(heights, BARE, met, newest.angle_deg - met[:, 2])


def heights_of(surface: str, pose: Pose, pad: GrippedPad) -> NDArray[np.float32]:
    """Return the heights (m, m) of a surface at the places of a pad at a pose over it."""
    return -depth_image(relief(surface), pose, pad.size * SAMPLES, pad.cell_mm / SAMPLES)


def tap(pad: GrippedPad, surfaces: Sequence[str], poses: Sequence[Pose], force_n: float) -> Taps:
    """Return whole taps of flat surfaces, each from a pose over it."""
    heights_mm = [heights_of(surface, pose, pad) for surface, pose in zip(surfaces, poses, strict=True)]
    return pad.tap(np.stack(heights_mm), force_n)
