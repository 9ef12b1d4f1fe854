"""Simulated skin: from pressure and traction on the pad to counts of the taxels, zeroed and clean.

Under each taxel a magnet sits in the pad, and a Hall chip on the board below it. Loads move and tilt the magnets with
the material around them, linearly (the pad is linear); the field at the chips depends on that nonlinearly. One factor,
counts per mT, the same on all axes, is set by the data sheet's newtons per count.
"""

from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import SensorGeometry
from train.physics.elastic_layer import Layer
from train.physics.magnet_response import pressure_response, traction_response
from train.physics.magnets import Magnet, MagnetArray
from train.physics.side_correction import FreeSides

NEWTONS_PER_COUNT_Z: Final = 0.00085
IN_PLANE_SHARE: Final = 0.4
"""Share of the magnets' in-plane movement that friction leaves.

The contact is solved without friction, so that the simulated pad is squeezed out from under a figure that in reality
holds it. Recordings of grips have an in-plane to normal ratio of .18 to .26; without this factor the simulated one is
.57.
"""

_CALIBRATION_N: Final = 1.0


def on_pad(geometry: SensorGeometry, size: int, cell_mm: float) -> NDArray[np.bool_]:
    """Return which cells of a square grid centred on the pad lie on it, (size, size)."""
    along_mm = np.abs(np.arange(size) - (size - 1) / 2) * cell_mm
    square = geometry.width_mm == geometry.height_mm
    across, down = (along_mm < (np.inf if square else side / 2) for side in (geometry.width_mm, geometry.height_mm))
    return down[:, None] & across


class Skin:
    """Readings of a sensor whose pad is pressed.

    Args:
        geometry: the taxels.
        layer: the pad.
        size: cells along a side of the pressure grid.
        cell_mm: their size, in [mm].
        magnet: of every taxel.
        in_plane_share: factor on the magnets' in-plane movement under pressure; movement under traction is not scaled.
        rest: place and lean of each magnet, see train.physics.magnets.MagnetArray.
        moments: of each magnet, see train.physics.magnets.MagnetArray.
        counts_per_newton: of the sum of z under an even load.
        sides: the pad's free sides; None for an infinite layer.

    Attributes:
        counts_per_mt: of every chip and axis.
    """

    def __init__(
        self,
        geometry: SensorGeometry,
        layer: Layer,
        size: int,
        cell_mm: float,
        magnet: Magnet | None = None,
        in_plane_share: float = IN_PLANE_SHARE,
        rest: NDArray[np.floating] | None = None,
        moments: NDArray[np.floating] | None = None,
        counts_per_newton: float = 1 / NEWTONS_PER_COUNT_Z,
        sides: FreeSides | None = None,
    ) -> None:
        magnet = Magnet() if magnet is None else magnet
        if magnet.height_mm + magnet.thickness_mm / 2 > layer.thickness_mm:
            raise ValueError(
                f"a magnet {magnet.thickness_mm} mm thick at {magnet.height_mm} mm does not fit into a layer of "
                f"{layer.thickness_mm} mm"
            )
        self.geometry = geometry
        self.size = size
        self._pad = (geometry, layer, size, cell_mm, magnet)
        self._magnets = MagnetArray(geometry, magnet, rest, moments)
        response = pressure_response(geometry, layer, size, cell_mm, magnet)
        if sides is not None:
            cells_mm = (np.arange(size) - (size - 1) / 2) * cell_mm
            added = sides.movement(layer, cells_mm, geometry.taxel_centres_mm())
            response += added.reshape(response.shape) * cell_mm**2
        response[:, :2] *= in_plane_share
        self._response = response.astype(np.float32)
        # Calibrated as a user would: the sum of z per newton, here under an even load on the whole pad.
        loaded = on_pad(geometry, size, cell_mm)
        even_mpa = loaded * (_CALIBRATION_N / ((size * cell_mm) ** 2 * loaded.mean()))
        z_sum_mt = self._magnets.change_mt(self.movement(even_mpa))[:, 2].sum()
        self.counts_per_mt = float(_CALIBRATION_N * counts_per_newton / z_sum_mt)

    @cached_property
    def _traction_response(self) -> NDArray[np.float32]:
        """MOVEMENT per traction to the right and back in each cell, (taxels, 5, 2, cells); computed on first use."""
        return traction_response(*self._pad).astype(np.float32)

    def movement(
        self, pressure_mpa: NDArray[np.floating], traction_mpa: NDArray[np.floating] | None = None
    ) -> NDArray[np.floating]:
        """Return the movement of the magnets under loads on the pad: (..., taxels, 5), train.physics.magnets.MOVEMENT.

        Args:
            pressure_mpa: (..., size, size), in [MPa].
            traction_mpa: on the pad's surface, to the right and back, (..., 2, size, size), in [MPa]; none if None.
        """
        if pressure_mpa.shape[-2:] != (self.size, self.size):
            raise ValueError(f"pressures of shape {pressure_mpa.shape}, expected (..., {self.size}, {self.size})")
        lead, cells = pressure_mpa.shape[:-2], self.size**2
        moved = pressure_mpa.reshape(-1, cells) @ self._response.reshape(-1, cells).T
        if traction_mpa is not None:
            if traction_mpa.shape != (*lead, 2, self.size, self.size):
                raise ValueError(
                    f"tractions of shape {traction_mpa.shape} with pressures of shape {pressure_mpa.shape}, expected "
                    f"{(*lead, 2, self.size, self.size)}: two for every pressure, to the right and back"
                )
            moved += traction_mpa.reshape(-1, 2 * cells) @ self._traction_response.reshape(-1, 2 * cells).T
        return moved.reshape(*lead, *self._response.shape[:2])

    def frames(
        self, pressure_mpa: NDArray[np.floating], traction_mpa: NDArray[np.floating] | None = None
    ) -> NDArray[np.float32]:
        """Return readings (n, F, 3, rows, cols) in counts, zeroed and clean, of loads on the pad.

        Args:
            pressure_mpa: (n, F, size, size), in [MPa].
            traction_mpa: on the pad's surface, to the right and back, (n, F, 2, size, size), in [MPa]; none if None.
        """
        return self._counts(self.movement(pressure_mpa, traction_mpa))

    def flat_frames(
        self, unit_pressure_mpa: NDArray[np.floating], indentation_mm: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """Return the readings of taps on flat surfaces, where pressure is proportional to the indentation.

        Args:
            unit_pressure_mpa: (n, size, size), of an indentation of 1 mm, in [MPa].
            indentation_mm: (n, F), in [mm].

        Returns:
            (n, F, 3, rows, cols) in counts, zeroed and clean.
        """
        unit = self.movement(unit_pressure_mpa)
        return self._counts(unit[:, None] * indentation_mm[:, :, None, None].astype(unit.dtype))

    def _counts(self, movement: NDArray[np.floating]) -> NDArray[np.float32]:
        rows, cols = self.geometry.rows, self.geometry.cols
        # Every frame is computed: interpolation by a polynomial through five depths took 0.09 ms a tap, this 0.13 ms.
        counts = np.empty((*movement.shape[:2], 3, rows, cols), dtype=np.float32)
        for tap, moved in zip(counts, movement, strict=True):  # one tap at a time stays in the cache
            changed = self._magnets.change_mt(moved) * moved.dtype.type(self.counts_per_mt)
            tap[:] = changed.swapaxes(1, 2).reshape(tap.shape)
        return counts
