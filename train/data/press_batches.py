"""Batches of presses: a different sensor reads each window, with a random part of its constants as network input."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from firmware_bridge.scans.pad_constants import GAIN_SPREAD
from train.data.presses import PressSet
from train.errors import DatasetError
from train.physics.pad_draws import known_numbers
from train.physics.sensor_noise import Nuisances, apply_nuisances, log_uniform

COUNTS_PER_UNIT: Final = (500.0, 500.0, 1000.0)  # counts of x, y, z that make one unit of network input
_MIRRORED = torch.tensor([-1.0, 1.0, -1.0, 1.0, 1.0])  # signs of a pose's x, y, turn and errors in a mirror image


@dataclass(frozen=True, slots=True)
class Batch:
    """Windows and their truth."""

    window: Tensor  # (n, 3K, rows, cols) in network units
    pattern: Tensor  # (n, H, W) in [mm]
    pad: Tensor | None = None  # (n, known), inputs of the pads
    traction: Tensor | None = None  # (n, 3, h, w) in [kPa], NaN where unknown; None if it is not trained on
    poses: Tensor | None = None  # (n, K, 5) of the taps in the newest one's axes, with their errors; None: a schedule

    def mirrored(self, which: Tensor) -> "Batch":
        """Return the batch with mirror images, left for right, of some windows, (n,) of bool."""

        def flipped(maps: Tensor, vectors: bool) -> Tensor:
            image = maps.flip(-1)
            if vectors:
                image[:, ::3] *= -1  # x points the other way
            return torch.where(which.view(-1, *[1] * (maps.ndim - 1)), image, maps)

        return replace(
            self,
            window=flipped(self.window, True),
            pattern=flipped(self.pattern, False),
            traction=None if self.traction is None else flipped(self.traction, True),
            poses=None if self.poses is None else torch.where(which[:, None, None], self.poses * _MIRRORED, self.poses),
        )

    def to(self, device: torch.device) -> "Batch":
        """Return the batch on a device."""
        parts = {one.name: getattr(self, one.name) for one in fields(self)}
        return replace(self, **{name: part.to(device) for name, part in parts.items() if part is not None})


def network_input(window_counts: NDArray[np.float32]) -> Tensor:
    """Convert windows (n, K, 3, rows, cols) in zeroed counts to network input (n, 3K, rows, cols)."""
    return torch.from_numpy(in_units(window_counts).reshape(len(window_counts), -1, *window_counts.shape[3:]))


def in_units(counts: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return readings (..., 3, rows, cols) in counts as those in network units."""
    return counts / np.array(COUNTS_PER_UNIT, dtype=np.float32)[:, None, None]


_NOTHING, _ALL = 0.35, 0.35  # shares of windows with no or all constants of the pad as input; else a half of each
# Share of windows, and the spread of their gains over that of a new sensor: two kinds of new sensors, the second wider
# than most; of the others calibration leaves a tenth to three fifths, which the certainty of the gains states.
_GAIN_SPREADS: Final = ((0.4, 1.0), (0.15, 1.6), (0.15, 0.1), (0.15, 0.3), (0.15, 0.6))
_NEW_SENSORS: Final = Nuisances(dead_taxels=0.02)
_TOLD: Final = 0.75  # share of windows in which a network of one sensor is told of it; else it has to know by itself


@dataclass(frozen=True, slots=True)
class OneSensor:
    """The one sensor that a network is for."""

    row: tuple[float, ...]  # what the network is told of it, as the runtime makes it from the sensor file, (KNOWN,)
    gain_spread: float  # that is left once readings were divided by its gains, over that of a new sensor
    made_for: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # as in a contract

    @property
    def nuisances(self) -> Nuisances:
        """Nuisances of its readings once they were divided by its gains."""
        return replace(Nuisances(), gain_spread=self.gain_spread * GAIN_SPREAD)

    def rows(self, rng: np.random.Generator, count: int) -> NDArray[np.float32]:
        """Return pad inputs (count, KNOWN): in most windows this row, in the others nothing."""
        told = rng.random((count, 1)) < _TOLD
        return (told * np.array(self.row)).astype(np.float32)


class PressBatches:
    """Batches of windows, pad inputs, and truth; windows of one tap are mirrored, half of them.

    `given` is the share of windows with 1, 2, ... K taps. DatasetError if there are no presses of K taps.
    """

    def __init__(
        self,
        presses: PressSet,
        given: tuple[float, ...],
        batch: int,
        seed: int,
        nuisances: Nuisances = _NEW_SENSORS,
        sensor: OneSensor | None = None,
    ) -> None:
        taps = len(given)
        self._presses = presses.with_taps(taps)
        whole = self._presses.counts[:, -1].any(axis=(1, 2, 3)) & (presses.taps >= taps)
        if not whole.any():
            raise _lacking(taps)
        self._given, self._seed, self._nuisances, self._sensor = np.array(given), seed, nuisances, sensor
        self._rows, self._batch = np.flatnonzero(whole), min(batch, len(presses))

    def __call__(self, number: int) -> Batch:
        """Return the batch of a number."""
        rng = np.random.default_rng([self._seed, 1, number])
        index = _rows_of_batch(number, self._rows, self._batch, [self._seed, 0, 1])
        picked = self._presses.pick(index)
        readings, certainty = read_by_many(rng, picked, self._nuisances, self._sensor)
        taps = len(self._given)
        there = 1 + rng.choice(taps, size=len(index), p=self._given / self._given.sum())
        readings *= (np.arange(taps) < there[:, None])[..., None, None, None]
        batch = _batch(rng, picked, readings, certainty, self._sensor)
        if taps > 1:  # a mirrored pad would turn the other way from tap to tap
            return batch
        return batch.mirrored(torch.from_numpy(rng.random(len(index)) < 0.5))


def with_own_taps(
    batches: Callable[[int], Batch], taps: PressSet, sensor: OneSensor, seed: int
) -> Callable[..., Batch]:
    """Return batches in which a third of the windows are a sensor's own taps, which no mirror image belongs to."""
    # Their gains and lags are the sensor's; drift, the earth's field and noise differ from tap to tap.
    left = sensor.nuisances.without("hysteresis", "cross_talk", "gain_spread", "saturation_counts")

    def mixed(number: int) -> Batch:
        world, rng = batches(number), np.random.default_rng([seed, 3, number])
        picked = taps.pick(_rows_of_batch(number, np.arange(len(taps)), len(world.window) // 2, [seed, 4]))
        readings = read_presses(picked, left, int(rng.integers(2**62)))
        own = _batch(rng, picked, readings, np.empty(0, dtype=np.float32), sensor)
        parts = {one: (getattr(world, one), getattr(own, one)) for one in ("window", "pattern", "pad", "traction")}
        return Batch(**{name: torch.cat(both) for name, both in parts.items()})

    return mixed


def _lacking(taps: int) -> DatasetError:
    return DatasetError(f"no sequences of {taps} taps: make some with 'python -m train.data.make_presses --taps'")


def _batch(
    rng: np.random.Generator,
    presses: PressSet,
    readings: NDArray[np.float32],
    certainty: NDArray[np.float32],
    sensor: OneSensor | None = None,
) -> Batch:
    pads = known_of_pads(rng, presses.constants, certainty) if sensor is None else sensor.rows(rng, len(presses))
    return Batch(
        window=network_input(readings),
        pattern=torch.from_numpy(presses.patterns.astype(np.float32)),
        pad=torch.from_numpy(pads),
        traction=torch.from_numpy(presses.traction_kpa.astype(np.float32)),
    )


def _rows_of_batch(number: int, rows: NDArray[np.int64], count: int, seed: list[int]) -> NDArray[np.int64]:
    """Return some of the rows: each once in each epoch, except for those that do not fill a batch."""
    count = min(count, len(rows))
    epoch, place = divmod(number, len(rows) // count)
    return np.random.default_rng([*seed, epoch]).permutation(rows)[place * count :][:count]


def read_presses(presses: PressSet, nuisances: Nuisances, seed: int) -> NDArray[np.float32]:
    """Return windows (n, K, 3, rows, cols) in whole zeroed counts at the ends of presses; absent taps stay 0."""
    readings = apply_nuisances(presses.counts[:, :, None], nuisances, seed, angle_deg=presses.angle_deg)[:, :, 0]
    absent = ~presses.counts.any(axis=(2, 3, 4))
    readings[absent] = 0
    return readings


def read_by_many(
    rng: np.random.Generator, presses: PressSet, nuisances: Nuisances, sensor: OneSensor | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return windows (n, K, 3, rows, cols) in counts, each of another sensor, and the certainty (n,) of its gains."""
    certainty = np.zeros(len(presses), dtype=np.float32)
    readings = np.empty_like(presses.counts)
    spreads = _GAIN_SPREADS if sensor is None else ((1.0, sensor.gain_spread),)
    ends = np.rint(np.cumsum([share for share, _ in spreads]) * len(presses)).astype(int)[:-1]
    for part, (_, spread) in zip(np.split(rng.permutation(len(presses)), ends), spreads, strict=True):
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
    # A tenth of a constant's spread is the error that calibration leaves.
    unsure = (0.1 * rng.standard_normal(constants.shape).astype(np.float32)).astype(np.float32)
    return known_numbers(constants + unsure, known, certainty)


class PosedBatches:
    """Batches of windows of one number of taps each, with poses and pad inputs; DatasetError if there are none."""

    def __init__(self, presses: PressSet, given: tuple[float, ...], batch: int, seed: int) -> None:
        self._presses, self._seed = presses, seed
        self._given = np.array(given) / sum(given)
        there = presses.counts.any(axis=(2, 3, 4)).sum(axis=1)
        self._rows = [np.flatnonzero(there >= taps) for taps in range(1, len(given) + 1)]
        self._single = np.flatnonzero(there == 1)
        self._batch = min(batch, len(presses))
        for taps, rows in enumerate(self._rows, 1):
            if given[taps - 1] and not len(rows):
                raise _lacking(taps)

    def __call__(self, number: int) -> Batch:
        """Return the batch of a number."""
        rng = np.random.default_rng([self._seed, 2, number])
        taps = 1 + int(rng.choice(len(self._given), p=self._given))
        rows = self._rows[taps - 1]
        # Most batches of one tap are drawn from presses of one tap, if there are any: they are many more.
        if taps == 1 and len(self._single) and rng.random() < 0.7:
            rows = self._single
        picked = self._presses.pick(rng.choice(rows, self._batch, replace=len(rows) < self._batch))
        picked = _some_of(rng, picked, taps)
        batch = _batch(rng, picked, *read_by_many(rng, picked, _NEW_SENSORS))
        batch = replace(batch, poses=torch.from_numpy(stated_poses(rng, picked.poses)))
        return batch.mirrored(torch.from_numpy(rng.random(len(picked)) < 0.5))


def stated_poses(
    rng: np.random.Generator, poses: NDArray[np.float32], errors: tuple[float, float] | None = None
) -> NDArray[np.float32]:
    """Return true poses (n, K, 3) as a robot states them, (n, K, 5): off by errors, whose sizes come last.

    Standard deviations `errors` in [mm] and [deg] are stated and kept to; without them they are drawn as in training.
    """
    shape = (*poses.shape[:2], 1)
    if errors is None:
        one = (len(poses), 1, 1)
        # In [mm] and [deg].
        size = np.concatenate([log_uniform(rng, *bounds, one) for bounds in ((0.05, 1.5), (0.3, 6.0))], axis=2)
    else:
        size = np.broadcast_to(np.array(errors), (len(poses), 1, 2))
    size = np.repeat(size, shape[1], axis=1)
    off = rng.standard_normal(poses.shape).clip(-2, 2) * size[..., [0, 0, 1]]
    if errors is None:
        astray = rng.standard_normal(poses.shape) * (2.0, 2.0, 8.0)
        # Some are farther off than stated, by several of the largest stated errors.
        off = np.where(rng.random(shape) < 0.04, astray, off)
    stated = np.concatenate([poses + off, size], axis=2)
    stated[:, 0] = 0
    return stated.astype(np.float32)


def _some_of(rng: np.random.Generator, presses: PressSet, taps: int) -> PressSet:
    """Return sequences with `taps` taps each, the newest among them."""
    # Half of the batches keep a sequence's newest taps; in the others any of its earlier taps are left out.
    if taps == presses.taps or rng.random() < 0.5:
        return presses.with_taps(taps)
    there = presses.counts.any(axis=(2, 3, 4))
    rank = np.where(there, rng.random(there.shape), 2.0)
    rank[:, 0] = -1
    kept = np.sort(np.argsort(rank, axis=1)[:, :taps], axis=1)
    rows = np.arange(len(presses))[:, None]
    parts = {name: getattr(presses, name)[rows, kept] for name in ("counts", "angle_deg", "poses")}
    return replace(presses, **parts)
