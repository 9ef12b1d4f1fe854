"""Batches of presses: a different sensor reads each window, with a random part of its constants as network input."""

from dataclasses import replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from train.data.batches import Batch, network_input
from train.data.presses import PressSet
from train.errors import DatasetError
from train.physics.pad_draws import known_numbers
from train.physics.sensor_noise import Nuisances, read_windows

_NOTHING: Final = 0.35
_ALL: Final = 0.35
"""Shares of windows with no or all constants of the pad as input; in the others each is drawn with probability .5."""
_GAIN_SPREADS: Final = ((0.4, 1.0), (0.15, 1.6), (0.15, 0.1), (0.15, 0.3), (0.15, 0.6))
"""Share of windows, and the spread of their gains over that of a new sensor.

The first two are new sensors, the second kind wider than most; in the others calibration leaves a tenth to three fifths
of the spread, which the certainty of the gains states.
"""
_SURE: Final = 0.1
"""Standard deviation of a constant used as input, over its spread: error that calibration leaves."""


class PressBatches:
    """Batches of windows, pad inputs, and truth.

    Args:
        presses: some of them with all K taps; windows of one tap are drawn from sequences with fewer taps where these
            exist, because they are many more.
        given: share of windows with 1, 2, ... K taps; older taps are dropped.
        batch: windows in a batch.
        seed: of all draws.
        nuisances: of the sensors.
        mirror: mirror half of the windows, where K is 1.

    Raises:
        DatasetError: there are no presses of K taps.
    """

    def __init__(
        self,
        presses: PressSet,
        given: tuple[float, ...],
        batch: int,
        seed: int,
        nuisances: Nuisances | None = None,
        *,
        mirror: bool = True,
    ) -> None:
        taps = len(given)
        self._presses = presses.with_taps(taps)
        whole = self._presses.counts[:, -1].any(axis=(1, 2, 3)) & (presses.taps >= taps)
        if not whole.any():
            raise DatasetError(
                f"no sequences of {taps} taps: make some with 'python -m train.data.make_presses --taps'"
            )
        self._given = given
        batch = min(batch, len(presses))
        single = 0 if whole.all() else round(given[0] * batch)
        counts = ((np.flatnonzero(~whole), single), (np.flatnonzero(whole), batch - single))
        self._parts = [_Part(rows, count, [seed, 0, number]) for number, (rows, count) in enumerate(counts) if count]
        self._single = single
        self._seed, self._mirror = seed, mirror
        self._nuisances = Nuisances(dead_taxels=0.02) if nuisances is None else nuisances

    def __call__(self, number: int) -> Batch:
        """Return the batch of a number."""
        rng = np.random.default_rng([self._seed, 1, number])
        index = np.concatenate([part(number) for part in self._parts])
        picked = self._presses.pick(index)
        readings, certainty = read_by_many(rng, picked, self._nuisances)
        taps = len(self._given)
        there = np.ones(len(index), dtype=np.int64)
        shares = np.array(self._given)
        shares[0] *= not self._single
        if self._single < len(index):
            there[self._single :] += rng.choice(taps, size=len(index) - self._single, p=shares / shares.sum())
        readings *= (np.arange(taps) < there[:, None])[..., None, None, None]
        batch = Batch(
            window=network_input(readings),
            pattern=torch.from_numpy(picked.patterns.astype(np.float32)),
            pad=torch.from_numpy(known_of_pads(rng, picked.constants, certainty)),
            traction=torch.from_numpy(picked.traction_kpa.astype(np.float32)),
        )
        if taps > 1 or not self._mirror:  # a mirrored pad would turn the other way from tap to tap
            return batch
        return batch.mirrored(torch.from_numpy(rng.random(len(index)) < 0.5))


class _Part:
    """Rows for one part of every batch: each row once in each epoch, except for those that do not fill a batch."""

    def __init__(self, rows: NDArray[np.int64], count: int, seed: list[int]) -> None:
        self._rows, self._count, self._seed = rows, min(count, len(rows)), seed
        self._epoch, self._order = -1, rows

    def __call__(self, number: int) -> NDArray[np.int64]:
        """Return the rows of the batch of a number, (count,)."""
        epoch, place = divmod(number, len(self._rows) // self._count)
        if epoch != self._epoch:
            self._order = np.random.default_rng([*self._seed, epoch]).permutation(self._rows)
            self._epoch = epoch
        return self._order[place * self._count :][: self._count]


def read_presses(presses: PressSet, nuisances: Nuisances, seed: int) -> NDArray[np.float32]:
    """Return windows (n, K, 3, rows, cols) in whole zeroed counts at the ends of presses; absent taps stay 0."""
    readings = read_windows(presses.counts[:, :, None], 1.0, nuisances, seed, angle_deg=presses.angle_deg)
    absent = ~presses.counts.any(axis=(2, 3, 4))
    readings[absent] = 0
    return readings


def read_by_many(
    rng: np.random.Generator, presses: PressSet, nuisances: Nuisances
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return windows (n, K, 3, rows, cols) in counts, each of another sensor, and the certainty (n,) of its gains."""
    certainty = np.zeros(len(presses), dtype=np.float32)
    readings = np.empty_like(presses.counts)
    ends = np.rint(np.cumsum([share for share, _ in _GAIN_SPREADS]) * len(presses)).astype(int)[:-1]
    for part, (_, spread) in zip(np.split(rng.permutation(len(presses)), ends), _GAIN_SPREADS, strict=True):
        if len(part):
            certainty[part] = max(1 - spread, 0)
            new = Nuisances() if spread < 1 else nuisances
            drawn = replace(nuisances, gain_spread=spread * new.gain_spread)
            readings[part] = read_presses(presses.pick(part), drawn, int(rng.integers(2**62)))
    return readings, certainty


def known_of_pads(
    rng: np.random.Generator, constants: NDArray[np.float32], certainty: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return pad inputs (n, width) with none, all or some of the constants, drawn as in training."""
    toss = rng.random(len(constants))[:, None]
    coins = rng.random(constants.shape) < 0.5
    known = np.where(toss < _NOTHING, False, (toss < _NOTHING + _ALL) | coins)
    unsure = (_SURE * rng.standard_normal(constants.shape).astype(np.float32)).astype(np.float32)
    return known_numbers(constants + unsure, known, certainty)
