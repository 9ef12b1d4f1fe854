"""Response of the magnets to pressure and traction on the pad's surface: Fourier sums at the magnets' places.

The domain is four pads wide, and magnets lie between cells. A magnet is stiff and turns with the pad around it like a
spheroid of its aspect a = thickness / diameter: its axis leans by (1 + L)/2 du_x/dz - (1 - L)/2 du_z/dx, with L = (a^2
- 1)/(a^2 + 1). A flat disc (L = -1) follows the slope of its plane, a sphere (L = 0) half the curl, a needle (L = 1)
the material along it. A transfer is even or odd in each axis, so that a quarter of its waves, with real sines and
cosines, is enough: a tenth of the products of whole complex waves.

Source: Jeffery 1922, the turning of a spheroid in Stokes flow, whose equations are those of an incompressible solid.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import SensorGeometry
from train.physics.elastic_layer import Layer, inner_displacement, inner_tangential
from train.physics.magnets import MOVEMENT, Magnet

_PADS_WIDE: Final = 4
_SLOPE_STEP_MM: Final = 1e-3

_EVEN: Final = 0
_ODD: Final = 1

_Array = NDArray[np.float64]
_Transfer = tuple[int, int, _Array]
"""Parity in x and in y, even or odd, and the amplitudes (q_y, q_x) of a transfer's quarter of waves."""


def pressure_response(
    geometry: SensorGeometry, layer: Layer, size: int, cell_mm: float, magnet: Magnet
) -> NDArray[np.float64]:
    """Return the MOVEMENT of each magnet per pressure in each cell, (taxels, 5, cells) in [mm/MPa] and [1/MPa].

    Args:
        geometry: the taxels.
        layer: the pad.
        size: cells along a side of the grid of pressures.
        cell_mm: their size, in [mm].
        magnet: of every taxel.
    """
    q_x, q_y, q = _quarter(size, cell_mm)
    down, along = inner_displacement(layer, q, magnet.height_mm)
    above = inner_displacement(layer, q, magnet.height_mm + _SLOPE_STEP_MM)[1]
    below = inner_displacement(layer, q, magnet.height_mm - _SLOPE_STEP_MM)[1]
    lean = (1 + magnet.shape) / 2 * (above - below) / (2 * _SLOPE_STEP_MM) + (1 - magnet.shape) / 2 * q * down
    move, lean = _per_wave(along, q), _per_wave(lean, q)
    transfers: list[_Transfer] = [
        (_ODD, _EVEN, -move * q_x),
        (_EVEN, _ODD, -move * q_y),
        (_EVEN, _EVEN, down),
        (_ODD, _EVEN, -lean * q_x),
        (_EVEN, _ODD, -lean * q_y),
    ]
    return _sums(geometry, size, cell_mm, transfers)


def traction_response(
    geometry: SensorGeometry, layer: Layer, size: int, cell_mm: float, magnet: Magnet
) -> NDArray[np.float64]:
    """Return the MOVEMENT of each magnet per tangential traction in each cell, (taxels, 5, 2, cells).

    Units are [mm/MPa] and [1/MPa].

    The third axis is the traction's: to the right, back.

    Args:
        geometry: the taxels.
        layer: the pad.
        size: cells along a side of the grid of tractions.
        cell_mm: their size, in [mm].
        magnet: of every taxel.
    """
    q_x, q_y, q = _quarter(size, cell_mm)
    here = inner_tangential(layer, q, magnet.height_mm)
    above = inner_tangential(layer, q, magnet.height_mm + _SLOPE_STEP_MM)
    below = inner_tangential(layer, q, magnet.height_mm - _SLOPE_STEP_MM)
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
    response = _sums(geometry, size, cell_mm, both)
    return response.reshape(len(response), len(MOVEMENT), 2, size * size)


def _quarter(size: int, cell_mm: float) -> tuple[_Array, _Array, _Array]:
    """Return wave numbers 0 to the highest: to the right (1, m), back (m, 1), and their length (m, m), in [1/mm]."""
    q = 2 * np.pi * np.asarray(np.fft.rfftfreq(_PADS_WIDE * size, cell_mm), dtype=np.float64)
    return q[None, :], q[:, None], np.hypot(q[None, :], q[:, None])


def _per_wave(part: _Array, q: _Array) -> _Array:
    """Divide a part by the wave number, 0 for the wave that is even and has no direction."""
    return np.divide(part, q, out=np.zeros_like(part), where=q > 0)


def _sums(geometry: SensorGeometry, size: int, cell_mm: float, transfers: list[_Transfer]) -> _Array:
    """Return responses (taxels, transfers, cells) of the magnets to the cells."""
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
