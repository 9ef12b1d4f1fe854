"""Simulated skin: from pressure and traction on the pad to counts of the taxels, zeroed and clean.

Under each taxel a magnet sits in the pad, and a Hall chip on the board below it. Loads move and tilt the magnets with
the material around them, linearly (the pad is linear): Fourier sums at the magnets' places, over a domain four pads
wide. The field at the chips depends on that nonlinearly. One factor, counts per mT, is the same on all axes.

A magnet is stiff and turns with the pad around it like a spheroid of its aspect a = thickness / diameter: its axis
leans by (1 + L)/2 du_x/dz - (1 - L)/2 du_z/dx, with L = (a^2 - 1)/(a^2 + 1). A flat disc (L = -1) follows the slope of
its plane, a sphere (L = 0) half the curl, a needle (L = 1) the material along it.

Source: Jeffery 1922, the turning of a spheroid in Stokes flow, whose equations are those of an incompressible solid.
"""

from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import SensorGeometry
from train.physics.elastic_layer import Layer, inner_displacement, inner_tangential, side_movement
from train.physics.magnets import MOVEMENT, Magnet, MagnetArray
from train.physics.pad_draws import Pad

_PADS_WIDE: Final = 4
_SLOPE_STEP_MM: Final = 1e-3
_EVEN, _ODD = 0, 1

_Array = NDArray[np.float64]
_Transfer = tuple[int, int, _Array]  # parity in x and in y, and the amplitudes (q_y, q_x) of its quarter of waves


class Skin:
    """Readings of a sensor whose pad is pressed, by loads on a grid of `size` cells a side of `cell_mm`."""

    def __init__(self, pad: Pad, size: int, cell_mm: float) -> None:
        geometry, layer, magnet = pad.geometry(), pad.layer, pad.magnet
        self._grid = (geometry, layer, size, cell_mm, magnet)
        taxels = geometry.taxel_count
        self._magnets = MagnetArray(geometry, magnet, pad.rest(taxels), pad.moments(taxels))
        response = pressure_response(*self._grid)
        if pad.free_sides:
            cells_mm = (np.arange(size) - (size - 1) / 2) * cell_mm
            added = side_movement(pad.free_sides, layer, cells_mm, geometry.taxel_centres_mm())
            response += added.reshape(response.shape) * cell_mm**2
        response[:, :2] *= pad.in_plane_share
        self._response = response.astype(np.float32)
        # Calibrated as a user would: the sum of z per newton, here under 1 N, evenly on the whole pad.
        loaded = on_pad(geometry, size, cell_mm)
        even_mpa = loaded * (1.0 / ((size * cell_mm) ** 2 * loaded.mean()))
        z_sum_mt = self._magnets.change_mt(self.movement(even_mpa))[:, 2].sum()
        self.counts_per_mt = float(pad.counts_per_newton / z_sum_mt)

    @cached_property
    def _traction_response(self) -> NDArray[np.float32]:
        """MOVEMENT per traction to the right and back in each cell, (taxels, 5, 2, cells); computed on first use."""
        return traction_response(*self._grid).astype(np.float32)

    def movement(
        self, pressure_mpa: NDArray[np.floating], traction_mpa: NDArray[np.floating] | None = None
    ) -> NDArray[np.floating]:
        """Return the MOVEMENT (..., taxels, 5) by pressures (..., size, size) and tractions (..., 2, size, size)."""
        taxels, parts, cells = self._response.shape
        moved = pressure_mpa.reshape(-1, cells) @ self._response.reshape(-1, cells).T
        if traction_mpa is not None:
            moved += traction_mpa.reshape(-1, 2 * cells) @ self._traction_response.reshape(-1, 2 * cells).T
        return moved.reshape(*pressure_mpa.shape[:-2], taxels, parts)

    def frames(
        self, pressure_mpa: NDArray[np.floating], traction_mpa: NDArray[np.floating] | None = None
    ) -> NDArray[np.float32]:
        """Return the counts (n, F, 3, rows, cols) of the loads of `movement`, with (n, F) before their other axes."""
        return self.counts(self.movement(pressure_mpa, traction_mpa))

    def counts(self, movement: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return readings (n, F, 3, rows, cols) in counts, zeroed and clean, of magnets moved by (n, F, taxels, 5)."""
        counts = np.empty((*movement.shape[:2], *self._grid[0].scan_shape), dtype=np.float32)
        for tap, moved in zip(counts, movement, strict=True):  # one tap at a time stays in the cache
            changed = self._magnets.change_mt(moved) * moved.dtype.type(self.counts_per_mt)
            tap[:] = changed.swapaxes(1, 2).reshape(tap.shape)
        return counts


def on_pad(geometry: SensorGeometry, size: int, cell_mm: float) -> NDArray[np.bool_]:
    """Return which cells of a square grid centred on the pad lie on it, (size, size)."""
    along_mm = np.abs(np.arange(size) - (size - 1) / 2) * cell_mm
    square = geometry.width_mm == geometry.height_mm
    across, down = (along_mm < (np.inf if square else side / 2) for side in (geometry.width_mm, geometry.height_mm))
    return down[:, None] & across


def pressure_response(geometry: SensorGeometry, layer: Layer, size: int, cell_mm: float, magnet: Magnet) -> _Array:
    """Return the MOVEMENT of each magnet per pressure in each cell, (taxels, 5, cells) in [mm/MPa] and [1/MPa]."""
    q_x, q_y, q = _quarter(size, cell_mm)
    (_, below), (down, along), (_, above) = (
        inner_displacement(layer, q, magnet.height_mm + step_mm) for step_mm in (-_SLOPE_STEP_MM, 0, _SLOPE_STEP_MM)
    )
    lean = (1 + magnet.shape) / 2 * (above - below) / (2 * _SLOPE_STEP_MM) + (1 - magnet.shape) / 2 * q * down
    move, lean = _per_wave(along, q), _per_wave(lean, q)
    transfers = [
        (_ODD, _EVEN, -move * q_x),
        (_EVEN, _ODD, -move * q_y),
        (_EVEN, _EVEN, down),
        (_ODD, _EVEN, -lean * q_x),
        (_EVEN, _ODD, -lean * q_y),
    ]
    return _sums(geometry, size, cell_mm, transfers)


def traction_response(geometry: SensorGeometry, layer: Layer, size: int, cell_mm: float, magnet: Magnet) -> _Array:
    """Return the MOVEMENT of each magnet per traction to the right and back in each cell, (taxels, 5, 2, cells)."""
    q_x, q_y, q = _quarter(size, cell_mm)
    below, here, above = (
        inner_tangential(layer, q, magnet.height_mm + step_mm) for step_mm in (-_SLOPE_STEP_MM, 0, _SLOPE_STEP_MM)
    )
    bend, turn = (1 + magnet.shape) / 2, (1 - magnet.shape) / 2
    lean_along = bend * (above.along - below.along) / (2 * _SLOPE_STEP_MM) - turn * q * here.sunk
    lean_across = bend * (above.across - below.across) / (2 * _SLOPE_STEP_MM)
    # u_i = across t_i + (along - across) q_i q_j / q^2 t_j, and the lean likewise.
    move = _per_wave(_per_wave(here.along - here.across, q), q)
    lean = _per_wave(_per_wave(lean_along - lean_across, q), q)
    sunk = _per_wave(here.sunk, q)
    under_right = (
        (_EVEN, _EVEN, here.across + move * q_x**2),
        (_ODD, _ODD, -move * q_x * q_y),
        (_ODD, _EVEN, -sunk * q_x),
        (_EVEN, _EVEN, lean_across + lean * q_x**2),
        (_ODD, _ODD, -lean * q_x * q_y),
    )
    # Under traction back the response is the same, with x and y exchanged.
    changed = [(y, x, amplitude.T) for x, y, amplitude in under_right]
    under_back = (changed[1], changed[0], changed[2], changed[4], changed[3])
    both = [transfer for pair in zip(under_right, under_back, strict=True) for transfer in pair]
    return _sums(geometry, size, cell_mm, both).reshape(geometry.taxel_count, len(MOVEMENT), 2, size * size)


def _quarter(size: int, cell_mm: float) -> tuple[_Array, _Array, _Array]:
    """Return wave numbers 0 to the highest: to the right (1, m), back (m, 1), and their length (m, m), in [1/mm]."""
    q = 2 * np.pi * np.asarray(np.fft.rfftfreq(_PADS_WIDE * size, cell_mm), dtype=np.float64)
    return q[None, :], q[:, None], np.hypot(q[None, :], q[:, None])


def _per_wave(part: _Array, q: _Array) -> _Array:
    """Divide a part by the wave number, 0 for the wave that is even and has no direction."""
    return np.divide(part, q, out=np.zeros_like(part), where=q > 0)


def _sums(geometry: SensorGeometry, size: int, cell_mm: float, transfers: list[_Transfer]) -> _Array:
    """Return responses (taxels, transfers, cells) of the magnets to the cells.

    A transfer is even or odd in each axis, so that a quarter of its waves, with real sines and cosines, is enough.
    """
    q = _quarter(size, cell_mm)[0][0]
    # All waves but the first and the last of an axis stand for two, of q and of -q.
    twice = np.full_like(q, 2.0)
    twice[[0, -1]] = 1.0
    cells_mm = (np.arange(size) - (size - 1) / 2) * cell_mm
    centres_mm = geometry.taxel_centres_mm().reshape(geometry.rows, geometry.cols, 2)
    waves_x, waves_y = (
        [
            twice[:, None] * wave(q[:, None] * (places_mm[:, None] - cells_mm).reshape(1, -1))
            for wave in (np.cos, np.sin)
        ]
        for places_mm in (centres_mm[0, :, 0], centres_mm[:, 0, 1])
    )  # each (waves, columns or rows of taxels times cells), even and odd
    response = np.empty((geometry.taxel_count, len(transfers), size * size))
    for row, (in_x, in_y, amplitude) in enumerate(transfers):
        sums = (waves_y[in_y].T @ amplitude @ waves_x[in_x]).reshape(geometry.rows, size, geometry.cols, size)
        response[:, row] = sums.swapaxes(1, 2).reshape(geometry.taxel_count, -1)
    return response / (_PADS_WIDE * size) ** 2
