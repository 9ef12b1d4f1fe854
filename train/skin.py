"""The simulated skin: pressure on the pad to counts of the taxels, zeroed and clean.

Under each taxel a magnet sits in the pad, and a Hall chip on the board below it. Pressure moves and tilts the
magnets with the material around them, in proportion (the pad is linear); the field at the chips follows, and is not in
proportion. One factor, counts per mT, the same on all axes, is set by the data sheet's newtons per count.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.geometry import SensorGeometry
from train.layer import Layer, inner_displacement
from train.magnets import MOVEMENT, Magnet, MagnetArray
from train.physics.free_sides import FreeSides

NEWTONS_PER_COUNT_Z: Final = 0.00085
IN_PLANE_SHARE: Final = 0.4
"""What friction leaves of the magnets' in-plane movement: the contact is solved without, and the pad is squeezed out
from under a figure that in truth holds it. Recordings of grips show an in-plane to normal ratio of .18 to .26; without
this factor the simulated one is .57."""

_CALIBRATION_N: Final = 1.0
_SLOPE_STEP_MM: Final = 1e-3


class Skin:
    """Readings of a sensor whose pad is pressed.

    Args:
        geometry: the taxels.
        layer: the pad.
        size: cells along a side of the pressure grid.
        cell_mm: their size, in [mm].
        magnet: of every taxel.
        field: how the magnets' field is worked out, a name in train.magnets.FIELDS.
        in_plane_share: factor on the magnets' in-plane movement.
        sides: the pad's free sides; without, it goes on for ever.

    Attributes:
        counts_per_mt: of every chip and axis.

    Raises:
        ValueError: the magnets do not fit into the layer, or no field of that name.
    """

    def __init__(
        self,
        geometry: SensorGeometry,
        layer: Layer,
        size: int,
        cell_mm: float,
        magnet: Magnet | None = None,
        field: str = "dipole",
        in_plane_share: float = IN_PLANE_SHARE,
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
        self._magnets = MagnetArray(geometry, magnet, field)
        response = _magnet_response(geometry, layer, size, cell_mm, magnet)
        if sides is not None:
            cells_mm = (np.arange(size) - (size - 1) / 2) * cell_mm
            added = sides.movement(layer, cells_mm, geometry.taxel_centres_mm())
            response += added.reshape(response.shape) * cell_mm**2
        response[:, :2] *= in_plane_share
        self._response = response.astype(np.float32)
        # Calibrated as a user would: the sum of z per newton, here under an even load on the whole pad.
        even_mpa = np.full((size, size), _CALIBRATION_N / (size * cell_mm) ** 2)
        z_sum_mt = self._magnets.change_mt(self.movement(even_mpa))[:, 2].sum()
        self.counts_per_mt = float(_CALIBRATION_N / NEWTONS_PER_COUNT_Z / z_sum_mt)

    def movement(self, pressure_mpa: NDArray[np.floating]) -> NDArray[np.floating]:
        """How pressures (..., size, size) in [MPa] move the magnets: (..., taxels, 5), train.magnets.MOVEMENT.

        Raises:
            ValueError: the pressures are on another grid.
        """
        if pressure_mpa.shape[-2:] != (self.size, self.size):
            raise ValueError(f"pressures of shape {pressure_mpa.shape}, expected (..., {self.size}, {self.size})")
        lead = pressure_mpa.shape[:-2]
        moved = pressure_mpa.reshape(-1, self.size**2) @ self._response.reshape(-1, self.size**2).T
        return moved.reshape(*lead, *self._response.shape[:2])

    def frames(self, pressure_mpa: NDArray[np.floating]) -> NDArray[np.float32]:
        """Readings (n, F, 3, rows, cols) in counts, zeroed and clean, of pressures (n, F, size, size) in [MPa].

        Raises:
            ValueError: the pressures are on another grid, or press a magnet through its chip.
        """
        return self._counts(self.movement(pressure_mpa))

    def flat_frames(
        self, unit_pressure_mpa: NDArray[np.floating], indentation_mm: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """The same for taps on flat surfaces, where pressure is in proportion to the indentation.

        Args:
            unit_pressure_mpa: (n, size, size), of an indentation of 1 mm, in [MPa].
            indentation_mm: (n, F), in [mm].

        Returns:
            (n, F, 3, rows, cols) in counts, zeroed and clean.

        Raises:
            ValueError: the pressures are on another grid, or press a magnet through its chip.
        """
        unit = self.movement(unit_pressure_mpa)
        return self._counts(unit[:, None] * indentation_mm[:, :, None, None].astype(unit.dtype))

    def _counts(self, movement: NDArray[np.floating]) -> NDArray[np.float32]:
        rows, cols = self.geometry.rows, self.geometry.cols
        # Every frame is worked out: through five depths and a polynomial it took 0.09 ms a tap, thus 0.13 ms.
        counts = np.empty((*movement.shape[:2], 3, rows, cols), dtype=np.float32)
        for tap, moved in zip(counts, movement, strict=True):  # one tap at a time stays in the cache
            changed = self._magnets.change_mt(moved) * moved.dtype.type(self.counts_per_mt)
            tap[:] = changed.swapaxes(1, 2).reshape(tap.shape)
        return counts


def _magnet_response(
    geometry: SensorGeometry, layer: Layer, size: int, cell_mm: float, magnet: Magnet
) -> NDArray[np.float64]:
    """MOVEMENT of each magnet per pressure in each cell, (taxels, 5, cells) in [mm/MPa] and [1/MPa].

    By Fourier sums over a domain four pads wide, straight at the magnets' places, which lie between cells.

    The magnet is stiff and turns with the pad around it as a spheroid of its aspect a = thickness / diameter does:
    its axis leans by (1 + L)/2 du_x/dz - (1 - L)/2 du_z/dx, L = (a^2 - 1)/(a^2 + 1). A flat disc (L = -1) follows the
    slope of its plane, a sphere (L = 0) half the curl, a needle (L = 1) the material along it.

    Source: Jeffery 1922, the turning of a spheroid in Stokes flow, whose equations an incompressible solid shares.
    """
    padded = 4 * size
    q_x = 2 * np.pi * np.fft.fftfreq(padded, cell_mm)[None, :]
    q_y = 2 * np.pi * np.fft.fftfreq(padded, cell_mm)[:, None]
    q = np.hypot(q_x, q_y)
    down, along = inner_displacement(layer, q, magnet.height_mm)
    along_above = inner_displacement(layer, q, magnet.height_mm + _SLOPE_STEP_MM)[1]
    along_below = inner_displacement(layer, q, magnet.height_mm - _SLOPE_STEP_MM)[1]
    aspect = magnet.thickness_mm / magnet.diameter_mm
    shape = (aspect**2 - 1) / (aspect**2 + 1)
    lean = (1 + shape) / 2 * (along_above - along_below) / (2 * _SLOPE_STEP_MM) + (1 - shape) / 2 * q * down
    turn_along, turn_lean = (
        np.divide(1j * part, q, out=np.zeros_like(q, dtype=complex), where=q > 0) for part in (along, lean)
    )
    transfers = (turn_along * q_x, turn_along * q_y, down, turn_lean * q_x, turn_lean * q_y)
    cells_mm = (np.arange(size) - (size - 1) / 2) * cell_mm
    response = np.empty((geometry.taxel_count, len(MOVEMENT), size * size))
    for taxel, (x_mm, y_mm) in enumerate(geometry.taxel_centres_mm()):
        wave_x = np.exp(1j * q_x.T * (x_mm - cells_mm))  # (padded, size)
        wave_y = np.exp(1j * q_y * (y_mm - cells_mm))  # (padded, size)
        for axis, transfer in enumerate(transfers):
            response[taxel, axis] = (wave_y.T @ transfer @ wave_x).real.ravel() / padded**2
    return response
