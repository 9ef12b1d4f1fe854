"""Constants of a pad and gains of its channels, from presses of a ball whose size is known.

How a ball's contact widens as its force grows shows how far it sinks in, which no unknown shape can show. The
simulated sensor's readings are fitted to those of all presses at once, by least squares: unknown are the constants,
cross-talk and gains, and of each press its place, depth, drag, friction and lag, and what is left of drift.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from firmware_bridge.pad_geometry import AXES, USPA44
from firmware_bridge.scans.pad_constants import LEVEL_90
from firmware_bridge.scans.pad_constants import Pad as SensorPad
from train.errors import DatasetError
from train.families.family_shares import BARE
from train.physics.gripped import MAX_INDENTATION_MM, GrippedPad
from train.physics.pad_draws import RANGES, Pad
from train.physics.sensor_noise import LARGEST_COUNTS, Nuisances, neighbours

TAXELS: Final = USPA44.taxel_count
CHANNELS: Final = len(AXES) * TAXELS
_OF_PAD: Final = len(RANGES) + 2  # its constants, the cross-talk, and the logarithm of the ball's radius
_GAIN_SPREAD: Final = 0.086  # of chips, seats and moments together, one standard deviation
_MOVES: Final = (1.5, 1.5, 0.5, 0.15, 0.15, 0.5)
"""Deviations of a press about its first guess: x and y in [mm], log of depth, drag in [mm], log of friction."""
_BALL_ERROR: Final = 0.05  # of the stated diameter, as a share of it, one standard deviation
_CROSS_TALK: Final = Nuisances().cross_talk
_FACTOR: Final = 0.03  # standard deviation of what the pad's lag makes of a press
_LEFT_COUNTS: Final = (5.0, 5.0, 10.0)  # of drift, since the pad was free just before
_NOISE_COUNTS: Final = 3.0
_MODEL_ERROR: Final = 0.03  # of the simulated sensor, as a share of a taxel's z
_WIDENING: Final = 1.5  # of intervals, by simulated sensors
MOST_MISFIT: Final = 12.0
_OF_PRESS: Final = len(_MOVES) + 1 + len(AXES)
_Array = NDArray[np.float64]


class _Presses:
    """Presses of a ball, as a function of what is unknown of them and of the pad, each over its deviation."""

    def __init__(self, counts: NDArray[np.floating], diameter_mm: float, known: SensorPad) -> None:
        self.counts = counts.reshape(len(counts), CHANNELS).astype(np.float64)
        z = np.abs(self.counts[:, -TAXELS:])
        clipped = np.abs(self.counts) > 0.97 * np.repeat(LARGEST_COUNTS, TAXELS)
        self.error = np.where(clipped, np.inf, np.hypot(_NOISE_COUNTS, _MODEL_ERROR * np.tile(z, len(AXES))))
        radius = np.log(diameter_mm / 2) + _BALL_ERROR * np.array([-LEVEL_90, LEVEL_90])
        ends = np.array([known.intervals.get(name, RANGES[name]) for name in RANGES] + [(0, _CROSS_TALK), radius])
        told = np.array([name in known.intervals for name in RANGES] + [False, True])
        self.middle = ends.mean(axis=1)
        # A constant is normal within a measured interval, and else uniform within its range.
        self.spread = np.ptp(ends, axis=1) / np.where(told, 2 * LEVEL_90, np.sqrt(12))
        self.bound = np.where(told, 4.0, np.sqrt(3.0))
        self.gains = np.ones(CHANNELS) if known.gains is None else np.array(known.gains)
        widths = known.gain_half_widths
        self.gain_spread = np.full(CHANNELS, _GAIN_SPREAD) if widths is None else np.array(widths) / LEVEL_90
        self._begin = self._first_guess(z)

    def _first_guess(self, z: _Array) -> _Array:
        """Return place, log depth, drag and log friction of each press (n, 6), by its centre and force."""
        places = USPA44.taxel_centres_mm()
        weights = np.square(z) / np.square(z).sum(axis=1, keepdims=True)
        depths = np.geomspace(0.03, MAX_INDENTATION_MM, 10)
        here = np.zeros((len(depths), len(_MOVES)))
        here[:, 2] = np.log(depths)
        sums = self._readings(self.middle, here)[:, -TAXELS:].sum(axis=1)
        begin = np.zeros((len(z), len(_MOVES)))
        begin[:, :2] = weights @ places
        begin[:, 2] = np.log(np.interp(z.sum(axis=1), sums, depths))
        begin[:, 5] = np.log(0.6)
        return begin

    def _readings(self, of_pad: _Array, presses: _Array) -> _Array:
        """Return readings (n, CHANNELS) of a pad without gains of its own."""
        gripped = GrippedPad(Pad(**dict(zip(RANGES, of_pad.tolist(), strict=False))))
        x, y = gripped.places_mm
        away = np.square(x - presses[:, 0, None, None]) + np.square(y - presses[:, 1, None, None])
        radius = np.exp(of_pad[-1])
        heights = np.sqrt(np.maximum(radius**2 - away, 0)) - radius
        n, depth, friction = len(presses), np.exp(presses[:, 2]), np.exp(presses[:, 5])
        done = gripped.press(
            heights.astype(np.float32),
            np.minimum(depth, MAX_INDENTATION_MM),
            presses[:, 3:5],
            np.zeros(n),
            friction,
            [BARE] * n,
            scale=2,
        )
        flat = done.counts.reshape(n, len(AXES), TAXELS).astype(np.float64)
        return (flat + of_pad[-2] * (flat @ neighbours(USPA44.rows, USPA44.cols))).reshape(n, CHANNELS)

    def parts(self, unknown: _Array) -> tuple[_Array, _Array, _Array, _Array]:
        """Return the pad's constants, gains, what each press does (n, 6), and its factor and rest (n, 4)."""
        of_press = unknown[_OF_PAD + CHANNELS :].reshape(len(self.counts), _OF_PRESS)
        drawn = (unknown[_OF_PAD : _OF_PAD + CHANNELS] * self.gain_spread).reshape(len(AXES), TAXELS)
        gains = self.gains * (1 + (drawn - drawn.mean(axis=1, keepdims=True)).ravel())  # each axis has the same mean
        moves = self._begin + _MOVES * of_press[:, : len(_MOVES)]
        return self.middle + self.spread * unknown[:_OF_PAD], gains, moves, of_press[:, len(_MOVES) :]

    def residuals(self, unknown: _Array) -> _Array:
        """Return what is left of the readings and of what was known, each over its deviation."""
        constants, gains, moves, rest = self.parts(unknown)
        read = self._readings(constants, moves)
        model = read * (1 + _FACTOR * rest[:, :1]) * gains + np.repeat(rest[:, 1:] * _LEFT_COUNTS, TAXELS, axis=1)
        return np.concatenate([((model - self.counts) / self.error).ravel(), unknown])

    def slopes(self, unknown: _Array) -> _Array:
        """Return the Jacobian of `residuals`: of the simulation by differences, else exact."""
        n = len(self.counts)
        slopes = np.zeros((n, CHANNELS, len(unknown)))
        constants, gains, moves, rest = self.parts(unknown)
        scaled = (1 + _FACTOR * rest[:, :1]) * gains
        here = self._readings(constants, moves)
        for at in range(_OF_PAD):
            step = -0.15 if unknown[at] > 0 else 0.15
            stepped = constants.copy()
            stepped[at] += step * self.spread[at]
            slopes[:, :, at] = (self._readings(stepped, moves) - here) / step * scaled
        for axis in range(len(AXES)):
            own = np.arange(axis * TAXELS, (axis + 1) * TAXELS)
            even = (np.eye(TAXELS) - 1 / TAXELS) * self.gain_spread[own]
            slopes[:, own[:, None], _OF_PAD + own] = (here * (1 + _FACTOR * rest[:, :1]) * self.gains)[
                :, own, None
            ] * even
        first, rows = _OF_PAD + CHANNELS, np.arange(n)
        for at, move in enumerate(_MOVES):
            there = [moves.copy(), moves.copy()]
            for sign, moved in zip((-1, 1), there, strict=True):
                moved[:, at] += sign * 0.08 * move
            change = self._readings(constants, there[1]) - self._readings(constants, there[0])
            slopes[rows, :, first + rows * _OF_PRESS + at] = change / 0.16 * scaled
        slopes[rows, :, first + rows * _OF_PRESS + len(_MOVES)] = _FACTOR * here * gains
        for axis, left in enumerate(_LEFT_COUNTS):
            own = slice(axis * TAXELS, (axis + 1) * TAXELS)
            for row in rows:
                slopes[row, own, first + row * _OF_PRESS + len(_MOVES) + 1 + axis] = left
        return np.concatenate([(slopes / self.error[:, :, None]).reshape(n * CHANNELS, -1), np.eye(len(unknown))])


def fit_ball(counts: NDArray[np.floating], diameter_mm: float, known: SensorPad) -> SensorPad:
    """Return constants of the pad that explains presses of a ball best, with 90 % intervals.

    Args:
        counts: readings (n, 3, rows, cols) of the presses in counts, zeroed on the pad that was free just before.
        diameter_mm: of the ball, in [mm].
        known: of the sensor; of constants alone those with an interval.

    Raises:
        DatasetError: no pad that is simulated reads so.
    """
    presses = _Presses(counts, diameter_mm, known)
    count = _OF_PAD + CHANNELS + len(counts) * _OF_PRESS
    bound = np.concatenate([presses.bound, np.full(count - _OF_PAD, 4.0)])
    slopes: Any = presses.slopes  # which the types of scipy do not know as a Jacobian
    fitted = least_squares(
        presses.residuals, np.zeros(count), jac=slopes, bounds=(-bound, bound), ftol=1e-3, xtol=1e-3, max_nfev=25
    )
    read = np.isfinite(presses.error).ravel()
    misfit = float(np.square(fitted.fun[: read.size][read]).mean())
    if misfit > MOST_MISFIT:
        raise DatasetError(
            f"no pad reads presses of a ball of {diameter_mm:g} mm like these (misfit {misfit:.0f}, expected at most "
            f"{MOST_MISFIT:g}): measure the ball, and press it alone, straight down, with the pad free in between"
        )
    off = float(fitted.x[_OF_PAD - 1])
    if abs(off) > 3:
        raise DatasetError(
            f"the presses are of a ball {'larger' if off > 0 else 'smaller'} than {diameter_mm:g} mm: measure its "
            "diameter, and press it alone, straight down, with the pad free in between"
        )
    deviation = np.sqrt(np.diag(np.linalg.inv(fitted.jac.T @ fitted.jac)) * max(misfit, 1.0))[:_OF_PAD]
    half = _WIDENING * LEVEL_90 * presses.spread * deviation
    values = presses.parts(fitted.x)[0]
    constants: dict[str, float] = {}
    intervals: dict[str, tuple[float, float]] = {}
    for name, value, wide in zip(RANGES, values.tolist(), half.tolist(), strict=False):
        low, high = RANGES[name]
        constants[name] = value
        intervals[name] = (min(value, max(value - wide, low)), max(value, min(value + wide, high)))
    return SensorPad(**dict[str, Any](constants), intervals=intervals)
