"""Magnets of the pad over the Hall chips of the board: from the magnets' movement to the field at the chips.

Every chip senses every magnet, so cross-talk between taxels is in the sum and needs no model of its own.
Magnets are axial dipoles, north up: pressed down, z rises; moved to +x, x rises. x to the right, y down the rows, z up.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import SensorGeometry

MOVEMENT: Final = ("right_mm", "back_mm", "down_mm", "lean_x", "lean_y")
"""Components of a magnet's movement: along x and y, towards the board, and the slopes dx/dz and dy/dz of its axis."""
_DOWN: Final = MOVEMENT.index("down_mm")


@dataclass(frozen=True, slots=True)
class Magnet:
    """Small axial cylinder in the pad and the chip under it; no data sheet states their sizes."""

    diameter_mm: float = 1.0
    thickness_mm: float = 0.5
    remanence_t: float = 1.2  # common neodymium
    height_mm: float = 2.5  # of the magnet's centre above the board
    chip_height_mm: float = 0.5  # of the sensitive spot above the board, under the magnet's centre

    @property
    def gap_mm(self) -> float:
        """Distance from the magnet's centre to the chip at rest, in [mm]."""
        return self.height_mm - self.chip_height_mm

    @property
    def clearance_mm(self) -> float:
        """Distance from the magnet's lower face to the chip at rest, in [mm], its largest possible movement down."""
        return self.gap_mm - self.thickness_mm / 2

    @property
    def shape(self) -> float:
        """Jeffery's factor of a spheroid of its aspect a = thickness / diameter: (a^2 - 1)/(a^2 + 1)."""
        aspect = self.thickness_mm / self.diameter_mm
        return (aspect**2 - 1) / (aspect**2 + 1)

    @property
    def strength_mt_mm3(self) -> float:
        """Strength k of the far field, in [mT mm^3]: on the axis B = 2 k / distance^3."""
        volume_mm3 = np.pi / 4 * self.diameter_mm**2 * self.thickness_mm
        return 1e3 * self.remanence_t * volume_mm3 / (4 * np.pi)


Vectors = tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]  # x, y and z


def dipole_mt(magnet: Magnet, away_mm: Vectors, axis: Vectors) -> Vectors:
    """Return the flux density of dipoles, B = k (3 (m r) r / r^5 - m / r^3), in [mT], at r from the magnets' centres.

    k is the magnet's strength, m are unit vectors from south to north. Source: Jackson, Eq. 5.56.
    """
    (x, y, z), (m_x, m_y, m_z) = away_mm, axis
    square = x * x + y * y + z * z
    fall = magnet.strength_mt_mm3 / (square * np.sqrt(square))
    pull = 3 * fall * (x * m_x + y * m_y + z * m_z) / square
    return pull * x - fall * m_x, pull * y - fall * m_y, pull * z - fall * m_z


class MagnetArray:
    """One magnet over one chip per taxel.

    `rest` is the place and lean of each magnet at rest, as a movement (taxels, 5), `moments` (taxels,) a share of the
    nominal one's.
    """

    def __init__(
        self,
        geometry: SensorGeometry,
        magnet: Magnet,
        rest: NDArray[np.floating] | None = None,
        moments: NDArray[np.floating] | float = 1.0,
    ) -> None:
        self.magnet = magnet
        # Nearer to its chip, in diameters, a dipole is off by more than 30 % (docs/decisions.md).
        self._least_clear_mm = 0.75 * magnet.diameter_mm
        nowhere = np.zeros((geometry.taxel_count, len(MOVEMENT)))
        self._rest = (nowhere if rest is None else rest).astype(np.float32)
        self._moments = np.asarray(moments, dtype=np.float32)
        self._check_clear(magnet.clearance_mm - float(self._rest[:, _DOWN].max()))
        centres_mm = geometry.taxel_centres_mm().T
        # (2, chips, magnets): from each magnet to each chip, at rest.
        self._apart_mm = (centres_mm[:, :, None] - centres_mm[:, None, :]).astype(np.float32)

    def change_mt(self, movement: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the change of the field at the chips (..., taxels, 3), in [mT], by MOVEMENT (..., taxels, 5)."""
        rest = self._rest.astype(movement.dtype)
        placed = movement + rest
        self._check_clear(self.magnet.clearance_mm - float(placed[..., _DOWN].max(initial=0.0)))
        return self.flux_mt(placed) - self.flux_mt(rest)

    def _check_clear(self, clear_mm: float) -> None:
        if not clear_mm >= self._least_clear_mm:
            raise ValueError(
                f"a magnet is {clear_mm:.3g} mm above its chip, expected {self._least_clear_mm:.3g} mm or more: press "
                "less hard, or take a stiffer layer"
            )

    def flux_mt(self, movement: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the flux density of all magnets at each chip, (..., taxels, 3) in [mT], from (..., taxels, 5)."""
        right, back, down, lean_x, lean_y = np.moveaxis(movement, -1, 0)[..., None, :]
        upright = 1 / np.sqrt(1 + lean_x**2 + lean_y**2)
        gap_mm = down.dtype.type(self.magnet.gap_mm)
        away_mm = (self._apart_mm[0] - right, self._apart_mm[1] - back, down - gap_mm)
        flux = dipole_mt(self.magnet, away_mm, (lean_x * upright, lean_y * upright, upright))
        return np.stack([(part * self._moments).sum(axis=-1) for part in flux], axis=-1, dtype=movement.dtype)
