"""Best possible pattern from several taps of a known figure: the simulator fitted to the readings of all of them.

Taps share the place, turn and tilt of the figure; each has a depth, slides, twist and friction of its own, and an
error of its pose. Their Gaussian prior is the distribution they are drawn from, as for one tap (`oracle`).
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, cast

import joblib
import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.inference.onnx_session import ModelSession
from edge.terminal.progress_bar import tracked
from firmware_bridge.poses.pad_pose import PLACE_ERROR_MM, TURN_ERROR_DEG
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.generation_config import one_thread
from train.data.presses import join_presses
from train.data.world import INDENTATION_MM
from train.experiments.support.oracle import (
    DEPTH,
    LEAST_DEPTH_MM,
    NUDGE,
    PRIOR_MEAN,
    PRIOR_SD,
    KnownSurface,
    as_set,
    most_probable,
)
from train.experiments.support.shipped import ALL, NOTHING, SHORT, infer, known_pads
from train.families.catalogue import FIGURES
from train.physics.gripped import Presses
from train.physics.pad_draws import draw_pad
from train.physics.simulated_sensor import MAX_INDENTATION_MM
from train.report import Row, with_interval
from train.surfaces.depth_image import Pose
from train.surfaces.poses import over_surface, random_targets
from train.surfaces.tap_schedules import SCHEDULES

SCHEDULE: Final = "half-pitch"
TAPS: Final = 4
_FIGURES: Final = 60
_SEED: Final = 37
_FIRST_FIGURE: Final = 2**41
"""Beyond the numbers of all figures that networks are trained on or chosen by."""
_SHARED: Final = 5
"""Numbers of a press that all taps share: place, turn and two slopes."""
_STEPS: Final = 12
"""Gauss-Newton steps: with four, which suffice for one tap, single figures with four taps were up to 16 dB off."""
_NEARBY: Final = 0.2
"""Share of the prior's deviations by which the second search starts off the truth.

From the prior's mean alone, one in twenty ended in an optimum 10 dB off, and four in twenty at a clearly higher cost.
"""
_OFF: Final = np.array([PLACE_ERROR_MM, PLACE_ERROR_MM, TURN_ERROR_DEG])
_OFF_NUDGE: Final = np.array([0.1, 0.1, 1.0])


@dataclass(frozen=True)
class KnownTaps:
    """One flat figure under one pad, tapped several times from known poses with errors.

    Attributes:
        known: figure and pad.
        poses: (K, 3) of the taps in the newest one's axes, newest first.
    """

    known: KnownSurface
    poses: NDArray[np.float64]

    @property
    def spread(self) -> NDArray[np.floating]:
        """Standard deviations of all numbers: those of all taps, of each tap, and of each earlier pose's error."""
        return self._numbers(PRIOR_SD, _OFF)

    def mean(self, place: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the mean of all numbers, with the place and turn (3,) of the newest tap on the figure."""
        return self._numbers(PRIOR_MEAN + np.concatenate([place, np.zeros(len(PRIOR_MEAN) - len(place))]), 0 * _OFF)

    def press(self, numbers: NDArray[np.floating]) -> Presses:
        """Return the presses of all taps, tap after tap, for each row of numbers (n, p)."""
        return self.known.press(np.concatenate([self._taps(row) for row in numbers]))

    def off(self, numbers: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the errors of the taps' poses, (K, 3), for numbers (p,)."""
        return np.concatenate([np.zeros((1, 3)), numbers[_SHARED + len(self.poses) * self._own :].reshape(-1, 3)])

    def fit(
        self,
        readings: NDArray[np.floating],
        place: NDArray[np.floating],
        steps: int,
        starts: Sequence[NDArray[np.floating] | None] = (None,),
    ) -> NDArray[np.float32]:
        """Return the newest tap's pattern (H, W) in [mm] of the best of the optima that searches end in.

        Args:
            readings: (K, 48) zeroed counts, divided by the gains.
            place: (3,) of the newest tap on the figure, known roughly.
            steps: Gauss-Newton steps of a search.
            starts: numbers (p,) where each search starts; None for their mean.
        """
        nudge = self._numbers(NUDGE, _OFF_NUDGE)
        found = [
            most_probable(
                lambda tried: self.press(tried).counts,
                readings.reshape(-1),
                self.mean(place),
                self.spread,
                nudge,
                steps,
                start,
            )
            for start in starts
        ]
        best = min(found, key=lambda optimum: optimum.cost)
        return self.press(best.numbers[None]).patterns[0]

    def first(self, count: int, numbers: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return those of the numbers (p,) that define the newest `count` taps alone."""
        own = _SHARED + len(self.poses) * self._own
        return np.concatenate([numbers[: _SHARED + count * self._own], numbers[own : own + 3 * (count - 1)]])

    @property
    def _own(self) -> int:
        return len(PRIOR_MEAN) - _SHARED

    def _numbers(self, of_a_tap: NDArray[np.floating], off: NDArray[np.floating]) -> NDArray[np.floating]:
        taps = len(self.poses)
        return np.concatenate([of_a_tap[:_SHARED], np.tile(of_a_tap[_SHARED:], taps), np.tile(off, taps - 1)])

    def _taps(self, numbers: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the ten numbers of each tap, (K, 10)."""
        taps = len(self.poses)
        newest = Pose(*(float(value) for value in numbers[:3]))
        own = numbers[_SHARED : _SHARED + taps * self._own].reshape(taps, -1)
        places = [over_surface(newest, *pose.tolist()) for pose in self.poses + self.off(numbers)]
        at = np.array([(pose.x_mm, pose.y_mm, pose.angle_deg) for pose in places])
        return np.concatenate([at, np.tile(numbers[3:_SHARED], (taps, 1)), own], axis=1)


def tap_oracle_rows(model: ModelSession, *, quick: bool = False) -> list[Row]:
    """Return the errors of the oracle and of the model with one tap and with several, on the same presses."""
    count, steps = (2, 1) if quick else (_FIGURES, _STEPS)
    pool = joblib.Parallel(n_jobs=-1, return_as="generator")
    jobs = cast(Iterator[_Fitted], pool(joblib.delayed(_press_and_fit)(number, steps) for number in range(count)))
    done = [one for _, one in zip(tracked(range(count), "oracle", "figure"), jobs, strict=True)]
    frozen = FrozenPresses(
        join_presses([one.frozen.presses for one in done]), np.concatenate([one.frozen.gains for one in done])
    )
    stated = np.concatenate([np.stack([one.stated for one in done]), np.zeros((count, TAPS, 2))], axis=2)
    stated[:, 1:, 3:] = _OFF[1:]
    truth, each = frozen.patterns(), np.arange(count)
    found = {"oracle": [np.stack([one.patterns[taps] for one in done]) for taps in (0, 1)]}
    times_us = {"oracle": [1e6 * float(np.median([one.times_s[taps] for one in done])) for taps in (0, 1)]}
    for known in (NOTHING, ALL):
        runs = [
            infer(model, frozen.windows(taps), known_pads(frozen, known), stated[:, :taps].astype(np.float32))
            for taps in (1, TAPS)
        ]
        found[SHORT[known]] = [one.patterns for one in runs]
        times_us[SHORT[known]] = [one.run_time_us for one in runs]
    rows: list[Row] = []
    for name, patterns in found.items():
        one, several = (psnr_db(part, truth, MAX_INDENTATION_MM) for part in patterns)
        row: Row = {"method": name, "figures": count, "one tap dB": with_interval(one, each)}
        row |= {"one tap us": round(times_us[name][0]), f"gain of {TAPS} taps": with_interval(several - one, each)}
        rows.append(row | {f"{TAPS} taps us": round(times_us[name][1])})
    return rows


@dataclass(frozen=True)
class _Fitted:
    """Taps of one figure as its sensor reads them, and the oracle's patterns and times with one tap and with all.

    Attributes:
        frozen: one sequence.
        stated: (K, 3), poses as the robot states them.
        patterns: two of (H, W) in [mm].
        times_s: of both, in [s].
    """

    frozen: FrozenPresses
    stated: NDArray[np.float64]
    patterns: tuple[NDArray[np.float32], NDArray[np.float32]]
    times_s: tuple[float, float]


@one_thread()
def _press_and_fit(number: int, steps: int) -> _Fitted:
    rng = np.random.default_rng([_SEED, number])
    figure = f"{FIGURES[1 + number % (len(FIGURES) - 1)]}:{_FIRST_FIGURE + number}"
    taps = KnownTaps(KnownSurface(figure, draw_pad(rng)), SCHEDULES[SCHEDULE](rng, TAPS))
    pose = random_targets(rng, 1, [figure]).poses[0]
    place = np.array([pose.x_mm, pose.y_mm, pose.angle_deg])
    mean, spread = taps.mean(place), taps.spread
    numbers = mean + rng.normal(0, spread).clip(-2 * spread, 2 * spread)
    depths = slice(DEPTH, _SHARED + TAPS * (len(PRIOR_MEAN) - _SHARED), len(PRIOR_MEAN) - _SHARED)
    numbers[depths] = np.clip(numbers[depths], LEAST_DEPTH_MM, INDENTATION_MM[1])
    made = as_set(taps.press(numbers[None]), taps.known.pad, number)
    made = replace(made, poses=(taps.poses + taps.off(numbers))[None].astype(np.float32))
    frozen = freeze_presses(made, _SEED + number)
    readings = frozen.windows(TAPS, gains_known=True)[0].reshape(TAPS, -1)
    # Not the truth itself: where the cost is rough, a search stays where it starts.
    nearby = numbers + rng.normal(0, _NEARBY * spread)
    patterns: list[NDArray[np.float32]] = []
    times_s: list[float] = []
    for count in (1, TAPS):
        started_s = time.perf_counter()
        fewer = replace(taps, poses=taps.poses[:count])
        patterns.append(fewer.fit(readings[:count], place, steps, (None, taps.first(count, nearby))))
        times_s.append(time.perf_counter() - started_s)
    return _Fitted(frozen, taps.poses, (patterns[0], patterns[1]), (times_s[0], times_s[1]))
