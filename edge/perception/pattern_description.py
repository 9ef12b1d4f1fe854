"""Stage that adds what follows from a pattern: area, interval, expected error, and the wrench.

The frame is that of the whole project: x to the right, y down the rows, and so, to be right-handed, z into the pad; its
origin is the middle of the face. Forces and torques act on the pad: pressing is a positive z force, and a twist, torque
about z, is positive if it turns x to y, clockwise for a viewer who looks at the pad from above.
"""

import math
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from edge.inference.intervals import expect
from edge.inference.trust_model import GRID, KPA, pooling
from edge.perception.result import Estimate, Wrench
from edge.perception.trust_check import SensorPad
from firmware_bridge.pad_geometry import SensorGeometry

LEAST_FORCE_N: Final = 0.1  # for a centre of pressure, which noise moves about below it; a tap begins at ten times that
_N_OF_KPA_MM2: Final = 1e-3
_SHEAR_PRIOR_N2: Final = 5.0  # squared shear by which contacts outweigh the nominal counts per newton of x and y


def wrench_of(traction_kpa: NDArray[np.floating], pixel_mm: float) -> Wrench:
    """Sum a traction (3, h, w) of x, y, z, constant within each pixel of this side, to force and torque."""
    height, width = traction_kpa.shape[1:]
    fx, fy, fz, tx, ty, tz = (_sums(height, width, pixel_mm) @ traction_kpa.ravel()).tolist()
    presses = fz >= LEAST_FORCE_N
    centre, shear_ratio = ((-ty / fz, tx / fz), math.hypot(fx, fy) / fz) if presses else (None, None)
    return Wrench((fx, fy, fz), (tx, ty, tz), centre, shear_ratio)


@lru_cache(maxsize=8)
def _sums(height: int, width: int, pixel_mm: float) -> NDArray[np.float64]:
    """Return the matrix (6, 3 h w) that maps a flat traction to force and torque."""
    y_mm, x_mm = np.indices((height, width), dtype=np.float64).reshape(2, -1)
    x_mm, y_mm = (x_mm - (width - 1) / 2) * pixel_mm, (y_mm - (height - 1) / 2) * pixel_mm
    ones, zeros = np.ones_like(x_mm), np.zeros_like(x_mm)
    rows = (
        *((ones, zeros, zeros), (zeros, ones, zeros), (zeros, zeros, ones)),
        # (x, y, 0) cross (x, y, z of the traction)
        *((zeros, zeros, y_mm), (zeros, zeros, -x_mm), (-y_mm, x_mm, zeros)),
    )
    return np.array([np.concatenate(row) for row in rows]) * (_N_OF_KPA_MM2 * pixel_mm**2)


class Balance:
    """Force of one sensor's contacts by the sums of its readings, over which the network's traction is distributed.

    By a network the two pads of a gripper, which carry equal and opposite forces, disagree where their plain sums
    agree. So changes of a force are those of the sums, and the network tells what the sums mean: newtons for a count of
    z and counts of x and y that pressing makes, by the contact so far, newtons for a count of shear by all contacts.
    """

    def __init__(self, geometry: SensorGeometry) -> None:
        self._area_mm2 = geometry.rows * geometry.cols * geometry.pitch_mm**2
        self._tap: int | None = None
        self._operator: NDArray[np.float32] | None = None
        self._pressing = np.zeros((2, 0))
        self._counts_per_n: tuple[float, float] = (0.0, 0.0)
        self._shear = (0.0, 0.0)
        self._level = (0.0,) * 4

    def __call__(
        self,
        traction_kpa: NDArray[np.float32],
        pattern: NDArray[np.float32],
        readings: NDArray[np.float32],
        tap: int,
        operator: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Return the network's traction (3, h, w) with the force of its readings (3, rows, cols) in network units.

        The pattern (H, W) is in [mm]; `tap` numbers the contact, and the operator is the pad's.
        """
        if operator is not self._operator:
            self._use_pad(operator, pattern.shape)
        flat = traction_kpa.reshape(3, -1)
        n_per_kpa = self._area_mm2 / flat.shape[1] * _N_OF_KPA_MM2
        x_n, y_n, z_n = (flat.sum(axis=1) * n_per_kpa).tolist()
        x, y, z = readings.reshape(3, -1).sum(axis=1).tolist()
        if not (z > 0 and z_n >= LEAST_FORCE_N and min(self._counts_per_n) > 0):
            return traction_kpa
        if tap != self._tap:
            self._tap, self._level = tap, (0.0,) * 4
        # Least squares over the contact, whose strong scans count most: of the network's z force, and of what pressing
        # adds to x and y, over the sum of z. Scans fade over 200, two seconds at 100 Hz: a contact that rolls on gets a
        # new level.
        pressed_x, pressed_y = (z * (self._pressing @ pattern.ravel())).tolist()
        keep = 1 - 1 / 200
        squares, by_force, by_x, by_y = self._level
        squares, by_force = keep * squares + z * z, keep * by_force + z * z_n
        by_x, by_y = keep * by_x + pressed_x, keep * by_y + pressed_y
        self._level = squares, by_force, by_x, by_y
        # The same over all contacts: of the network's shear, over that by nominal counts per newton.
        x_per_n, y_per_n = self._counts_per_n
        shear_x, shear_y = (x - z * by_x / squares) / x_per_n, (y - z * by_y / squares) / y_per_n
        nominal, inferred = self._shear
        nominal += shear_x * shear_x + shear_y * shear_y
        inferred += shear_x * x_n + shear_y * y_n
        self._shear = nominal, inferred
        # Newtons for a nominal one, 0.62 to 2.96 on 2000 drawn pads: an offset of x or y, as of a cable, is no more.
        scale = min(max(inferred / nominal, 0.5), 3.0)
        # Shear that the network has not found, or too much of it, lies where the pad is pressed.
        more_x, more_y = (scale * shear_x - x_n) / z_n, (scale * shear_y - y_n) / z_n
        mixed = np.array([(1, 0, more_x), (0, 1, more_y), (0, 0, z * by_force / squares / z_n)], dtype=np.float32)
        return (mixed @ flat).reshape(traction_kpa.shape)

    def _use_pad(self, operator: NDArray[np.float32], pattern_shape: tuple[int, ...]) -> None:
        """Sum a pad's operator over the taxels: readings of x and y that a pattern makes, and those of 1 N of drag."""
        summed = operator.reshape(3, -1, operator.shape[1])[:2].sum(axis=1)
        pattern, drag = summed[:, : GRID**2].reshape(2, GRID, GRID), summed[:, GRID**2 :].reshape(2, 2, -1)
        height, width = pattern_shape
        self._pressing = (pooling(height).T @ pattern @ pooling(width)).reshape(2, -1)
        dragged_n = KPA * self._area_mm2 * _N_OF_KPA_MM2
        self._counts_per_n = (float(drag[0, 0].sum()) / dragged_n, float(drag[1, 1].sum()) / dragged_n)
        self._shear = _SHEAR_PRIOR_N2, _SHEAR_PRIOR_N2
        self._operator = operator


def touched(pattern: NDArray[np.floating], level: float) -> NDArray[np.bool_]:
    """Return the pixels that reach `level` of the pattern's maximum, (..., H, W) bool; none if that is not positive."""
    peak = pattern.max(axis=(-2, -1), keepdims=True)
    return (pattern >= level * peak) & (peak > 0)


def touched_patch(
    pattern: NDArray[np.float32], touching: NDArray[np.bool_], pixel_pitch_mm: float
) -> tuple[float, tuple[float, float] | None]:
    """Return area and weighted centroid x, y of the touched pixels (H, W), in [mm] from the pattern's centre."""
    rows, cols = np.nonzero(touching)
    if rows.size == 0:
        return 0.0, None
    weights = pattern[rows, cols].astype(np.float64)
    weights /= weights.sum()
    height, width = pattern.shape
    x_mm = (float(weights @ cols) - (width - 1) / 2) * pixel_pitch_mm
    y_mm = (float(weights @ rows) - (height - 1) / 2) * pixel_pitch_mm
    return rows.size * pixel_pitch_mm**2, (x_mm, y_mm)


class Describe:
    """Stage: everything that follows from a pattern: area, interval, expected error, wrench."""

    def __init__(self, contract: Contract, geometry: SensorGeometry, pad: SensorPad) -> None:
        self._contract, self._geometry, self._pad = contract, geometry, pad
        self._balance = Balance(geometry)
        self._pixel_mm = geometry.pixel_pitch_mm(contract.scale)

    def __call__(
        self, made: Estimate, tap: int, newest: NDArray[np.float32], about: tuple[float, float] | None
    ) -> None:
        """Add to the estimate of a tap what follows; `about` are doubt and RMS, the readings are in network units."""
        contract, pattern, deviation = self._contract, made.pattern, made.deviation
        if pattern is None:
            raise ValueError("the estimate has no pattern")
        peak = pattern.max()
        touching = pattern >= contract.contact_level * peak if peak > 0 else np.zeros(pattern.shape, dtype=bool)
        made.area_mm2, made.centroid_mm = touched_patch(pattern, touching, self._pixel_mm)
        if deviation is not None and about is not None:
            expected = expect(contract.confidence, made.taps_used, *about)
            if expected is not None:
                made.expected_rmse_mm, made.another_tap = expected
            if contract.interval_factor is not None and made.centroid_mm is not None:
                mean_mm = float(deviation.ravel() @ touching.ravel()) / np.count_nonzero(touching)
                made.interval_mm = contract.interval_factor * mean_mm
        if (traction := made.traction) is not None:
            if (operator := self._pad.operator) is not None:
                made.traction = traction = self._balance(traction, pattern, newest, tap, operator)
            made.wrench = wrench_of(traction, self._geometry.rows * self._geometry.pitch_mm / traction.shape[1])
            made.wrench_origin = self._pad.wrench_origin
