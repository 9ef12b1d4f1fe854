"""Taps on the simulated sensor: from poses of the pad on surfaces to clean readings and truth.

On a flat surface pressure is linear in the indentation: one solution serves all frames of a tap. On a curved one the
contact grows: each frame is solved, after a search for the depth at which the tap reaches its force.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from train.physics.contact import REACH, ContactSolver
from train.physics.curved_patterns import heights_pattern
from train.physics.elastic_layer import Layer
from train.physics.taxel_response import Skin, on_pad
from train.physics.tpsf import tpsf_pattern
from train.surfaces.depth_image import NOTHING_MM, Footprints, Pose, Relief, footprints
from train.surfaces.named_surfaces import is_flat, surface_mesh

MAX_INDENTATION_MM: Final = 0.5
"""Largest indentation, in [mm], where a tap ends below its set force: beyond a tenth of the layer it is not linear."""
FRAMES: Final = 16
"""Frames of a tap; frame i is at (i + 1) / FRAMES of its last indentation."""
FINE_SCALE: Final = 20
"""Pattern pixels per pitch at which truth is computed."""
_CELLS_PER_PITCH: Final = 10
_SHARES: Final = (np.arange(FRAMES) + 1) / FRAMES
_LEVEL_MM: Final = 1e-3
"""Tolerance of flat surfaces, in [mm], as in train.surfaces.named_surfaces.is_flat."""
_DROP: Final = 2.0
"""Depth in indentations from which a surface counts as steep: its edge then follows from its depth image alone."""
_FORCE_ERROR: Final = 0.003
_EXPONENT: Final = 1.5
"""Initial exponent of force against depth: that of a sphere on a thick layer."""
_MAX_GUESSES: Final = 30


@dataclass(frozen=True, slots=True)
class Taps:
    """Clean taps, without nuisances: n of them, m with truth.

    Attributes:
        counts: (n, FRAMES, 3, rows, cols), zeroed.
        force_n: (n, FRAMES), in [N].
        indentation_mm: (n, FRAMES), in [mm].
        patterns: (m, L, H, W) at FINE_SCALE, in [mm]. L = 1 if all surfaces are flat: the last frame's, while the
        others
            are proportional to their indentation. Else L = FRAMES.
        touching: (m, L, H, W), contact area of the pad.
    """

    counts: NDArray[np.float32]
    force_n: NDArray[np.float32]
    indentation_mm: NDArray[np.float32]
    patterns: NDArray[np.float32]
    touching: NDArray[np.bool_]


class SimulatedSensor:
    """Sensor model that taps surfaces.

    Args:
        geometry: the taxels.
        layer: the pad.

    The contact is solved on a square grid as wide as the pad's longer side; where the pad ends before, nothing touches.
    """

    def __init__(self, geometry: SensorGeometry = USPA44, layer: Layer | None = None) -> None:
        layer = Layer() if layer is None else layer
        self.geometry = geometry
        self.cell_mm = geometry.pixel_pitch_mm(_CELLS_PER_PITCH)
        # The pad is wider than the pattern; as many whole cells as fit on it, with the pattern in the middle.
        side = max(geometry.rows, geometry.cols)
        side_mm, pattern_cells = max(geometry.width_mm, geometry.height_mm), side * _CELLS_PER_PITCH
        self.size = pattern_cells + 2 * int((side_mm / self.cell_mm - pattern_cells) // 2)
        self._pixel_mm = geometry.pixel_pitch_mm(FINE_SCALE)
        self._pixels = side * FINE_SCALE
        height, width = geometry.pattern_shape(FINE_SCALE)
        top, left = (self._pixels - height) // 2, (self._pixels - width) // 2
        self._pattern = (..., slice(top, top + height), slice(left, left + width))
        self._on_cells = on_pad(geometry, self.size, self.cell_mm)
        self._on_pixels = on_pad(geometry, self._pixels, self._pixel_mm)
        self._to_pixels = _between(self.size, self.cell_mm, self._pixels, self._pixel_mm)
        self._solver = ContactSolver(layer, self.size, self.cell_mm)
        self._skin = Skin(geometry, layer, self.size, self.cell_mm)

    def tap(
        self,
        surfaces: list[str],
        poses: list[Pose],
        force_n: NDArray[np.floating] | float,
        with_pattern: NDArray[np.bool_] | bool = True,
    ) -> Taps:
        """Tap surfaces at poses, one pose each, until the set force or MAX_INDENTATION_MM, whichever comes first.

        Args:
            surfaces: (n,) names, see train.surfaces.named_surfaces.surface_mesh.
            poses: (n,).
            force_n: set forces, one for all or (n,), in [N].
            with_pattern: True to compute truth, for all or (n,); without it a tap takes less time.

        Raises:
            ValueError: lengths do not fit, a force is not positive, no surface of a name, or nothing under the pad.
        """
        count = len(surfaces)
        if (
            len(poses) != count
            or np.shape(force_n) not in ((), (count,))
            or np.shape(with_pattern) not in ((), (count,))
        ):
            raise ValueError(
                f"{count} surfaces, {len(poses)} poses, forces of shape {np.shape(force_n)}, with_pattern "
                f"{np.shape(with_pattern)}; expected one of each for every tap"
            )
        wanted_n = np.broadcast_to(np.asarray(force_n, dtype=np.float64), count)
        if not (np.isfinite(wanted_n) & (wanted_n > 0)).all():
            raise ValueError(f"set forces of {wanted_n.min()} to {wanted_n.max()} N, expected positive ones")
        known = [_surface(name) for name in surfaces]
        seen = self._within(footprints([relief for relief, _ in known], poses, self.size, self.cell_mm))
        flat = np.array([level for _, level in known], dtype=bool) & self._is_level(seen)
        cover = seen.cover_on(self.size, self.cell_mm, np.flatnonzero(flat), _LEVEL_MM) * self._on_cells
        level = cover.any(axis=(1, 2))  # else what the pad meets is a point that is finer than the samples of a cell
        flat[flat], cover = level, cover[level]
        pattern_of = np.flatnonzero(np.broadcast_to(with_pattern, count))
        maps = 1 if flat.all() else FRAMES
        taps = Taps(
            counts=np.empty((count, FRAMES, *self.geometry.scan_shape), dtype=np.float32),
            force_n=np.empty((count, FRAMES), dtype=np.float32),
            indentation_mm=np.empty((count, FRAMES), dtype=np.float32),
            patterns=np.empty((len(pattern_of), maps, *self.geometry.pattern_shape(FINE_SCALE)), dtype=np.float32),
            touching=np.empty((len(pattern_of), maps, *self.geometry.pattern_shape(FINE_SCALE)), dtype=np.bool_),
        )
        if flat.any():
            self._tap_flat(taps, np.flatnonzero(flat), cover, seen, wanted_n, pattern_of)
        if not flat.all():
            self._tap_curved(taps, np.flatnonzero(~flat), seen, wanted_n, pattern_of)
        return taps

    def _within(self, seen: Footprints) -> Footprints:
        """Return the part of the square's surface under the pad; depth counts from its own highest point.

        Raises:
            ValueError: nothing does at a pose.
        """
        if self._on_cells.all():
            return seen
        depth_mm = np.where(self._on_cells, seen.depth_mm, np.float32(NOTHING_MM))
        low_mm = depth_mm.min(axis=(1, 2))
        if (low_mm >= NOTHING_MM).any():
            raise ValueError("nothing of a surface lies under the pad at a pose; expected poses over it")
        lowered = np.where(depth_mm < NOTHING_MM, depth_mm - low_mm[:, None, None], depth_mm)
        return replace(seen, top_mm=seen.top_mm - low_mm, depth_mm=lowered)

    def _fine_mm(self, seen: Footprints, poses: NDArray[np.integer]) -> NDArray[np.float32]:
        """Depth on the pixels of the truth, those beyond the pad included."""
        depth_mm = seen.depth_on(self._pixels, self._pixel_mm, poses)
        return np.where(self._on_pixels, depth_mm, np.float32(NOTHING_MM))

    @staticmethod
    def _is_level(seen: Footprints) -> NDArray[np.bool_]:
        """Return True for poses (n,) at which a press reaches only one plane; deeper parts do not count."""
        within = (seen.depth_mm > _LEVEL_MM) & (seen.depth_mm <= MAX_INDENTATION_MM)
        return np.logical_not(within.any(axis=(1, 2)))

    def _tap_flat(
        self,
        taps: Taps,
        which: NDArray[np.int64],
        cover: NDArray[np.float32],
        seen: Footprints,
        wanted_n: NDArray[np.float64],
        pattern_of: NDArray[np.int64],
    ) -> None:
        """Compute the taps on flat surfaces, which cover these shares of the cells."""
        unit = self._solver.solve(np.where(cover > 0, 0, NOTHING_MM).astype(np.float32), cover=cover)
        end_mm = np.minimum(wanted_n[which] / unit.force_n, MAX_INDENTATION_MM)
        indentation_mm = end_mm[:, None] * _SHARES
        taps.indentation_mm[which] = indentation_mm
        taps.force_n[which] = unit.force_n[:, None] * indentation_mm
        taps.counts[which] = self._skin.flat_frames(unit.pressure_mpa, indentation_mm)
        rows = np.flatnonzero(np.isin(pattern_of, which))
        poses = pattern_of[rows]
        touching = self._fine_mm(seen, poses) <= _LEVEL_MM
        pattern = tpsf_pattern(touching, taps.indentation_mm[poses, -1], self._pixel_mm)
        # A mixed batch has a map for each frame; alone, the last one stands for all.
        shares = _SHARES[-taps.patterns.shape[1] :].astype(np.float32)
        taps.patterns[rows] = pattern[self._pattern][:, None] * shares[:, None, None]
        taps.touching[rows] = touching[self._pattern][:, None]

    def _tap_curved(
        self,
        taps: Taps,
        which: NDArray[np.int64],
        seen: Footprints,
        wanted_n: NDArray[np.float64],
        pattern_of: NDArray[np.int64],
    ) -> None:
        """Compute the taps on curved surfaces."""
        depth_mm = seen.depth_mm[which]
        end_mm, pressure_mpa = self._press_to(depth_mm, wanted_n[which])
        indentation_mm = end_mm[:, None] * _SHARES
        every = np.repeat(np.arange(len(which)), FRAMES)
        pressed = self._press(depth_mm[every], indentation_mm.reshape(-1), pressure_mpa[every])
        frames_mpa = pressed.reshape(len(which), FRAMES, self.size, self.size)
        taps.indentation_mm[which] = indentation_mm
        taps.force_n[which] = frames_mpa.sum(axis=(2, 3)) * self.cell_mm**2
        taps.counts[which] = self._skin.frames(frames_mpa)
        rows = np.flatnonzero(np.isin(pattern_of, which))
        fine_mm = self._fine_mm(seen, pattern_of[rows])
        for row, fine, tap in zip(rows, fine_mm, np.searchsorted(which, pattern_of[rows]), strict=True):
            frames_mm = indentation_mm[tap].astype(np.float32)
            deep = np.tile(fine, (FRAMES, 1, 1))
            touching = self._touching(frames_mpa[tap], depth_mm[tap], deep, frames_mm[:, None, None])
            taps.touching[row] = touching[self._pattern]
            taps.patterns[row] = heights_pattern(deep, touching, frames_mm, self._pixel_mm)[self._pattern]

    def _press_to(
        self, depth_mm: NDArray[np.float32], wanted_n: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Return indentations (k,) that reach the set forces, or the largest one, and the pressures there.

        Force grows with depth about as a power of it: the next guess lies on the power law through the nearest
        depths that were too deep and too shallow.
        """
        deep_mm = np.full(len(depth_mm), MAX_INDENTATION_MM)
        pressure_mpa = self._press(depth_mm, deep_mm)
        deep_n = pressure_mpa.sum(axis=(1, 2)) * self.cell_mm**2
        end_mm = deep_mm.copy()
        shallow_mm, shallow_n = np.zeros_like(deep_mm), np.zeros_like(deep_mm)
        open_ = np.flatnonzero(deep_n > wanted_n * (1 + _FORCE_ERROR))
        for _ in range(_MAX_GUESSES):
            if len(open_) == 0:
                break
            low_mm, high_mm = shallow_mm[open_], deep_mm[open_]
            with np.errstate(divide="ignore", invalid="ignore"):
                power = np.log(high_mm / low_mm) / np.log(deep_n[open_] / shallow_n[open_])
            power = np.where(shallow_n[open_] > 0, power, 1 / _EXPONENT)
            guess_mm = high_mm * (wanted_n[open_] / deep_n[open_]) ** power
            guess_mm = np.where((guess_mm > low_mm) & (guess_mm < high_mm), guess_mm, (low_mm + high_mm) / 2)
            found = self._press(depth_mm[open_], guess_mm, pressure_mpa[open_])
            force_n = found.sum(axis=(1, 2)) * self.cell_mm**2
            pressure_mpa[open_], end_mm[open_] = found, guess_mm
            over = force_n > wanted_n[open_]
            deep_mm[open_[over]], deep_n[open_[over]] = guess_mm[over], force_n[over]
            shallow_mm[open_[~over]], shallow_n[open_[~over]] = guess_mm[~over], force_n[~over]
            open_ = open_[np.abs(force_n / wanted_n[open_] - 1) > _FORCE_ERROR]
        return end_mm, pressure_mpa

    def _press(
        self,
        depth_mm: NDArray[np.float32],
        indentation_mm: NDArray[np.float64],
        start_mpa: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """Return pressures of curved surfaces; zero until the tip, between cells, brings a cell into contact."""
        pressure_mpa = np.zeros(depth_mm.shape, dtype=np.float32)
        reached = np.flatnonzero(depth_mm.min(axis=(1, 2)) < indentation_mm)
        if len(reached):
            start = None if start_mpa is None else start_mpa[reached]
            pressure_mpa[reached] = self._solver.solve(
                depth_mm[reached], indentation_mm[reached], start_mpa=start
            ).pressure_mpa
        return pressure_mpa

    def _touching(
        self,
        pressure_mpa: NDArray[np.float32],
        depth_mm: NDArray[np.float32],
        fine_mm: NDArray[np.float32],
        indentation_mm: NDArray[np.float32],
    ) -> NDArray[np.bool_]:
        """Return the contact area on the pixels of the truth (F, H, W), from pressure and gap on the cells.

        A cell's own deflection under its pressure, less its gap, is positive inside a contact and negative outside;
        the contact's edge is where it passes through zero between the cells' centres.
        """
        gap_mm = self._solver.displacement_mm(pressure_mpa) - (indentation_mm - depth_mm)
        closeness_mm = pressure_mpa * np.float32(self._solver.cell_compliance_mm_per_mpa) - gap_mm
        closeness_mm = np.where(depth_mm < _DROP * indentation_mm, closeness_mm, np.minimum(pressure_mpa, 0))
        close_mm = self._to_pixels @ closeness_mm @ self._to_pixels.T
        return (close_mm > 0) & (fine_mm < REACH * indentation_mm)


def _between(size: int, cell_mm: float, pixels: int, pixel_mm: float) -> NDArray[np.float32]:
    """Return weights (pixels, size) that interpolate linearly from cells to pixels, both centred on the pad."""
    place = ((np.arange(pixels) - (pixels - 1) / 2) * pixel_mm / cell_mm + (size - 1) / 2)[:, None]
    return np.maximum(1 - np.abs(place - np.arange(size)), 0).astype(np.float32)


@lru_cache(maxsize=64)
def _surface(name: str) -> tuple[Relief, bool]:
    """Return a surface as a relief, and True if it is flat."""
    mesh = surface_mesh(name)
    return Relief(name, mesh), is_flat(mesh)
