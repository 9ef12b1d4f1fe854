"""Presses of any shape onto one pad, at one moment: pressure, traction, readings, and truth.

A tap of `train.simulation` follows a press from first touch to its end; here each press is one moment, with a pad of
its own, a tilt, a tangential load and a twist. Shapes are heights at any place (`train.families`), looked at on a grid
of SAMPLES x SAMPLES places a cell, from which follow each cell's depth and how much of it is covered.

A soft object gives way as a thick layer of its own; a cloth or glove on the pad gives way and spreads what it carries.
Friction is solved after the pressure, which it leaves as it is (Goodman 1962).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.geometry import USPA44
from train.contact import REACH, ContactSolver
from train.errors import TrainError
from train.heights import heights_pattern
from train.layer import surface_compliance
from train.physics.friction import FrictionSolver
from train.physics.pads import Pad
from train.resample import resample, resample_touching
from train.simulation import MAX_INDENTATION_MM
from train.skin import Skin

SAMPLES: Final = 4
"""Places along a cell's side at which a shape is looked at."""
MOST_FORCE_N: Final = 40.0
"""Largest force on the pad."""
SCALE: Final = 10
TRACTION_SCALE: Final = 2
"""Traction pixels per taxel pitch: the layer passes 3 % of a wave as short as two of them, so finer is not measured."""
_CELLS_PER_PITCH: Final = 10
_WALL_MM: Final = 0.1
"""A part of a cell this far below its highest part carries nothing while that one is pressed."""
_LIGHTER: Final = 0.9
"""Depth is lowered by this power of the force's excess; force grows faster than depth."""
_MOST_TRIES: Final = 6


class PressError(TrainError, ValueError):
    """A press that the pad's linear layer does not hold for."""


@dataclass(frozen=True, slots=True)
class Cover:
    """What lies between the rigid shape and the pad, or gives way instead of it.

    Attributes:
        soft_mpa: shear modulus of a soft object, thick and incompressible; 0 for a rigid one.
        cloth_mm: thickness of a cloth or glove over the pad; 0 for none.
        cloth_mpa: its modulus under even pressure.
    """

    soft_mpa: float = 0.0
    cloth_mm: float = 0.0
    cloth_mpa: float = 1.0


BARE: Final = Cover()


@dataclass(frozen=True, slots=True)
class Presses:
    """n presses onto one pad.

    Attributes:
        counts: (n, 3, rows, cols), zeroed and clean.
        patterns: (n, H, W) at SCALE, in [mm].
        touching: (n, H, W), where the pad is touched.
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


class GrippedPad:
    """One pad, and presses onto it.

    Args:
        pad: its constants.

    Attributes:
        places_mm: x (1, m) and y (m, 1) on the pad at which shapes are looked at, in [mm].
    """

    def __init__(self, pad: Pad) -> None:
        self.pad = pad
        geometry = USPA44
        self.cell_mm = geometry.pixel_pitch_mm(_CELLS_PER_PITCH)
        self._pattern_cells = geometry.rows * _CELLS_PER_PITCH
        self.size = self._pattern_cells + 2 * int((geometry.width_mm / self.cell_mm - self._pattern_cells) // 2)
        self._bare = self._solver(BARE)
        self._solvers: dict[Cover, ContactSolver] = {BARE: self._bare}
        self._friction = FrictionSolver(pad.layer, self.size, self.cell_mm)
        self.skin = Skin(
            pad.geometry(),
            pad.layer,
            self.size,
            self.cell_mm,
            pad.magnet,
            in_plane_share=pad.in_plane_share,
            rest=pad.rest(geometry.taxel_count),
            moments=pad.moments(geometry.taxel_count),
            counts_per_newton=pad.counts_per_newton,
            sides=pad.sides,
        )
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
    ) -> Presses:
        """Press shapes onto the pad; one that would take more force than allowed is pressed less deep.

        Args:
            heights_mm: (n, m, m) at `places_mm`, higher parts meet the pad first, in [mm].
            indentation_mm: (n,), of the highest part from first contact, above 0, in [mm].
            slide_mm: (n, 2), how far the shape is moved to the right and down the rows after it touches, in [mm].
            twist_rad: (n,), how far it is turned about the pad's centre from x towards y.
            friction: (n,), Coulomb's coefficient.
            covers: one for each press; all bare if None.
            most_force_n: largest normal force, in [N].

        Raises:
            PressError: an indentation is beyond what the layer is linear to, or nothing lies under the pad.
        """
        deepest = float(np.max(indentation_mm, initial=0.0))
        if not (np.min(indentation_mm, initial=1.0) > 0 and deepest <= MAX_INDENTATION_MM):
            raise PressError(
                f"indentation of {deepest:g} mm, expected above 0 to {MAX_INDENTATION_MM} mm: beyond a tenth of its "
                "thickness the pad is not linear; press less deep"
            )
        covers = [BARE] * len(heights_mm) if covers is None else covers
        depth_mm = heights_mm.max(axis=(1, 2), keepdims=True) - heights_mm
        if not (heights_mm.max(axis=(1, 2)) > -100).all():
            raise PressError("nothing lies under the pad: expected a shape that reaches it")
        depth_mm = depth_mm + self._uneven_mm
        depth_mm -= depth_mm.min(axis=(1, 2), keepdims=True)
        cells_mm, share = self._cells(depth_mm)
        depth = np.array(indentation_mm, dtype=np.float64)
        pressure = np.zeros(cells_mm.shape, dtype=np.float32)
        for cover in dict.fromkeys(covers):
            which = np.array([i for i, one in enumerate(covers) if one == cover])
            pressure[which], depth[which] = self._pressed(
                cover, cells_mm[which], share[which], depth[which], most_force_n
            )
        return self._result(covers, depth_mm, cells_mm, pressure, depth, slide_mm, twist_rad, friction)

    def _cells(self, depth_mm: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Depth of each cell's carrying part, and its share of the cell, both (n, size, size)."""
        parts = depth_mm.reshape(len(depth_mm), self.size, SAMPLES, self.size, SAMPLES)
        top = parts.min(axis=(2, 4))
        carries = parts < top[:, :, None, :, None] + _WALL_MM
        count = carries.sum(axis=(2, 4), dtype=np.float32)
        return np.where(carries, parts, 0).sum(axis=(2, 4)) / count, count / SAMPLES**2

    def _pressed(
        self,
        cover: Cover,
        cells_mm: NDArray[np.float32],
        share: NDArray[np.float32],
        indentation_mm: NDArray[np.float64],
        most_force_n: float,
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Pressures on the shape, and the indentations at which no force is larger than allowed."""
        solver = self._solvers.setdefault(cover, None) or self._solver(cover)
        self._solvers[cover] = solver
        indentation_mm = np.maximum(indentation_mm, cells_mm.min(axis=(1, 2)) + 1e-3)
        pressure = np.empty_like(cells_mm)
        open_ = np.arange(len(cells_mm))
        for _ in range(_MOST_TRIES):
            pressure[open_] = solver.solve(cells_mm[open_], indentation_mm[open_], cover=share[open_]).pressure_mpa
            force_n = pressure[open_].sum(axis=(1, 2)) * self.cell_mm**2
            over = force_n > most_force_n
            if not over.any():
                break
            open_, excess = open_[over], force_n[over] / most_force_n
            indentation_mm[open_] = np.maximum(
                indentation_mm[open_] * 0.98 / excess**_LIGHTER, cells_mm[open_].min(axis=(1, 2)) + 1e-3
            )
        return pressure, indentation_mm

    def _result(
        self,
        covers: Sequence[Cover],
        depth_mm: NDArray[np.float32],
        cells_mm: NDArray[np.float32],
        pressure: NDArray[np.float32],
        indentation_mm: NDArray[np.float64],
        slide_mm: NDArray[np.floating],
        twist_rad: NDArray[np.floating],
        friction: NDArray[np.floating],
    ) -> Presses:
        on_pad = np.stack([self._passed_on(cover, one) for cover, one in zip(covers, pressure, strict=True)])
        sideways = self._friction.solve(on_pad, slide_mm, twist_rad, friction).traction_mpa
        counts = self.skin.frames(on_pad[:, None], sideways[:, None])[:, 0]
        pressed = indentation_mm.astype(np.float32)
        fine_mm, touching = self._touched(covers, depth_mm, cells_mm, pressure, on_pad, pressed)
        pixel_mm = self.cell_mm / 2
        patterns = heights_pattern(fine_mm, touching, pressed, pixel_mm)
        loads = np.concatenate([sideways, on_pad[:, None]], axis=1)
        force = loads.sum(axis=(2, 3)) * np.float32(self.cell_mm**2)
        across = (np.arange(self.size) - (self.size - 1) / 2) * self.cell_mm
        twist = (loads[:, 1] * across[None, :] - loads[:, 0] * across[:, None]).sum(axis=(1, 2)) * self.cell_mm**2
        return Presses(
            counts=counts,
            patterns=resample(patterns, 2 * SCALE, SCALE),
            touching=resample_touching(touching, 2 * SCALE, SCALE),
            traction_kpa=self._coarse(loads) * 1e3,
            force_n=force,
            twist_nmm=twist.astype(np.float32),
            indentation_mm=pressed,
        )

    def _touched(
        self,
        covers: Sequence[Cover],
        depth_mm: NDArray[np.float32],
        cells_mm: NDArray[np.float32],
        pressure: NDArray[np.float32],
        on_pad: NDArray[np.float32],
        indentation_mm: NDArray[np.float32],
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """How far below its highest part the pad is pressed in, and where it is touched, on pixels of half a cell.

        A cell's own deflection under its pressure, less its gap, is positive inside a contact and negative outside;
        the contact's edge is where it passes through zero between the cells' centres. A rigid shape is followed; under
        a soft one the pad lies where its own layer gives way to.
        """
        n, cells = len(depth_mm), self._pattern_cells
        halves = depth_mm.reshape(n, self.size * 2, SAMPLES // 2, self.size * 2, SAMPLES // 2)
        top = halves.min(axis=(2, 4), keepdims=True)
        near = halves < top + _WALL_MM
        fine = np.where(near, halves, 0).sum(axis=(2, 4)) / near.sum(axis=(2, 4))
        rim = self.size - cells
        fine = fine[:, rim : rim + 2 * cells, rim : rim + 2 * cells]
        to_pixels = _between(self.size, 2 * cells)
        own = np.empty_like(pressure)
        for cover in dict.fromkeys(covers):
            which = np.array([i for i, one in enumerate(covers) if one == cover])
            solver = self._solvers[cover]
            gap = solver.displacement_mm(pressure[which]) - (indentation_mm[which, None, None] - cells_mm[which])
            own[which] = pressure[which] * np.float32(solver.cell_compliance_mm_per_mpa) - gap
        steep = cells_mm > 2 * indentation_mm[:, None, None]
        own = np.where(steep, np.minimum(pressure, 0), own)
        reach = fine < REACH * indentation_mm[:, None, None]
        touching = (to_pixels @ own @ to_pixels.T > 0) & reach
        # The press bottoms out on the highest part, whichever cells that lies between.
        touching |= fine <= fine.min(axis=(1, 2), keepdims=True) + 1e-4
        soft = np.array([cover != BARE for cover in covers])
        if soft.any():
            sunk = to_pixels @ self._bare.displacement_mm(on_pad[soft]) @ to_pixels.T
            fine = fine.copy()
            fine[soft] = np.clip(indentation_mm[soft, None, None] - sunk, 0, indentation_mm[soft, None, None])
        return fine, touching

    def _coarse(self, loads: NDArray[np.float32]) -> NDArray[np.float32]:
        """Means of loads (n, 3, size, size) on the traction's grid; what acts beyond it is the outermost pixels'."""
        count = USPA44.rows * TRACTION_SCALE
        side = self._pattern_cells // count
        owner = np.clip((np.arange(self.size) - (self.size - self._pattern_cells) // 2) // side, 0, count - 1)
        gather = (owner == np.arange(count)[:, None]).astype(np.float32) / side
        return gather @ loads @ gather.T

    def _solver(self, cover: Cover) -> ContactSolver:
        def extra(q_per_mm: NDArray[np.float64]) -> NDArray[np.float64]:
            compliance = surface_compliance(self.pad.layer, q_per_mm)
            if cover.cloth_mm:
                compliance = compliance * _spread(cover, q_per_mm) ** 2 + cover.cloth_mm / cover.cloth_mpa
            if cover.soft_mpa:  # as thick as the pad is wide, incompressible
                compliance = compliance + 0.5 / (cover.soft_mpa * np.hypot(q_per_mm, 2 / USPA44.width_mm))
            return compliance

        return ContactSolver(self.pad.layer, self.size, self.cell_mm, compliance=extra, sides=self.pad.sides)

    def _passed_on(self, cover: Cover, pressure: NDArray[np.float32]) -> NDArray[np.float32]:
        """Pressure on the pad (size, size) under a cloth that spreads that on its upper side."""
        if not cover.cloth_mm:
            return pressure
        padded = 2 * self.size
        q = 2 * np.pi * np.fft.fftfreq(padded, self.cell_mm)
        spectrum = np.fft.rfft2(pressure, s=(padded, padded))
        q_x = 2 * np.pi * np.fft.rfftfreq(padded, self.cell_mm)
        spread = np.fft.irfft2(spectrum * _spread(cover, np.hypot(q_x[None], q[:, None])), s=(padded, padded))
        return np.maximum(spread[: self.size, : self.size], 0).astype(np.float32)


def _spread(cover: Cover, q_per_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of a pressure wave that comes through a cloth: (1 + q t) exp(-q t).

    Source: Johnson 1985, Eq. 2.23, the pressure at a depth in a half-space.
    """
    depth = q_per_mm * cover.cloth_mm
    return (1 + depth) * np.exp(-depth)


def _between(size: int, pixels: int) -> NDArray[np.float32]:
    """Weights (pixels, size) that interpolate linearly from cells to pixels of half a cell, both centred on the pad."""
    place = ((np.arange(pixels) - (pixels - 1) / 2) / 2 + (size - 1) / 2)[:, None]
    return np.maximum(1 - np.abs(place - np.arange(size)), 0).astype(np.float32)
