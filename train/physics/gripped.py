"""Presses of any shape onto one pad: pressure, traction, readings, and truth.

Shapes are heights at any place (`train.families`), sampled on SAMPLES x SAMPLES places a cell, which give each cell's
depth and covered share. A press is one moment; the paper's taps are followed from first contact to their end
(`GrippedPad.tap`). Friction is solved after the pressure, which it leaves unchanged (Goodman 1962).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from train.errors import TrainError
from train.physics.contact import BARE, ContactSolver, Cover
from train.physics.friction import FrictionSolver
from train.physics.pad_draws import Pad
from train.physics.resample import resample, resample_touching
from train.physics.taxel_response import Skin, on_pad
from train.physics.touched import carrying, pressed_in, which_of
from train.physics.tpsf import heights_pattern
from train.surfaces.depth_image import NOTHING_MM

MAX_INDENTATION_MM: Final = 0.5
"""Largest indentation, in [mm]: beyond a tenth of its thickness the layer is not linear."""
FRAMES: Final = 16
"""Frames of a whole tap; frame i is at (i + 1) / FRAMES of its last indentation."""
FINE_SCALE: Final = 20
"""Pattern pixels per pitch at which truth is computed."""
SAMPLES: Final = 4
"""Places along a cell's side at which a shape is sampled."""
MOST_FORCE_N: Final = 40.0
"""Largest force on the pad, in [N]."""
SCALE: Final = 10
TRACTION_SCALE: Final = 2
"""Traction pixels per taxel pitch: the layer passes 3 % of a wave of two such pixels, so finer is not measurable."""
_CELLS_PER_PITCH: Final = 10
_MOST_TRIES: Final = 6

_Kind = TypeVar("_Kind", bound=np.generic)


class PressError(TrainError, ValueError):
    """Press outside the range in which the pad's layer is linear."""


@dataclass(frozen=True, slots=True)
class Presses:
    """n presses onto one pad.

    Attributes:
        counts: (n, 3, rows, cols), zeroed and clean.
        patterns: (n, H, W), SCALE pixels per pitch unless asked otherwise, in [mm].
        touching: (n, H, W), contact area on the pad.
        traction_kpa: (n, 3, h, w) at TRACTION_SCALE, x to the right, y down the rows, z into the pad, in [kPa].
        force_n: (n, 3), in [N].
        twist_nmm: (n,), about the pad's centre from x towards y, in [N mm].
        indentation_mm: (n,), in [mm].
    """

    counts: NDArray[np.float32]
    patterns: NDArray[np.float32]
    touching: NDArray[np.bool_]
    traction_kpa: NDArray[np.float32]
    force_n: NDArray[np.float32]
    twist_nmm: NDArray[np.float32]
    indentation_mm: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Taps:
    """n whole taps of flat figures, FRAMES frames each, in even steps of the indentation.

    Attributes:
        counts: (n, FRAMES, 3, rows, cols), zeroed and clean.
        force_n: (n, FRAMES), normal, in [N].
        indentation_mm: (n, FRAMES), in [mm].
        unit_patterns: (n, H, W) at FINE_SCALE, deformation per indentation.
        touching: (n, H, W) at FINE_SCALE, contact area on the pad.
    """

    counts: NDArray[np.float32]
    force_n: NDArray[np.float32]
    indentation_mm: NDArray[np.float32]
    unit_patterns: NDArray[np.float32]
    touching: NDArray[np.bool_]


class GrippedPad:
    """One pad, and presses onto it.

    Attributes:
        places_mm: x (1, m) and y (m, 1) on the pad at which shapes are sampled, in [mm].
    """

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
        self.places_mm = (across[None, :].astype(np.float32), across[:, None].astype(np.float32))
        self._uneven_mm = pad.uneven(*self.places_mm)

    def press(
        self,
        heights_mm: NDArray[np.float32],
        indentation_mm: NDArray[np.floating],
        slide_mm: NDArray[np.floating],
        twist_rad: NDArray[np.floating],
        friction: NDArray[np.floating],
        covers: Sequence[Cover] | None = None,
        most_force_n: float = MOST_FORCE_N,
        scale: int = SCALE,
    ) -> Presses:
        """Press shapes onto the pad; a press that would exceed the largest force is made less deep.

        Args:
            heights_mm: (n, m, m) at `places_mm`, in [mm]; higher parts touch the pad first.
            indentation_mm: (n,), of the highest part from first contact, above 0, in [mm].
            slide_mm: (n, 2), movement of the shape to the right and down the rows after contact, in [mm].
            twist_rad: (n,), turn about the pad's centre from x towards y.
            friction: (n,), Coulomb's coefficient.
            covers: one for each press; all bare if None.
            most_force_n: largest normal force, in [N].
            scale: pattern pixels per taxel pitch.

        Raises:
            PressError: an indentation is outside the layer's linear range, or nothing lies under the pad.
        """
        within = (indentation_mm > 0) & (indentation_mm <= MAX_INDENTATION_MM)
        if not within.all():
            raise PressError(
                f"indentation of {indentation_mm[~within][0]:g} mm, expected above 0 to {MAX_INDENTATION_MM} mm: "
                "beyond a tenth of its thickness the pad is not linear; press less deep"
            )
        covers = [BARE] * len(heights_mm) if covers is None else covers
        depth_mm, cells_mm, share = self._under(heights_mm)
        depth = np.array(indentation_mm, dtype=np.float64)
        pressure = np.zeros(cells_mm.shape, dtype=np.float32)
        for cover, which in which_of(covers):
            pressure[which], depth[which] = self._pressed(
                cover, cells_mm[which], share[which], depth[which], most_force_n
            )
        pressed_mm = depth.astype(np.float32)
        on_pad_mpa = np.stack([cover.passed_on(one, self.cell_mm) for cover, one in zip(covers, pressure, strict=True)])
        sideways_mpa = self._friction.solve(on_pad_mpa, slide_mm, twist_rad, friction).traction_mpa
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

    def tap(self, heights_mm: NDArray[np.float32], force_n: NDArray[np.floating] | float) -> Taps:
        """Press flat figures straight down until the set force or MAX_INDENTATION_MM, whichever comes first.

        On a flat figure the pressure is in proportion to the indentation: one solution serves all frames of a tap.

        Args:
            heights_mm: (n, m, m) as in `press`, of figures on a plate that the pad does not reach.
            force_n: set force, one for all or (n,), in [N].
        """
        depth_mm, cells_mm, share = self._under(heights_mm)
        most_mm = np.full(len(heights_mm), MAX_INDENTATION_MM)
        pressure, _ = self._pressed(BARE, cells_mm, share, most_mm.copy(), np.inf)
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
        """Return depths below the highest part at the places and in the cells, and the cells' carrying shares.

        Raises:
            PressError: nothing lies under the pad.
        """
        if self._beside.any():
            heights_mm = np.where(self._beside, np.float32(-NOTHING_MM), heights_mm)
        if not (heights_mm.max(axis=(1, 2)) > -100).all():
            raise PressError("nothing lies under the pad: expected a shape that reaches it")
        depth_mm = heights_mm.max(axis=(1, 2), keepdims=True) - heights_mm + self._uneven_mm
        depth_mm -= depth_mm.min(axis=(1, 2), keepdims=True)
        parts_mm, share = carrying(depth_mm, self.size)
        return depth_mm, parts_mm.astype(np.float32), share

    def _pressed(
        self,
        cover: Cover,
        cells_mm: NDArray[np.float32],
        share: NDArray[np.float32],
        indentation_mm: NDArray[np.float64],
        most_force_n: float,
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Return pressures on the shape, and the indentations at which no force exceeds the limit."""
        solver = self._solver(cover)
        least_mm = cells_mm.min(axis=(1, 2)) + 1e-3
        indentation_mm = np.maximum(indentation_mm, least_mm)
        pressure = np.empty_like(cells_mm)
        open_ = np.arange(len(cells_mm))
        for _ in range(_MOST_TRIES):
            pressure[open_] = solver.solve(cells_mm[open_], indentation_mm[open_], covered=share[open_]).pressure_mpa
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
        pressure: NDArray[np.float32],
        on_pad_mpa: NDArray[np.float32],
        pressed_mm: NDArray[np.float32],
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return patterns and contact areas at FINE_SCALE, of loads as in `pressed_in`."""
        fine_mm, touching = pressed_in(
            self._solver, covers, depth_mm, cells_mm, pressure, on_pad_mpa, pressed_mm, self._pattern_cells
        )
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
            self._solvers[cover] = ContactSolver(pad.layer, self.size, self.cell_mm, cover=cover, sides=pad.sides)
        return self._solvers[cover]
