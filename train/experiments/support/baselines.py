"""Methods without a network, fitted on the presses that networks are trained on: baselines for a shipped model."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.classical_methods import Method, bilinear, fit_gain, fit_linear_map
from edge.evaluation.metrics import psnr_db
from train.data.batches import COUNTS_PER_UNIT
from train.data.frozen_presses import FrozenPresses
from train.data.generation_config import SEED
from train.data.press_batches import read_presses
from train.data.presses import PressSet
from train.experiments.support.kriging import Kriging
from train.freeze import SCALE
from train.learning.checkpoint import best_contact_level
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import NOMINAL
from train.physics.sensor_noise import Nuisances
from train.physics.simulated_sensor import MAX_INDENTATION_MM

LENGTHS_MM: Final = (0.5, 1.0, 1.5, 2.0, 3.0, 4.5)
NOISES: Final = (1e-4, 1e-3, 1e-2, 1e-1)
_TIMED_SCANS: Final = 100
_AT_ONCE: Final = 64


@dataclass(frozen=True, slots=True)
class Baseline:
    """Method from the newest tap to a pattern.

    Attributes:
        name: as shown in tables.
        run: newest taps (n, 3, rows, cols) in zeroed counts to patterns (n, H, W) in [mm].
        contact_level: share of a pattern's maximum from which a pixel counts as touched, chosen on validation.
        validation_db: mean PSNR on validation, in [dB].
    """

    name: str
    run: Method
    contact_level: float
    validation_db: float

    def run_time_us(self, newest: NDArray[np.float32]) -> float:
        """Return the median run time of one scan in [us], measured on the first of (n, 3, rows, cols)."""
        times_s: list[float] = []
        for index in range(min(len(newest), _TIMED_SCANS)):
            started_s = time.perf_counter()
            self.run(newest[index : index + 1])
            times_s.append(time.perf_counter() - started_s)
        return 1e6 * float(np.median(times_s))


class NearestPresses:
    """Mean pattern of the training presses with the nearest readings, compared in network units.

    Args:
        newest: (m, 3, rows, cols) in zeroed counts.
        patterns: (m, H, W) in [mm].
        count: presses that are averaged for a pattern.
    """

    def __init__(self, newest: NDArray[np.float32], patterns: NDArray[np.float16], count: int) -> None:
        self._known = self._scaled(newest)
        self._squares = np.square(self._known).sum(axis=1)
        self._patterns = patterns
        self._count = count

    def __call__(self, newest: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return patterns (n, H, W) in [mm] of newest taps (n, 3, rows, cols) in zeroed counts."""
        found: list[NDArray[np.float32]] = []
        for start in range(0, len(newest), _AT_ONCE):
            apart = self._squares - 2 * self._scaled(newest[start : start + _AT_ONCE]) @ self._known.T
            nearest = np.argpartition(apart, self._count - 1, axis=1)[:, : self._count]
            found.append(self._patterns[nearest].mean(axis=1, dtype=np.float32))
        return np.concatenate(found)

    @staticmethod
    def _scaled(newest: NDArray[np.floating]) -> NDArray[np.float32]:
        per_unit = np.array(COUNTS_PER_UNIT, dtype=np.float32)[:, None, None]
        return (newest / per_unit).reshape(len(newest), -1).astype(np.float32)


def read_newest(presses: PressSet) -> NDArray[np.float32]:
    """Return the newest taps (n, 3, rows, cols) of presses to fit on; a different sensor reads each press once."""
    return read_presses(presses.with_taps(1), Nuisances(), SEED)[:, 0]


def fit_baselines(training: PressSet, validation: FrozenPresses) -> tuple[list[Baseline], str]:
    """Fit all baselines; whatever is selected is selected on validation.

    Returns:
        The baselines, and a text with the length and noise selected for kriging.
    """
    newest, patterns = read_newest(training), training.patterns.astype(np.float32)
    check, truth = validation.windows(1)[:, 0], validation.patterns()
    gain = fit_gain(bilinear(newest[:, 2], SCALE), patterns)
    matrix = fit_linear_map(newest.reshape(len(newest), -1), patterns.reshape(len(patterns), -1))
    (length_mm, noise), best = _best_kriging(newest, patterns, check, truth)
    methods: Mapping[str, Method] = {
        "bilinear": lambda some: bilinear(some[:, 2], SCALE) * gain,
        "linear map": lambda some: _mapped(some, matrix),
        "nearest press": NearestPresses(newest, training.patterns, 1),
        "nearest 8": NearestPresses(newest, training.patterns, 8),
        "kriging": lambda some: _mapped(some, best),
    }
    fitted: list[Baseline] = []
    for name, run in methods.items():
        found = np.asarray(run(check), dtype=np.float32)
        level = best_contact_level(found, validation.presses.touching)
        fitted.append(Baseline(name, run, level, float(psnr_db(found, truth, MAX_INDENTATION_MM).mean())))
    return fitted, f"a length of {length_mm:g} mm and a noise of {noise:g}"


def _best_kriging(
    newest: NDArray[np.float32],
    patterns: NDArray[np.float32],
    check: NDArray[np.float32],
    truth: NDArray[np.float32],
) -> tuple[tuple[float, float], NDArray[np.float32]]:
    """Return the length and noise with the least error on validation, and the matrix scaled to the training presses."""
    kriging = Kriging(GrippedPad(NOMINAL))
    scores: dict[tuple[float, float], float] = {}
    for length_mm, noise in product(LENGTHS_MM, NOISES):
        found = _mapped(check, kriging.matrix(length_mm, noise))
        found = found * fit_gain(found, truth)
        scores[length_mm, noise] = float(psnr_db(found, truth, MAX_INDENTATION_MM).mean())
    best = max(scores, key=scores.__getitem__)
    matrix = kriging.matrix(*best)
    return best, matrix * np.float32(fit_gain(_mapped(newest, matrix), patterns))


def _mapped(newest: NDArray[np.floating], matrix: NDArray[np.float32]) -> NDArray[np.floating]:
    side = newest.shape[-1] * SCALE
    return (newest.reshape(len(newest), -1) @ matrix).reshape(-1, side, side)
