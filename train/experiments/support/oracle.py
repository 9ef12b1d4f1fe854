"""Best possible pattern where the surface is known: the simulator fitted to each reading, compared with the model.

Ten numbers define a press of a known flat surface on a known pad: x, y, turn, two slopes, depth, slide along x and y,
twist, and friction. Their Gaussian prior is the distribution they are drawn from; errors of the sensor are taken for
Gaussian. Gauss-Newton finds the most probable press, whose pattern is the oracle's.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Final, cast

import joblib
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from edge.evaluation.evaluate import judge
from edge.inference.onnx_session import ModelSession
from edge.terminal.progress_bar import tracked
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.generation_config import one_thread
from train.data.presses import PressSet, join_presses
from train.data.world import INDENTATION_MM
from train.experiments.support.scores import pattern_cells
from train.experiments.support.shipped import ALL, NOTHING, SHORT, infer_presses
from train.experiments.support.workbench import Workbench
from train.physics.gripped import SAMPLES, GrippedPad, Presses
from train.physics.pad_draws import Pad, constants, draw_pad
from train.physics.sensor_noise import Nuisances
from train.physics.simulated_sensor import MAX_INDENTATION_MM
from train.report import Row
from train.surfaces.depth_image import Relief, footprints
from train.surfaces.named_surfaces import SURFACES, surface_mesh
from train.surfaces.poses import as_poses, random_targets, turned_back

PRESSES: Final = 30
SEED: Final = 31
STEPS: Final = 4
NUDGE: Final = np.array([0.15, 0.15, 1.5, 0.002, 0.002, 0.01, 0.03, 0.03, 0.01, 0.2])
PRIOR_SD: Final = np.array([0.5, 0.5, 5.0, 0.005, 0.005, 0.12, 0.15, 0.15, 0.02, 0.4])
"""Prior deviation of x and y in [mm], turn in [deg], slopes, depth and slides in [mm], twist in [rad], log friction."""
PRIOR_MEAN: Final = np.array([0, 0, 0, 0, 0, 0.27, 0, 0, 0, np.log(0.6)])
"""Prior mean in the same order; the mean of the place is set to the nominal place of the surface."""
DEPTH: Final = 5
LEAST_DEPTH_MM: Final = 0.1
_SHORTER: Final = (1.0, 0.5, 0.2, 0.05)
_MODEL_SHARE: Final = 0.03
"""Share of a reading that no press explains, from hysteresis and cross-talk."""


_Fitted = tuple[FrozenPresses, NDArray[np.float32]]


@dataclass(frozen=True)
class KnownSurface:
    """One flat surface under one pad.

    Attributes:
        surface: its name.
        pad: constants of the sensor's pad.
    """

    surface: str
    pad: Pad

    @cached_property
    def _relief(self) -> Relief:
        return Relief(self.surface, surface_mesh(self.surface))

    @cached_property
    def _gripped(self) -> GrippedPad:
        return GrippedPad(self.pad)

    def press(self, numbers: NDArray[np.floating]) -> Presses:
        """Return the presses that the rows of (n, 10) define."""
        pad = self._gripped
        places = as_poses(numbers[:, :3])
        heights = -footprints([self._relief] * len(numbers), places, pad.size * SAMPLES, pad.cell_mm / SAMPLES).depth_mm
        slopes = numbers[:, 3:5, None, None]
        heights = (heights + slopes[:, 0] * pad.places_mm[0] + slopes[:, 1] * pad.places_mm[1]).astype(np.float32)
        depth_mm = np.clip(numbers[:, DEPTH], *INDENTATION_MM)
        return pad.press(heights, depth_mm, numbers[:, 6:8], numbers[:, 8], np.exp(numbers[:, 9]))

    def fit(self, reading: NDArray[np.floating], start: NDArray[np.floating], steps: int) -> NDArray[np.float32]:
        """Return the pattern (H, W) in [mm] of the most probable press.

        Args:
            reading: (48,) zeroed counts, divided by the gains.
            start: mean of the prior, where the search starts.
            steps: Gauss-Newton steps.
        """
        found = most_probable(lambda tried: self.press(tried).counts, reading, start, PRIOR_SD, NUDGE, steps)
        return self.press(found.numbers[None]).patterns[0]


@dataclass(frozen=True)
class Optimum:
    """End of one search for the most probable press.

    Attributes:
        numbers: (p,) that define it.
        cost: minus twice the logarithm of their probability, but for a constant: the least of several optima is best.
    """

    numbers: NDArray[np.float64]
    cost: float


def most_probable(
    counts_of: Callable[[NDArray[np.float64]], NDArray[np.floating]],
    reading: NDArray[np.floating],
    mean: NDArray[np.floating],
    spread: NDArray[np.floating],
    nudge: NDArray[np.floating],
    steps: int,
    start: NDArray[np.floating] | None = None,
) -> Optimum:
    """Return the most probable numbers (p,) behind the readings of one or several taps, by Gauss-Newton.

    Args:
        counts_of: function from numbers (n, p) to counts of n times all taps, 48 each.
        reading: (48 taps,) zeroed counts, divided by the gains.
        mean: (p,) of the prior.
        spread: (p,) standard deviations of the prior.
        nudge: (p,) changes by which slopes are found.
        steps: Gauss-Newton steps.
        start: (p,) where the search starts; None for the mean.
    """
    here = np.asarray(mean if start is None else start, dtype=np.float64)
    for _ in range(steps):
        around = counts_of(here + np.concatenate([np.zeros((1, len(here))), np.diag(nudge)]))
        counts = around.reshape(len(nudge) + 1, -1).astype(np.float64)
        slope = (counts[1:] - counts[0]).T / nudge
        weight = np.linalg.inv(_covariance(counts[0]))
        information = slope.T @ weight @ slope + np.diag(spread**-2.0)
        step = np.linalg.solve(information, slope.T @ weight @ (reading - counts[0]) - (here - mean) / spread**2)
        tried = here + np.concatenate([[0.0], _SHORTER])[:, None] * step
        off = reading - counts_of(tried).reshape(len(tried), -1)
        cost = np.einsum("ni,ij,nj->n", off, weight, off) + np.square((tried - mean) / spread).sum(axis=1)
        here = tried[int(cost.argmin())]
    counts = counts_of(here[None]).reshape(-1).astype(np.float64)
    covariance, off = _covariance(counts), reading - counts
    unexplained = off @ np.linalg.solve(covariance, off) + np.linalg.slogdet(covariance).logabsdet
    return Optimum(here, float(unexplained + np.square((here - mean) / spread).sum()))


def _covariance(counts: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the covariance of the errors of all taps' readings (48 taps,)."""
    taps = [error_covariance(tap, Nuisances()) for tap in counts.reshape(-1, 48)]
    return np.asarray(block_diag(*taps), dtype=np.float64)


def error_covariance(reading: NDArray[np.floating], nuisances: Nuisances) -> NDArray[np.float64]:
    """Return the covariance (48, 48) of the errors that sensors of known gains add to a reading (48,)."""
    taxels = len(reading) // 3
    drift = nuisances.thermal_drift_counts * np.repeat((1 / 8, 1 / 8, 1.0), taxels)
    axis = np.repeat(np.arange(3), taxels)
    common = axis[:, None] == axis
    own = nuisances.noise_counts**2 + 1 / 6 + (drift / 4) ** 2 + (_MODEL_SHARE * reading) ** 2
    earth = 2 / 3 * nuisances.earth_field_counts**2
    return np.diag(own) + common * (np.outer(drift, drift) + earth) + np.outer(reading, reading) * _MODEL_SHARE**2


def oracle_rows(bench: Workbench, model: ModelSession) -> list[Row]:
    """Return the errors of the oracle and of the model on the same presses."""
    count, steps = (2, 1) if bench.quick else (PRESSES, STEPS)
    pool = joblib.Parallel(n_jobs=-1, return_as="generator")
    jobs = cast(Iterator[_Fitted], pool(joblib.delayed(_press_and_fit)(number, steps) for number in range(count)))
    done = [one for _, one in zip(tracked(range(count), "oracle", "press"), jobs, strict=True)]
    frozen = FrozenPresses(
        join_presses([one.presses for one, _ in done]), np.concatenate([one.gains for one, _ in done])
    )
    patterns = {"oracle": np.stack([pattern for _, pattern in done])}
    for known in (NOTHING, ALL):
        patterns[SHORT[known]] = infer_presses(model, frozen, known).patterns
    truth, groups = frozen.patterns(), np.arange(count)
    rows: list[Row] = []
    for name, found in patterns.items():
        errors = judge(found, frozen.as_frozen_set(), model.contract.contact_level)
        rows.append({"method": name, "presses": count} | pattern_cells(errors, truth, MAX_INDENTATION_MM, groups))
    return rows


@one_thread()
def _press_and_fit(number: int, steps: int) -> _Fitted:
    """Return one press as its sensor reads it, and the oracle's pattern (H, W) of it."""
    rng = np.random.default_rng([SEED, number])
    known = KnownSurface(str(rng.choice(SURFACES)), draw_pad(rng))
    place = turned_back(random_targets(rng, 1, [known.surface]), 1)[0, 0]
    thought = PRIOR_MEAN + np.concatenate([place, np.zeros(7)])
    numbers = thought + rng.normal(0, PRIOR_SD).clip(-2 * PRIOR_SD, 2 * PRIOR_SD)
    numbers[DEPTH] = np.clip(numbers[DEPTH], LEAST_DEPTH_MM, INDENTATION_MM[1])
    frozen = freeze_presses(as_set(known.press(numbers[None]), known.pad, number), SEED + number)
    reading = frozen.windows(1, gains_known=True).reshape(-1)
    return frozen, known.fit(reading, thought, steps)


def as_set(done: Presses, pad: Pad, number: int) -> PressSet:
    """Return the presses of the taps of one sequence on one pad, newest first, with the newest one's truth."""
    taps = len(done.counts)
    return PressSet(
        family=np.array(["figure"]),
        pad=np.array([number]),
        constants=constants(pad)[None],
        counts=done.counts[None],
        angle_deg=np.zeros((1, taps), dtype=np.float32),
        poses=np.zeros((1, taps, 3), dtype=np.float32),
        patterns=done.patterns[:1].astype(np.float16),
        touching=done.touching[:1],
        traction_kpa=done.traction_kpa[:1].astype(np.float16),
        force_n=done.force_n[:1],
        twist_nmm=done.twist_nmm[:1],
        indentation_mm=done.indentation_mm[:1],
    )
