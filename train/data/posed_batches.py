"""Batches of taps from drawn poses: every batch has one number of taps, and poses with errors of a stated size."""

from dataclasses import replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from train.data.batches import Batch, network_input
from train.data.press_batches import known_of_pads, read_by_many
from train.data.presses import PressSet
from train.errors import DatasetError
from train.physics.sensor_noise import Nuisances

_SINGLE: Final = 0.7
"""Share of batches of one tap that are drawn from presses of one tap, if there are any: they are many more."""
_AS_MADE: Final = 0.5
"""Share of batches that keep a sequence's newest taps; in the others any of its earlier taps are left out."""
_ERRORS_MM: Final = (0.05, 1.5)
_ERRORS_DEG: Final = (0.3, 6.0)
"""Bounds of the stated errors of a window's poses, drawn evenly by their logarithms."""
_ASTRAY: Final = 0.04
"""Share of earlier taps that are farther off than stated: by several of the largest stated errors."""
_ASTRAY_MM: Final = 2.0
_ASTRAY_DEG: Final = 8.0


class PosedBatches:
    """Batches of windows with poses, pad inputs, and truth.

    Raises:
        DatasetError: there are no presses of so many taps.
    """

    def __init__(
        self,
        presses: PressSet,
        given: tuple[float, ...],
        batch: int,
        seed: int,
        nuisances: Nuisances | None = None,
    ) -> None:
        self._presses, self._seed = presses, seed
        self._nuisances = Nuisances(dead_taxels=0.02) if nuisances is None else nuisances
        self._given = np.array(given) / sum(given)
        there = presses.counts.any(axis=(2, 3, 4)).sum(axis=1)
        self._rows = [np.flatnonzero(there >= taps) for taps in range(1, len(given) + 1)]
        self._single = np.flatnonzero(there == 1)
        self._batch = min(batch, len(presses))
        lacking = [taps for taps, rows in enumerate(self._rows, 1) if given[taps - 1] and not len(rows)]
        if lacking:
            raise DatasetError(
                f"no sequences of {lacking[0]} taps: make some with 'python -m train.data.make_presses --taps'"
            )

    def __call__(self, number: int) -> Batch:
        """Return the batch of a number."""
        rng = np.random.default_rng([self._seed, 2, number])
        taps = 1 + int(rng.choice(len(self._given), p=self._given))
        rows = self._rows[taps - 1]
        if taps == 1 and len(self._single) and rng.random() < _SINGLE:
            rows = self._single
        picked = self._presses.pick(rng.choice(rows, self._batch, replace=len(rows) < self._batch))
        picked = _some_of(rng, picked, taps)
        readings, certainty = read_by_many(rng, picked, self._nuisances)
        batch = Batch(
            window=network_input(readings),
            pattern=torch.from_numpy(picked.patterns.astype(np.float32)),
            pad=torch.from_numpy(known_of_pads(rng, picked.constants, certainty)),
            traction=torch.from_numpy(picked.traction_kpa.astype(np.float32)),
            poses=torch.from_numpy(stated_poses(rng, picked.poses)),
        )
        return batch.mirrored(torch.from_numpy(rng.random(len(picked)) < 0.5))


def stated_poses(
    rng: np.random.Generator, poses: NDArray[np.float32], errors: tuple[float, float] | None = None
) -> NDArray[np.float32]:
    """Return true poses (n, K, 3) as a robot states them, (n, K, 5): off by errors, whose sizes come last.

    Args:
        rng: draws the errors.
        poses: of the taps in the newest one's axes, newest first.
        errors: standard deviations in [mm] and [deg], stated and kept to; None to draw them as in training.
    """
    shape = (*poses.shape[:2], 1)
    if errors is None:
        size = np.concatenate([_spread(rng, bounds, len(poses)) for bounds in (_ERRORS_MM, _ERRORS_DEG)], axis=2)
    else:
        size = np.broadcast_to(np.array(errors), (len(poses), 1, 2))
    size = np.repeat(size, shape[1], axis=1)
    off = rng.standard_normal(poses.shape).clip(-2, 2) * size[..., [0, 0, 1]]
    if errors is None:
        astray = rng.standard_normal(poses.shape) * (_ASTRAY_MM, _ASTRAY_MM, _ASTRAY_DEG)
        off = np.where(rng.random(shape) < _ASTRAY, astray, off)
    stated = np.concatenate([poses + off, size], axis=2)
    stated[:, 0] = 0
    return stated.astype(np.float32)


def _spread(rng: np.random.Generator, bounds: tuple[float, float], count: int) -> NDArray[np.float64]:
    low, high = np.log(bounds)
    return np.exp(rng.uniform(low, high, (count, 1, 1)))


def _some_of(rng: np.random.Generator, presses: PressSet, taps: int) -> PressSet:
    """Return sequences with `taps` taps each, the newest among them."""
    if taps == presses.taps or rng.random() < _AS_MADE:
        return presses.with_taps(taps)
    there = presses.counts.any(axis=(2, 3, 4))
    rank = np.where(there, rng.random(there.shape), 2.0)
    rank[:, 0] = -1
    kept = np.sort(np.argsort(rank, axis=1)[:, :taps], axis=1)
    rows = np.arange(len(presses))[:, None]
    parts = {name: getattr(presses, name)[rows, kept] for name in ("counts", "angle_deg", "poses")}
    return replace(presses, **parts)
