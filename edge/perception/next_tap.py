"""Proposal of the next tap: the pose whose readings are expected to take most of the pattern's error away.

The pattern is a Gaussian field on cells, with the covariance of training patterns. Each tap measures it through the
model's forward operator, with errors that all taps of a sensor share, and errors of its own. What the taps so far leave
uncertain follows from their poses, and is weighted by the model's own deviations; each pose that may be proposed is
scored by how much of it a tap there would take away over the newest tap's pattern. Only z is counted: shear is mostly
drag. Turns and larger shifts are not tried, as they gained less than shifts by half a pitch (docs/decisions.md).
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.forward_model import GRID, ForwardModel, pooling
from edge.perception.result import NextTap, Result
from edge.perception.tap_tracker import TapState
from firmware_bridge.pad_geometry import AXES, USPA44
from firmware_bridge.poses.pad_pose import PadPose
from firmware_bridge.scans.pad_constants import GAIN_SPREAD

_RIM: Final = 2
"""Cells around the pattern that are estimated as well, because taps next to the newest one measure them."""
_WIDE: Final = GRID + 2 * _RIM
_STATES: Final = _WIDE**2 + USPA44.rows * USPA44.cols
_READINGS: Final = USPA44.rows * USPA44.cols
_CELL_MM: Final = USPA44.rows * USPA44.pitch_mm / GRID
_LENGTHS_MM: Final = np.array([1.0, 2.0, 3.0, 7.0, 40.0])
_WEIGHTS: Final = np.array([0.0044, 0.0164, 0.0066, 0.0215, 0.0071])
"""Gaussians whose sum is the covariance of patterns by distance, over the square of the readings' amplitude, fitted
on training patterns (docs/decisions.md)."""
SHARED: Final = 0.45
"""Share of the operator's error that all taps have in common: one pad, one shape."""
_FINE: Final = 0.56
"""Squared error of detail finer than a cell, which no tap takes away, over that which one tap leaves of cells."""
_HALF_PITCH_MM: Final = USPA44.pitch_mm / 2
_SHIFTS_MM: Final = np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]) * _HALF_PITCH_MM


class TapAdvice:
    """Proposal for one sensor: made once, when a tap ends, and kept until the next one begins.

    Args:
        finder: of the model.
        taps: most taps of a pattern.
    """

    def __init__(self, finder: "NextTapFinder", taps: int) -> None:
        self._finder, self._taps = finder, taps
        self._strongest: Result | None = None
        self._tap = -1
        self._proposed: NextTap | None = None

    def see(self, made: Result, tap: int) -> None:
        """Take a result with a pattern: the strongest one of a tap, by its number, counts."""
        before = self._strongest
        if tap != self._tap:  # also after a reset within a tap, which goes on with another number
            self._tap, before = tap, None
        if before is None or (made.force_counts or 0.0) >= (before.force_counts or 0.0):
            self._strongest = made

    def proposal(self, tap: TapState) -> NextTap | None:
        """Return where to touch next; None during a tap, and where nothing can be proposed or the tap is forgotten."""
        if tap.contact or not tap.peaks or tap.peaks[0].tap != self._tap:
            self._proposed = None
            if not tap.contact:
                self._strongest = None
            return None
        if (made := self._strongest) is not None:
            self._strongest = None
            self._proposed = self._propose(made)
        return self._proposed

    def _propose(self, made: Result) -> NextTap | None:
        # Without a pose the next tap could not be placed, and a pattern not believed states no deviation of its own.
        if made.pose is None or made.poses is None or made.deviation is None or made.trusted is False:
            return None
        if made.taps_used >= self._taps:
            return None
        proposed = self._finder(made.poses, made.deviation)
        return None if proposed is None else proposed._replace(target=reached(made.pose, proposed))


def reached(newest: PadPose, proposed: NextTap) -> PadPose:
    """Return the pose in the object's plane of a proposal in the newest tap's axes."""
    turn = math.radians(newest.turn_deg)
    cosine, sine = math.cos(turn), math.sin(turn)
    return PadPose(
        newest.x_mm + cosine * proposed.dx_mm - sine * proposed.dy_mm,
        newest.y_mm + sine * proposed.dx_mm + cosine * proposed.dy_mm,
        newest.turn_deg + proposed.turn_deg,
        newest.error_mm,
        newest.error_deg,
    )


class NextTapFinder:
    """Scores of the poses that may be proposed, for the middle pad.

    Args:
        forward: the model's forward model.
        reach_mm: distance beyond which the model takes no tap, in [mm].
    """

    def __init__(self, forward: ForwardModel, reach_mm: float) -> None:
        at = len(AXES) - 1
        self._reach_mm = reach_mm
        self._operator = forward.operator[0, at * _READINGS : (at + 1) * _READINGS, : GRID**2]
        error = float(forward.model_error[at]) ** 2
        self._own = np.float32((1 - SHARED) * error + float(forward.noise[at]) ** 2)
        self._prior = np.zeros((_STATES, _STATES), dtype=np.float32)
        self._prior[: _WIDE**2, : _WIDE**2] = _covariance()
        shared = np.arange(_WIDE**2, _STATES)
        self._prior[shared, shared] = SHARED * error + GAIN_SPREAD**2
        inner = np.zeros((_WIDE, _WIDE), dtype=bool)
        inner[_RIM:-_RIM, _RIM:-_RIM] = True
        self._inner = np.flatnonzero(inner)
        self._tried = np.concatenate([self._rows(np.array([*shift, 0.0])) for shift in _SHIFTS_MM])
        left = self._left(np.zeros((1, 3)))
        self._fine = _FINE * float(left.diagonal()[self._inner].sum())

    def __call__(self, poses: NDArray[np.floating], deviation: NDArray[np.float32]) -> NextTap | None:
        """Return the best pose for the next tap; None if each would put an earlier tap out of reach.

        Args:
            poses: (K, 3 or more), x, y in [mm] and turn in [deg] of the taps so far in the newest one's axes.
            deviation: (H, W) of the newest tap's pattern.
        """
        apart = np.hypot(*(_SHIFTS_MM[:, None] - poses[None, :, :2]).transpose(2, 0, 1))
        within = (apart <= self._reach_mm).all(axis=1)
        if not within.any():
            return None
        left = self._left(poses)
        own = left.diagonal()[self._inner]
        total = float(own.sum())
        left *= (factor := self._factor(own, deviation))
        left *= factor[:, None]
        taken = np.where(within, self._taken(left), -1)
        best = int(taken.argmax())
        dx_mm, dy_mm = _SHIFTS_MM[best].tolist()
        return NextTap(dx_mm, dy_mm, 0.0, 1 - math.sqrt(1 - float(taken[best]) / (total + self._fine)))

    def _rows(self, pose: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the operator (16, states) of a tap; beyond the rim the field is held."""
        turn = math.radians(pose[2])
        cosine, sine = math.cos(turn), math.sin(turn)
        places = _OWN_MM @ np.array([[cosine, sine], [-sine, cosine]]) + pose[:2]
        along = (places / _CELL_MM + (_WIDE - 1) / 2).clip(0, _WIDE - 1)
        column, row = ((1 - np.abs(along[:, axis, None] - np.arange(_WIDE))).clip(0) for axis in (0, 1))
        spread = (row[:, :, None] * column[:, None, :]).reshape(GRID**2, -1)
        return np.hstack([self._operator @ spread, np.eye(_READINGS)]).astype(np.float32)

    def _left(self, poses: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the covariance (states, states) that taps leave."""
        rows = np.concatenate([self._rows(pose) for pose in poses])
        seen = rows @ self._prior
        noise = seen @ rows.T + self._own * np.eye(len(rows), dtype=np.float32)
        return (self._prior - seen.T @ np.linalg.solve(noise, seen)).astype(np.float32, copy=False)

    def _factor(self, own: NDArray[np.float32], deviation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the factor (states,) that gives cells the model's deviations, with the mean square that they have."""
        wanted = pooling(deviation.shape[0]) @ np.square(deviation) @ pooling(deviation.shape[1]).T
        wanted *= own.sum() / wanted.sum()
        factor = np.ones(_STATES, dtype=np.float32)
        inner = np.sqrt(wanted / own.reshape(GRID, GRID))
        factor[: _WIDE**2] = np.pad(inner, _RIM, mode="edge").ravel()
        return factor

    def _taken(self, left: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the sum of variances over the pattern that each pose would take away."""
        rows = self._tried.reshape(len(_SHIFTS_MM), _READINGS, _STATES)
        seen = (self._tried @ left).reshape(rows.shape)
        noise = seen @ rows.transpose(0, 2, 1) + self._own * np.eye(_READINGS, dtype=np.float32)
        inner = seen[:, :, self._inner]
        return np.einsum("nij,nij->n", inner, np.linalg.solve(noise, inner))


def _places(side: int) -> NDArray[np.floating]:
    """Return x, y of the centres of side x side cells from the pad's centre, (side^2, 2) in [mm]."""
    along = (np.arange(side) - (side - 1) / 2) * _CELL_MM
    x, y = np.meshgrid(along, along)
    return np.stack([x.ravel(), y.ravel()], axis=1)


_OWN_MM: Final = _places(GRID)


def _covariance() -> NDArray[np.floating]:
    """Return the covariance of the means of cells, (_WIDE^2, _WIDE^2); means widen and lower each Gaussian."""
    places = _places(_WIDE)
    square = np.square(places[:, None] - places).sum(axis=2)
    wide = _LENGTHS_MM**2 + _CELL_MM**2 / 6
    return np.exp(-square[..., None] / (2 * wide)) @ (_WEIGHTS * _LENGTHS_MM**2 / wide)
