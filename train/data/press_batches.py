"""Batches of presses: each window is read by a sensor of its own, of which more or less is known."""

from dataclasses import replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from train.batches import network_input
from train.data.batch import Batch
from train.data.presses import PressSet
from train.nuisances import Nuisances, read_windows
from train.physics.pads import known_numbers

_NOTHING: Final = 0.35
_ALL: Final = 0.35
"""Shares of windows of whose pads nothing or all is known; of the others each constant is by a toss of a coin."""
_GAINS: Final = 0.45
"""Share of windows whose sensor's gains are known."""
_SURE: Final = 0.1
"""Standard deviation of a known constant, over its spread: what calibration leaves open."""
_LEFT_GAIN: Final = 0.015
"""Standard deviation of a gain that is known: what calibration leaves open."""


class PressBatches:
    """Batches of windows, what is known of their pads, and their truth.

    Args:
        presses: to draw from.
        given: share of windows with 1, 2, ... K taps given, older ones dropped.
        batch: windows in a batch.
        seed: of everything that is drawn.
        nuisances: of the sensors.
    """

    def __init__(
        self,
        presses: PressSet,
        given: tuple[float, ...],
        batch: int,
        seed: int,
        nuisances: Nuisances | None = None,
    ) -> None:
        self._presses = presses.with_taps(len(given))
        self._given = given
        self._batch = min(batch, len(presses))
        self._seed = seed
        self._nuisances = Nuisances(dead_taxels=0.02) if nuisances is None else nuisances
        self._epoch = -1
        self._order: NDArray[np.int64] = np.empty(0, dtype=np.int64)

    def __call__(self, number: int) -> Batch:
        """The batch of a number."""
        rng = np.random.default_rng([self._seed, 1, number])
        index = self._index(number)
        picked = self._presses.pick(index)
        gains_known = np.arange(len(index)) < round(_GAINS * len(index))  # the order is random already
        readings = np.concatenate(
            [
                read_presses(picked.pick(part), nuisances, int(rng.integers(2**62)))
                for part, nuisances in (
                    (gains_known, replace(self._nuisances, gain_spread=_LEFT_GAIN)),
                    (~gains_known, self._nuisances),
                )
                if part.any()
            ]
        )
        taps = len(self._given)
        there = rng.choice(np.arange(1, taps + 1), size=len(index), p=self._given)
        readings *= (np.arange(taps) < there[:, None])[..., None, None, None]
        return Batch(
            window=network_input(readings),
            pattern=torch.from_numpy(picked.patterns.astype(np.float32)),
            pad=torch.from_numpy(self._known(rng, picked.constants, gains_known)),
            traction=torch.from_numpy(picked.traction_kpa.astype(np.float32)),
        )

    @staticmethod
    def _known(
        rng: np.random.Generator, constants: NDArray[np.float32], gains_known: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        toss = rng.random(len(constants))[:, None]
        coins = rng.random(constants.shape) < 0.5
        known = np.where(toss < _NOTHING, False, (toss < _NOTHING + _ALL) | coins)
        unsure = (_SURE * rng.standard_normal(constants.shape).astype(np.float32)).astype(np.float32)
        return known_numbers(constants + unsure, known, gains_known)

    def _index(self, number: int) -> NDArray[np.int64]:
        """The sequences of a batch, (batch,): all of them once in each epoch, but for what does not fill a batch."""
        epoch, part = divmod(number, len(self._presses) // self._batch)
        if epoch != self._epoch:
            self._order = np.random.default_rng([self._seed, 0, epoch]).permutation(len(self._presses))
            self._epoch = epoch
        return self._order[part * self._batch :][: self._batch]


def read_presses(presses: PressSet, nuisances: Nuisances, seed: int) -> NDArray[np.float32]:
    """Windows (n, K, 3, rows, cols) in whole zeroed counts, each read at the end of its presses; absent taps stay 0."""
    readings = read_windows(presses.counts[:, :, None], 1.0, nuisances, seed, angle_deg=presses.angle_deg)
    absent = ~presses.counts.any(axis=(2, 3, 4))
    readings[absent] = 0
    return readings
