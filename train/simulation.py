"""Taps on the simulated sensor: pose of the pad on a surface to readings and truth.

The surfaces are flat, so pressure, readings and pattern are linear in the indentation: a tap is solved once,
for an indentation of 1 mm, and scaled to any force.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.geometry import USPA44, SensorGeometry
from train.contact import ContactSolver
from train.depth import DepthMap, Pose, depth_image, depth_map
from train.layer import Layer
from train.skin import Skin
from train.surfaces import FIGURE_HEIGHT_MM, surface_mesh
from train.tpsf import tpsf_pattern

MAX_INDENTATION_MM: Final = 0.5
"""A tap ends here if its set force is not reached: beyond a tenth of the layer it is no longer linear."""


@dataclass(frozen=True, slots=True)
class UnitTaps:
    """Taps solved at an indentation of 1 mm.

    Attributes:
        readings: (n, 3, rows, cols) counts per mm, zeroed, without nuisances.
        force_n_per_mm: (n,), in [N/mm].
        patterns: (n, H, W), mm of deformation per mm of indentation.
    """

    readings: NDArray[np.float32]
    force_n_per_mm: NDArray[np.float32]
    patterns: NDArray[np.float32]

    def indentation_mm(self, force_n: NDArray[np.floating]) -> NDArray[np.float32]:
        """Indentation at which each tap ends: at its set force or at MAX_INDENTATION_MM, in [mm]."""
        return np.minimum(force_n / self.force_n_per_mm, MAX_INDENTATION_MM).astype(np.float32)


@dataclass
class SimulatedSensor:
    """One sensor model tapping the 18 surfaces.

    Attributes:
        geometry: the taxels.
        layer: the pad.
        scale: pattern pixels per taxel pitch; the contact is solved on the same cells.
    """

    geometry: SensorGeometry = USPA44
    layer: Layer = field(default_factory=Layer)
    scale: int = 10
    _maps: dict[str, DepthMap] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        self._cell_mm = self.geometry.pixel_pitch_mm(self.scale)
        # The pad is wider than the pattern; as many whole cells as fit on it, with the pattern in the middle.
        pattern_px = self.geometry.rows * self.scale
        self._margin_px = int((self.geometry.width_mm / self._cell_mm - pattern_px) // 2)
        self._size = pattern_px + 2 * self._margin_px
        self._solver = ContactSolver(self.layer, self._size, self._cell_mm)
        self._skin = Skin(self.geometry, self.layer, self._size, self._cell_mm)

    def tap(self, surfaces: list[str], poses: list[Pose]) -> UnitTaps:
        """Tap surfaces at poses, one pose each.

        Raises:
            ValueError: no surface of a name, or a pose at which the pad meets no figure.
        """
        depth_mm = np.stack(
            [
                depth_image(self._map(name), pose, self._size, self._cell_mm)
                for name, pose in zip(surfaces, poses, strict=True)
            ]
        )
        off_figure = depth_mm.min(axis=(1, 2)) >= FIGURE_HEIGHT_MM
        if off_figure.any():
            first = int(np.argmax(off_figure))
            raise ValueError(f"the pad misses the figure of surface {surfaces[first]!r} at {poses[first]}")
        contact = self._solver.solve(depth_mm)
        window = slice(self._margin_px, self._size - self._margin_px)
        touching = contact.pressure_mpa[:, window, window] > 0
        unit = np.ones(len(poses), dtype=np.float32)
        return UnitTaps(
            readings=np.ascontiguousarray(self._skin.deform(contact.pressure_mpa)),
            force_n_per_mm=contact.pressure_mpa.sum(axis=(1, 2)) * np.float32(self._cell_mm**2),
            patterns=tpsf_pattern(touching, unit, self._cell_mm),
        )

    def _map(self, name: str) -> DepthMap:
        if name not in self._maps:
            self._maps[name] = depth_map(surface_mesh(name))
        return self._maps[name]
