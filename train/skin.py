"""The simulated skin: pressure on the pad to raw counts of the taxels.

Under each taxel a magnet sits in the pad, and a Hall chip on the board below it. The pad moves the magnet,
and to first order the chip reads the movement: for a dipole on its axis the in-plane reading is half as
steep as the normal one. One factor, counts per mm, follows from the data sheet's newtons per count.
Nuisances are named, seeded, and can each be set to zero.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.geometry import AXES, SensorGeometry
from train.layer import Layer, inner_displacement

NEWTONS_PER_COUNT_Z: Final = 0.00085
_SHEAR_PER_NORMAL: Final = 0.5
_REST_COUNTS: Final = (32700.0, 32800.0, 37400.0)
_REST_SPREAD_COUNTS: Final = 300.0


@dataclass(frozen=True, slots=True)
class Nuisances:
    """What a real skin adds to the physics, as wide as devices in the field are.

    Attributes:
        noise_counts: standard deviation of a reading at rest.
        gain_spread: standard deviation of a taxel axis' gain about 1; one draw per sensor.
        repeat_spread: the same for one tap: the pad creeps and does not repeat itself; one draw per tap.

    Spreads are cut at two standard deviations: gains within +-15 %, repeats within +-11 %, the largest hysteresis
    seen.
    """

    noise_counts: float = 2.0
    gain_spread: float = 0.075
    repeat_spread: float = 0.055


class Skin:
    """Readings of a sensor whose pad is pressed.

    Args:
        geometry: the taxels.
        layer: the pad.
        size: cells along a side of the pressure grid.
        cell_mm: their size, in [mm].
        magnet_height_mm: of the magnets above the board, in [mm].
    """

    def __init__(
        self, geometry: SensorGeometry, layer: Layer, size: int, cell_mm: float, magnet_height_mm: float = 2.5
    ) -> None:
        self.geometry = geometry
        response = _magnet_response(geometry, layer, size, cell_mm, magnet_height_mm)
        # Calibrated as a user would: the sum of z per newton, here under an even load on the whole pad.
        newtons = size**2 * cell_mm**2
        z_per_newton = response[:, 2].sum() / newtons
        counts_per_mm = 1 / (NEWTONS_PER_COUNT_Z * z_per_newton)
        per_axis = counts_per_mm * np.array([_SHEAR_PER_NORMAL, _SHEAR_PER_NORMAL, 1.0])
        self._response = (response * per_axis[None, :, None]).astype(np.float32)

    def deform(self, pressure_mpa: NDArray[np.float32]) -> NDArray[np.float32]:
        """Zeroed readings (n, 3, rows, cols) in counts, without nuisances, of pressures (n, size, size)."""
        flat = pressure_mpa.reshape(len(pressure_mpa), -1)
        taxels, axes, cells = self._response.shape
        counts = flat @ self._response.reshape(taxels * axes, cells).T
        rows, cols = self.geometry.rows, self.geometry.cols
        return counts.reshape(-1, rows, cols, axes).transpose(0, 3, 1, 2)


def draw_gains(
    rng: np.random.Generator, nuisances: Nuisances, geometry: SensorGeometry, sensors: int, taps: int
) -> NDArray[np.float32]:
    """Factors of readings, (sensors, taps, 3, rows, cols), about 1: each sensor's gains times each tap's repeat."""
    per_sensor = _factors(rng, (sensors, 1, *geometry.scan_shape), nuisances.gain_spread)
    return per_sensor * _factors(rng, (sensors, taps, *geometry.scan_shape), nuisances.repeat_spread)


def _factors(rng: np.random.Generator, shape: tuple[int, ...], spread: float) -> NDArray[np.float32]:
    return np.float32(1) + np.float32(spread) * np.clip(rng.standard_normal(shape, dtype=np.float32), -2, 2)


def draw_rest(rng: np.random.Generator, geometry: SensorGeometry) -> NDArray[np.float32]:
    """Rest level of one sensor, (3, rows, cols) in raw counts: differs per axis and per taxel, as on real ones."""
    spread = rng.standard_normal(geometry.scan_shape) * _REST_SPREAD_COUNTS
    return (np.array(_REST_COUNTS)[:, None, None] + spread).astype(np.float32)


def read_counts(rng: np.random.Generator, counts: NDArray[np.floating], nuisances: Nuisances) -> NDArray[np.float32]:
    """Readings as a chip gives them: with noise, in whole counts; any shape."""
    noise = rng.standard_normal(counts.shape, dtype=np.float32) * np.float32(nuisances.noise_counts)
    return np.rint(counts + noise).astype(np.float32)


def _magnet_response(
    geometry: SensorGeometry, layer: Layer, size: int, cell_mm: float, magnet_height_mm: float
) -> NDArray[np.float64]:
    """Displacement of each magnet per pressure in each cell, (taxels, 3, cells) in [mm/MPa]; z positive downwards.

    By Fourier sums over a domain four pads wide, straight at the magnets' places, which lie between cells.
    """
    padded = 4 * size
    q_x = 2 * np.pi * np.fft.fftfreq(padded, cell_mm)[None, :]
    q_y = 2 * np.pi * np.fft.fftfreq(padded, cell_mm)[:, None]
    q = np.hypot(q_x, q_y)
    down, along = inner_displacement(layer, q, magnet_height_mm)
    turn = np.divide(1j * along, q, out=np.zeros_like(q, dtype=complex), where=q > 0)
    cells_mm = (np.arange(size) - (size - 1) / 2) * cell_mm
    response = np.empty((geometry.taxel_count, len(AXES), size * size))
    for taxel, (x_mm, y_mm) in enumerate(geometry.taxel_centres_mm()):
        wave_x = np.exp(1j * q_x.T * (x_mm - cells_mm))  # (padded, size)
        wave_y = np.exp(1j * q_y * (y_mm - cells_mm))  # (padded, size)
        for axis, transfer in enumerate((turn * q_x, turn * q_y, down)):
            response[taxel, axis] = (wave_y.T @ transfer @ wave_x).real.ravel() / padded**2
    return response
