"""Batches to train on: each depends on its number alone, so that an interrupted run resumes with the same batches."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from train.data.batch import Batch
from train.data.dataset import Sequences, quarter_turns, turns_of, windows
from train.physics.sensor_noise import Nuisances
from train.surfaces.named_surfaces import is_random_figure

COUNTS_PER_UNIT: Final = (500.0, 500.0, 1000.0)
"""Counts of x, y, z that make one unit of network input."""

_SET_FORCE_SPREAD: Final = (0.85, 1.15)
"""Bounds of the spread of set forces: a robot does not end every tap at the same force."""


@dataclass(frozen=True, slots=True)
class Draw:
    """Settings by which windows are drawn from sequences of taps.

    Attributes:
        set_force_n: bounds of the force at which taps end, in [N].
        depth_share: bounds of the completed share of the newest tap.
        nuisances: of the sensors, one for every window.
        figure_share: share of windows with random figures; None: their share of the sequences.
    """

    set_force_n: tuple[float, float] = (1.5, 8.0)
    depth_share: tuple[float, float] = (0.15, 1.0)
    nuisances: Nuisances = field(default_factory=lambda: Nuisances(dead_taxels=0.02))
    figure_share: float | None = None


class WindowBatches:
    """Batches of windows and patterns.

    Args:
        sequences: with the truth at the network's scale, of at least as many taps as it takes.
        draw: settings of the draw.
        given: share of windows with 1, 2, ... K taps; older taps are dropped.
        batch: windows in a batch.
        seed: of all draws.

    Raises:
        ValueError: a share of figures is not between 0 and 1, or the sequences are all figures or have no figure.
    """

    def __init__(self, sequences: Sequences, draw: Draw, given: tuple[float, ...], batch: int, seed: int) -> None:
        self._sequences = sequences.newest(len(given))
        self._draw = draw
        self._given = given
        self._batch = min(batch, len(sequences))
        self._seed = seed
        self._streams = _streams(sequences.surfaces, draw, seed)

    def __call__(self, number: int) -> Batch:
        """Return the batch of a number, without pad inputs."""
        readings, patterns = self.draw(number)
        return Batch(network_input(readings), torch.from_numpy(patterns))

    def draw(self, number: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return windows (batch, K, 3, rows, cols) in zeroed counts and patterns (batch, H, W) in [mm]."""
        index = self.index(number)
        rng = np.random.default_rng([self._seed, 1, number])
        taps = len(self._given)
        force_n = rng.uniform(*self._draw.set_force_n, (len(index), 1))
        force_n = force_n * rng.uniform(*_SET_FORCE_SPREAD, (len(index), taps))
        share = rng.uniform(*self._draw.depth_share, len(index))
        readings, patterns = windows(
            self._sequences, index, share, force_n, self._draw.nuisances, int(rng.integers(2**62))
        )
        given = rng.choice(np.arange(1, taps + 1), size=len(index), p=self._given)
        readings *= (np.arange(taps) < given[:, None])[..., None, None, None]
        readings, patterns = quarter_turns(readings, patterns, turns_of(readings, int(rng.integers(4))))
        return np.ascontiguousarray(readings), np.ascontiguousarray(patterns)

    def index(self, number: int) -> NDArray[np.int64]:
        """Return the sequences of a batch, (batch,)."""
        if self._draw.figure_share is None:
            (everything,) = self._streams
            epoch, part = divmod(number, len(everything) // self._batch)  # all batches are whole
            return everything.take(epoch * len(everything) + part * self._batch, self._batch)
        others, figures = self._streams
        first, end = (int(at * self._batch * self._draw.figure_share) for at in (number, number + 1))
        return np.concatenate(
            [others.take(number * self._batch - first, self._batch - (end - first)), figures.take(first, end - first)]
        )


class _Stream:
    """Endless stream of sequence indices (n,), in another order in each epoch."""

    def __init__(self, index: NDArray[np.int64], seed: list[int]) -> None:
        self._index, self._seed = index, seed
        self._epoch = -1
        self._order: NDArray[np.int64] = np.empty(0, dtype=np.int64)

    def __len__(self) -> int:
        return len(self._index)

    def take(self, first: int, count: int) -> NDArray[np.int64]:
        """Return `count` of them, from a place in the stream."""
        epoch, start = divmod(first, len(self))
        if epoch != self._epoch:
            self._order = self._index[np.random.default_rng([*self._seed, epoch]).permutation(len(self))]
            self._epoch = epoch
        found = self._order[start : start + count]
        return (
            found if len(found) == count else np.concatenate([found, self.take(first + len(found), count - len(found))])
        )


def _streams(surfaces: NDArray[np.str_], draw: Draw, seed: int) -> list[_Stream]:
    everything = np.arange(len(surfaces))
    if draw.figure_share is None:
        return [_Stream(everything, [seed, 0])]
    if not 0 < draw.figure_share < 1:
        raise ValueError(f"a share of figures of {draw.figure_share}, expected one between 0 and 1")
    figures = np.array([is_random_figure(name) for name in surfaces], dtype=bool)
    if figures.all() or not figures.any():
        raise ValueError(
            f"{draw.figure_share:.0%} of the windows are to be of random figures, but of {len(figures)} sequences "
            f"{figures.sum()} are"
        )
    return [_Stream(everything[~figures], [seed, 2]), _Stream(everything[figures], [seed, 3])]


def network_input(window_counts: NDArray[np.float32]) -> torch.Tensor:
    """Convert windows (n, K, 3, rows, cols) in zeroed counts to network input (n, 3K, rows, cols)."""
    per_unit = np.array(COUNTS_PER_UNIT, dtype=np.float32)[:, None, None]
    return torch.from_numpy((window_counts / per_unit).reshape(len(window_counts), -1, *window_counts.shape[3:]))
