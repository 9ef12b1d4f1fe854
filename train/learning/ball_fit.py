"""Constants of a pad and gains of its channels, from presses of a ball whose size is known.

Where the shape is known, readings of light and firm presses determine thickness, Poisson's ratio, in-plane share,
magnet height and free sides; the modulus hardly. The simulated sensor's readings are fitted to those of all presses at
once, by least squares: unknown are the constants, cross-talk and gains, and of each press its place, depth, drag,
friction and lag, and what is left of drift.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from firmware_bridge.pad_geometry import AXES, CHANNELS, TAXELS, USPA44
from firmware_bridge.scans.pad_constants import LEVEL_90
from firmware_bridge.scans.pad_constants import Pad as SensorPad
from train.errors import DatasetError
from train.families.catalogue import BARE
from train.physics.gripped import MAX_INDENTATION_MM, GrippedPad
from train.physics.pad_draws import RANGES, Pad
from train.physics.sensor_noise import LARGEST_COUNTS, Nuisances, neighbours

_OF_PAD: Final = len(RANGES) + 2  # its constants, the cross-talk, and the logarithm of the ball's radius
_GAIN_SPREAD: Final = 0.086  # of chips, seats and moments together, one standard deviation
# Deviations of a press about its first guess: x and y in [mm], log of depth, drag in [mm], log of friction.
_MOVES: Final = (1.5, 1.5, 0.5, 0.15, 0.15, 0.5)
_BALL_ERROR: Final = 0.05  # of the stated diameter, as a share of it, one standard deviation
_FACTOR: Final = 0.03  # standard deviation of what the pad's lag makes of a press
_LEFT_COUNTS: Final = (5.0, 5.0, 10.0)  # of drift, since the pad was free just before
_NOISE_COUNTS: Final = 3.0
_MODEL_ERROR: Final = 0.03  # of the simulated sensor, as a share of a taxel's z
_WIDENING: Final = 2.0  # of intervals, by simulated sensors: two scans of a press err alike
MOST_MISFIT: Final = 12.0
_MOST_CONTRADICTION: Final = 16.0  # sum of squares, each over its variance
LEAST_SCANS: Final = 12
MOST_PRESSES: Final = 12  # each takes two seconds or three to fit
_ENTERED: Final = 0.01  # of its range, how far a constant without an interval may be off
_OF_PRESS: Final = len(_MOVES) + 1 + len(AXES)
_Array = NDArray[np.float64]


class _Presses:
    """Presses of a ball, as a function of what is unknown of them and of the pad, each over its deviation."""

    def __init__(self, presses: Sequence[NDArray[np.floating]], diameter_mm: float, known: SensorPad) -> None:
        radius = np.log(diameter_mm / 2) + _BALL_ERROR * np.array([-LEVEL_90, LEVEL_90])
        ends = np.array([_known_ends(known, name) for name in RANGES] + [(0, Nuisances().cross_talk), radius])
        told = np.array([name in known.constants for name in RANGES] + [False, True])
        self.middle = ends.mean(axis=1)
        # A constant is normal within a measured interval, and else uniform within its range.
        self.spread = np.ptp(ends, axis=1) / np.where(told, 2 * LEVEL_90, np.sqrt(12))
        self.bound = np.where(told, 4.0, np.sqrt(3.0))
        self.gains = np.ones(CHANNELS) if known.gains is None else np.array(known.gains)
        widths = known.gain_half_widths
        self.gain_spread = np.full(CHANNELS, _GAIN_SPREAD) if widths is None else np.array(widths) / LEVEL_90
        depths = np.geomspace(0.03, MAX_INDENTATION_MM, 10)
        here = np.zeros((len(depths), len(_MOVES)))
        here[:, 2] = np.log(depths)
        sums = self._readings(self.middle, here)[:, -TAXELS:].sum(axis=1)
        self.counts = _light(presses, 0.9 * float(sums[-1]))
        z = np.abs(self.counts[:, -TAXELS:])
        clipped = np.abs(self.counts) > 0.97 * np.repeat(LARGEST_COUNTS, TAXELS)
        self.error = np.where(clipped, np.inf, np.hypot(_NOISE_COUNTS, _MODEL_ERROR * np.tile(z, len(AXES))))
        # The first guess of a press is by its centre and force.
        self._begin = np.zeros((len(z), len(_MOVES)))
        self._begin[:, :2] = np.square(z) / np.square(z).sum(axis=1, keepdims=True) @ USPA44.taxel_centres_mm()
        self._begin[:, 2] = np.log(np.interp(z.sum(axis=1), sums, depths))
        self._begin[:, 5] = np.log(0.6)

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
        read = (slopes / self.error[:, :, None]).reshape(n * CHANNELS, -1)
        return np.concatenate([read, np.eye(len(unknown))])


def _light(presses: Sequence[NDArray[np.floating]], most_counts: float) -> _Array:
    """Return two scans of each press, (n, CHANNELS): the strongest below a sum of z, and one of about half of that."""
    pairs = []
    for scans in presses:
        sums = scans[:, AXES.index("z")].sum(axis=(1, 2))
        if len(light := np.flatnonzero(sums <= most_counts)):
            half = np.abs(sums - sums[light[-1]] / 2).argmin()
            pairs.append([scans[at].ravel() for at in dict.fromkeys((int(half), int(light[-1])))])
    if (count := sum(map(len, pairs))) < LEAST_SCANS:
        raise DatasetError(
            f"{len(presses)} presses with {count} scans below {most_counts:.0f} counts in the sum of z, expected "
            f"{LEAST_SCANS} or more: press the ball alone, slowly, all over the pad, which is free in between"
        )
    spread = np.linspace(0, len(pairs) - 1, min(len(pairs), MOST_PRESSES)).round().astype(int)
    return np.array([scan for at in spread for scan in pairs[at]], dtype=np.float64)


def _known_ends(known: SensorPad, name: str) -> tuple[float, float]:
    """Return the bounds of a constant: measured ones, its range, or hardly any where only its value is known."""
    if name not in known.constants or name in known.intervals:
        return known.intervals.get(name, RANGES[name])
    away = _ENTERED * (RANGES[name][1] - RANGES[name][0])
    return known.constants[name] - away, known.constants[name] + away


def fit_ball(presses: Sequence[NDArray[np.floating]], diameter_mm: float, known: SensorPad) -> SensorPad:
    """Return those constants of a pad that presses of a ball determine, with 90 % intervals; not counts per newton.

    Each press is scans (n, 3, rows, cols) from first touch on, in counts over the pad that was free just before.
    A constant that is known without an interval is as good as certain. DatasetError if they are too few, or no pad that
    is simulated reads so.
    """
    fit = _Presses(presses, diameter_mm, known)
    count = _OF_PAD + CHANNELS + len(fit.counts) * _OF_PRESS
    bound = np.concatenate([fit.bound, np.full(count - _OF_PAD, 4.0)])
    slopes: Any = fit.slopes  # which the types of scipy do not know as a Jacobian
    fitted = least_squares(
        fit.residuals, np.zeros(count), jac=slopes, bounds=(-bound, bound), ftol=1e-3, xtol=1e-3, max_nfev=25
    )
    read = np.isfinite(fit.error).ravel()
    misfit = float(np.square(fitted.fun[: read.size][read]).mean())
    if misfit > MOST_MISFIT:
        raise DatasetError(
            f"no pad reads presses of a ball of {diameter_mm:g} mm like these (misfit {misfit:.0f}, expected at most "
            f"{MOST_MISFIT:g}): measure the ball, and press it alone, straight down, with the pad free in between"
        )
    # Too large or too small a ball is explained by another modulus, then by another force than was weighed.
    of_scale = [*map(list(RANGES).index, ("shear_modulus_mpa", "counts_per_newton")), _OF_PAD - 1]
    if float(np.square(fitted.x[of_scale]).sum()) > _MOST_CONTRADICTION:
        raise DatasetError(
            f"a ball of {diameter_mm:g} mm and the counts per newton contradict each other: measure that diameter, "
            "press it alone, straight down, and lay the weight on the whole pad"
        )
    deviation = np.sqrt(np.diag(np.linalg.inv(fitted.jac.T @ fitted.jac)) * max(misfit, 1.0))[:_OF_PAD]
    half = _WIDENING * LEVEL_90 * fit.spread * deviation
    values = fit.parts(fitted.x)[0]
    constants: dict[str, float] = {}
    intervals: dict[str, tuple[float, float]] = {}
    for name, value, wide in zip(RANGES, values.tolist(), half.tolist(), strict=False):
        low, high = RANGES[name]
        # One that stays as open as its range is left out, and the weight determines counts per newton better.
        if 2 * wide < high - low and name not in known.constants:
            constants[name] = value
            intervals[name] = (min(value, max(value - wide, low)), max(value, min(value + wide, high)))
    return SensorPad(**dict[str, Any](constants), intervals=intervals)
