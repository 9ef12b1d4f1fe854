"""Presses of any shape onto one pad: pressure, traction, readings, and truth.

Shapes are heights at any place (`train.families`), sampled on SAMPLES x SAMPLES places a cell, which give each cell's
depth and covered share. A press is one moment; the paper's taps are followed from first contact to their end
(`GrippedPad.tap`). Friction is solved after the pressure, which it leaves unchanged (Goodman 1962).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from train.errors import SurfaceError
from train.physics.contact import BARE, REACH, ContactSolver, Cover, FrictionSolver
from train.physics.pad_draws import Pad
from train.physics.taxel_response import Skin, on_pad
from train.physics.tpsf import heights_pattern, resample, resample_touching
from train.surfaces.depth_image import NOTHING_MM

MAX_INDENTATION_MM: Final = 0.5  # largest indentation, in [mm]: beyond a tenth of its thickness the layer is not linear
FRAMES: Final = 16  # frames of a whole tap; frame i is at (i + 1) / FRAMES of its last indentation
FINE_SCALE: Final = 20  # pattern pixels per pitch at which truth is computed
SAMPLES: Final = 4  # places along a cell's side at which a shape is sampled
MOST_FORCE_N: Final = 40.0  # largest force on the pad, in [N]
SCALE: Final = 10
TRACTION_SCALE: Final = 2  # traction pixels per pitch: the layer passes 3 % of a wave of two such pixels
_CELLS_PER_PITCH: Final = 10
_MOST_TRIES: Final = 6

_Kind = TypeVar("_Kind", bound=np.generic)


@dataclass(frozen=True, slots=True)
class Presses:
    """n presses onto one pad; forces and tractions along x to the right, y down the rows, z into the pad."""

    counts: NDArray[np.float32]  # (n, 3, rows, cols), zeroed and clean
    patterns: NDArray[np.float32]  # (n, H, W), SCALE pixels per pitch unless asked otherwise, in [mm]
    touching: NDArray[np.bool_]  # (n, H, W), contact area on the pad
    traction_kpa: NDArray[np.float32]  # (n, 3, h, w) at TRACTION_SCALE
    force_n: NDArray[np.float32]  # (n, 3)
    twist_nmm: NDArray[np.float32]  # (n,), about the pad's centre from x towards y
    indentation_mm: NDArray[np.float32]  # (n,)


@dataclass(frozen=True, slots=True)
class Taps:
    """n whole taps of flat figures, FRAMES frames each, in even steps of the indentation."""

    counts: NDArray[np.float32]  # (n, FRAMES, 3, rows, cols), zeroed and clean
    force_n: NDArray[np.float32]  # (n, FRAMES), normal
    indentation_mm: NDArray[np.float32]  # (n, FRAMES)
    unit_patterns: NDArray[np.float32]  # (n, H, W) at FINE_SCALE, deformation per indentation
    touching: NDArray[np.bool_]  # (n, H, W) at FINE_SCALE, contact area on the pad


def between_frames(frames: NDArray[np.float32], share: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return values (b, m, ...) at shares (b, m) of presses, between frames (b, FRAMES, ...) and 0 at the start."""
    away = np.abs(share[..., None] * FRAMES - np.arange(1, FRAMES + 1))
    weights = np.maximum(1 - away, 0).astype(np.float32)
    return (weights @ frames.reshape(*frames.shape[:2], -1)).reshape(*share.shape, *frames.shape[2:])


class GrippedPad:
    """One pad, and presses onto it."""

    def __init__(self, pad: Pad) -> None:
        self.pad = pad
        geometry = pad.grid
        self.cell_mm = geometry.pixel_pitch_mm(_CELLS_PER_PITCH)
        # Solved on a square as wide as the longer side; where the pad ends before, nothing touches.
        self._side = max(geometry.rows, geometry.cols)
        self._pattern_cells = self._side * _CELLS_PER_PITCH
        side_mm = max(geometry.width_mm, geometry.height_mm)
        self.size = self._pattern_cells + 2 * int((side_mm / self.cell_mm - self._pattern_cells) // 2)
        self._beside = ~on_pad(geometry, self.size * SAMPLES, self.cell_mm / SAMPLES)
        self._solvers: dict[Cover, ContactSolver] = {}
        self._friction = FrictionSolver(pad.layer, self.size, self.cell_mm)
        self.skin = Skin(pad, self.size, self.cell_mm)
        across = ((np.arange(self.size * SAMPLES) + 0.5) / SAMPLES - self.size / 2) * self.cell_mm
        # x (1, m) and y (m, 1) on the pad at which shapes are sampled.
        self.places_mm = (across[None, :].astype(np.float32), across[:, None].astype(np.float32))
        self._uneven_mm = pad.uneven(*self.places_mm)

    def press(
        self,
        heights_mm: NDArray[np.float32],
        indentation_mm: NDArray[np.floating],
        slide_mm: NDArray[np.floating],
        twist_rad: NDArray[np.floating],
        friction: NDArray[np.floating],
        covers: Sequence[Cover],
        scale: int = SCALE,
    ) -> Presses:
        """Press shapes onto the pad, where none exceeds MOST_FORCE_N; SurfaceError if nothing lies under the pad.

        Heights (n, m, m) are at `places_mm`, indentations (n,) of the highest part from first contact, above 0 to
        MAX_INDENTATION_MM. Then the shapes slide (n, 2) to the right and down the rows, and turn (n,) about the pad's
        centre from x towards y, with Coulomb's friction (n,). `scale` is pattern pixels per taxel pitch.
        """
        depth_mm, cells_mm, share = self._under(heights_mm)
        depth = np.array(indentation_mm, dtype=np.float64)
        pressure = np.zeros(cells_mm.shape, dtype=np.float32)
        for cover, which in _which_of(covers):
            pressure[which], depth[which] = self._pressed(cover, cells_mm[which], share[which], depth[which])
        pressed_mm = depth.astype(np.float32)
        on_pad_mpa = np.stack(
            [cover.passed_on(pressure_mpa, self.cell_mm) for cover, pressure_mpa in zip(covers, pressure, strict=True)]
        )
        sideways_mpa, _ = self._friction.solve(on_pad_mpa, slide_mm, twist_rad, friction)
        loads = np.concatenate([sideways_mpa, on_pad_mpa[:, None]], axis=1)
        across = (np.arange(self.size) - (self.size - 1) / 2) * self.cell_mm
        moments = loads[:, 1] * across[None, :] - loads[:, 0] * across[:, None]
        patterns, touching = self._truth(covers, depth_mm, cells_mm, pressure, on_pad_mpa, pressed_mm)
        return Presses(
            counts=self.skin.frames(on_pad_mpa[:, None], sideways_mpa[:, None])[:, 0],
            patterns=resample(patterns, FINE_SCALE, scale),
            touching=resample_touching(touching, FINE_SCALE, scale),
            traction_kpa=self._cut(self._coarse(loads) * 1e3, TRACTION_SCALE),
            force_n=loads.sum(axis=(2, 3)) * np.float32(self.cell_mm**2),
            twist_nmm=(moments.sum(axis=(1, 2)) * self.cell_mm**2).astype(np.float32),
            indentation_mm=pressed_mm,
        )

    def tap(self, heights_mm: NDArray[np.float32], force_n: float) -> Taps:
        """Press flat figures straight down until the set force or MAX_INDENTATION_MM, whichever comes first.

        Heights are as in `press`; the pad does not reach the plate under a figure. The pressure is then in proportion
        to the indentation: one solution serves all frames of a tap.
        """
        depth_mm, cells_mm, share = self._under(heights_mm)
        most_mm = np.full(len(heights_mm), MAX_INDENTATION_MM)
        pressure, _ = self._pressed(BARE, cells_mm, share, most_mm, np.inf)
        most_n = pressure.sum(axis=(1, 2)) * self.cell_mm**2
        end = np.minimum(force_n / most_n, 1.0)[:, None] * (np.arange(FRAMES) + 1) / FRAMES
        covers, pressed_mm = [BARE] * len(heights_mm), most_mm.astype(np.float32)
        patterns, touching = self._truth(covers, depth_mm, cells_mm, pressure, pressure, pressed_mm)
        unit = self.skin.movement(pressure / MAX_INDENTATION_MM)[:, None]
        return Taps(
            counts=self.skin.counts(unit * (end * MAX_INDENTATION_MM)[..., None, None].astype(unit.dtype)),
            force_n=(most_n[:, None] * end).astype(np.float32),
            indentation_mm=(end * MAX_INDENTATION_MM).astype(np.float32),
            unit_patterns=patterns / np.float32(MAX_INDENTATION_MM),
            touching=touching,
        )

    def _cut(self, maps: NDArray[_Kind], scale: int) -> NDArray[_Kind]:
        """Return the part of square maps (n, side, side), so many pixels a pitch, that lies over the taxels."""
        away = (self._side - np.array([self.pad.grid.rows, self.pad.grid.cols])) * scale // 2
        return maps[..., away[0] : self._side * scale - away[0], away[1] : self._side * scale - away[1]]

    def _under(
        self, heights_mm: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Return depths below the highest part at the places and in the cells, and the cells' carrying shares."""
        if self._beside.any():
            heights_mm = np.where(self._beside, np.float32(-NOTHING_MM), heights_mm)
        if not (heights_mm.max(axis=(1, 2)) > -100).all():
            raise SurfaceError("nothing lies under the pad: expected a shape that reaches it")
        depth_mm = heights_mm.max(axis=(1, 2), keepdims=True) - heights_mm + self._uneven_mm
        depth_mm -= depth_mm.min(axis=(1, 2), keepdims=True)
        parts_mm, share = _carrying(depth_mm, self.size)
        return depth_mm, parts_mm.astype(np.float32), share

    def _pressed(
        self,
        cover: Cover,
        cells_mm: NDArray[np.float32],
        share: NDArray[np.float32],
        indentation_mm: NDArray[np.float64],
        most_force_n: float = MOST_FORCE_N,
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Return pressures on the shape, and the indentations at which no force exceeds the limit."""
        solver = self._solver(cover)
        least_mm = cells_mm.min(axis=(1, 2)) + 1e-3
        indentation_mm = np.maximum(indentation_mm, least_mm)
        pressure = np.empty_like(cells_mm)
        open_ = np.arange(len(cells_mm))
        for _ in range(_MOST_TRIES):
            pressure[open_], _ = solver.solve(cells_mm[open_], indentation_mm[open_], covered=share[open_])
            force_n = pressure[open_].sum(axis=(1, 2)) * self.cell_mm**2
            over = force_n > most_force_n
            if not over.any():
                break
            open_, excess = open_[over], force_n[over] / most_force_n
            lighter_mm = indentation_mm[open_] * 0.98 / excess**0.9  # force grows faster than depth
            indentation_mm[open_] = np.maximum(lighter_mm, least_mm[open_])
        return pressure, indentation_mm

    def _truth(
        self,
        covers: Sequence[Cover],
        depth_mm: NDArray[np.float32],
        cells_mm: NDArray[np.float32],
        pressure_mpa: NDArray[np.float32],
        on_pad_mpa: NDArray[np.float32],
        pressed_mm: NDArray[np.float32],
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return patterns and contact areas at FINE_SCALE, which is pixels of half a cell.

        A cell's own deflection under its pressure on the shape, less its gap, is positive inside a contact and negative
        outside. In contact with a rigid shape the pad follows the shape, under a soft one its own layer's deflection.
        """
        pixels = 2 * self._pattern_cells
        rim = self.size - self._pattern_cells
        middle = (slice(None), slice(rim, rim + pixels), slice(rim, rim + pixels))
        fine_mm, fine_share = _carrying(depth_mm, 2 * self.size)
        fine_mm, fine_share = fine_mm[middle], fine_share[middle]
        indented_mm = pressed_mm[:, None, None]
        close_mm = np.empty_like(pressure_mpa)
        for cover, which in _which_of(covers):
            solver = self._solver(cover)
            gap_mm = solver.displacement_mm(pressure_mpa[which]) - (indented_mm[which] - cells_mm[which])
            close_mm[which] = pressure_mpa[which] * np.float32(solver.cell_compliance_mm_per_mpa) - gap_mm
        # The edge of a steep shape follows from the pressure alone.
        close_mm = np.where(cells_mm > 2.0 * indented_mm, np.minimum(pressure_mpa, 0), close_mm)
        to_pixels = _between(self.size, pixels)
        touching = (to_pixels @ close_mm @ to_pixels.T > 0) & (fine_mm < REACH * indented_mm)
        # The press always reaches the highest part, whichever cells that lies between.
        bottom = fine_mm <= fine_mm.min(axis=(1, 2), keepdims=True) + 1e-4
        touching = (touching | bottom) & _mostly(fine_share)
        touching |= bottom & ~touching.any(axis=(1, 2), keepdims=True)  # a tip thinner than half a pixel
        covered = np.array([cover != BARE for cover in covers])
        if covered.any():
            sunk_mm = to_pixels @ self._solver(BARE).displacement_mm(on_pad_mpa[covered]) @ to_pixels.T
            fine_mm[covered] = np.clip(indented_mm[covered] - sunk_mm, 0, indented_mm[covered])
        patterns = heights_pattern(fine_mm, touching, pressed_mm, self.cell_mm / 2)
        return self._cut(patterns, FINE_SCALE), self._cut(touching, FINE_SCALE)

    def _coarse(self, loads: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return means of loads (n, 3, size, size) on the traction's grid, whose outer pixels include loads outside."""
        count = self._side * TRACTION_SCALE
        side = self._pattern_cells // count
        owner = np.clip((np.arange(self.size) - (self.size - self._pattern_cells) // 2) // side, 0, count - 1)
        gather = (owner == np.arange(count)[:, None]).astype(np.float32) / side
        return gather @ loads @ gather.T

    def _solver(self, cover: Cover) -> ContactSolver:
        if cover not in self._solvers:
            pad = self.pad
            self._solvers[cover] = ContactSolver(pad.layer, self.size, self.cell_mm, cover=cover, sides=pad.free_sides)
        return self._solvers[cover]


def _carrying(depth_mm: NDArray[np.floating], cells: int) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return the depth of each cell's carrying part, and its share of the cell, (n, cells, cells), of (n, m, m)."""
    samples = depth_mm.shape[1] // cells
    parts = depth_mm.reshape(len(depth_mm), cells, samples, cells, samples)
    # A part 0.1 mm below a cell's highest one carries no load.
    carries = parts < parts.min(axis=(2, 4), keepdims=True) + 0.1
    count = carries.sum(axis=(2, 4))
    return np.where(carries, parts, 0).sum(axis=(2, 4)) / count, (count / samples**2).astype(np.float32)


def _which_of(covers: Sequence[Cover]) -> Iterable[tuple[Cover, NDArray[np.int64]]]:
    """Yield each cover once, with the numbers of the presses that have it."""
    for cover in dict.fromkeys(covers):
        yield cover, np.array([number for number, other in enumerate(covers) if other == cover])


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
