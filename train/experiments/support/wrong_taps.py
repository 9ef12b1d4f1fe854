"""Windows whose earlier taps do not belong to the newest one, and the outcome of the runtime's guard against them."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.perception.contact_options import ON_COUNTS, RuntimeOptions
from edge.perception.runtime import Model
from train.data.frozen_presses import FrozenPresses
from train.experiments.support.pushed import PushedSensor
from train.physics.simulated_sensor import MAX_INDENTATION_MM

EVERY_TAP: Final = RuntimeOptions(follow_drift=False)
_DEPTHS: Final = (0.85, 1.15)
_SEED: Final = 17


@dataclass(frozen=True, slots=True)
class Windows:
    """n windows of K taps, newest first, as one sensor each has read them.

    Attributes:
        counts: (n, K, 3, rows, cols), zeroed.
        truth: (n, H, W) of the newest tap, in [mm].
    """

    counts: NDArray[np.floating]
    truth: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.counts)


@dataclass(frozen=True, slots=True)
class Guarded:
    """Outcome of the runtime for n windows.

    Attributes:
        psnr_db: (n,) of the patterns.
        taps_used: (n,).
        foreign: (n, K - 1), True where an earlier tap does not belong, by the runtime; empty without a guard.
    """

    psnr_db: NDArray[np.float64]
    taps_used: NDArray[np.int64]
    foreign: NDArray[np.bool_]


def firm(sensors: FrozenPresses) -> FrozenPresses:
    """Return the sequences whose taps all begin a contact, at the least depth of `cases` too."""
    z_counts = sensors.presses.counts[:, :, 2].sum(axis=(2, 3))
    return sensors.pick((_DEPTHS[0] * z_counts > ON_COUNTS * 1.05).all(axis=1))


def cases(sensors: FrozenPresses) -> dict[str, Windows]:
    """Return right windows and wrong ones, by name, of presses that are read by one sensor for each pad."""
    counts, truth = sensors.presses.counts, sensors.patterns()
    newest, earlier = counts[:, :1], counts[:, 1:]
    rng = np.random.default_rng(_SEED)
    depths = rng.uniform(*_DEPTHS, (*earlier.shape[:2], 1, 1, 1)).astype(np.float32)
    mirrored = counts[..., ::-1] * np.array([-1, 1, 1], dtype=np.float32)[:, None, None]
    other = next_of_pad(sensors.presses.pad)
    return {
        "right": Windows(counts, truth),
        "another surface": Windows(np.concatenate([newest, earlier[other]], axis=1), truth),
        "order reversed": Windows(np.concatenate([newest, earlier[:, ::-1]], axis=1), truth),
        # The mirror image of a pad that turns one way is one that turns the other way.
        "turned the other way": Windows(mirrored, truth[..., ::-1]),
        "not turned": Windows(np.concatenate([newest, newest * depths], axis=1), truth),
    }


def twice_the_angle(sensors: FrozenPresses, taps: int) -> dict[str, Windows]:
    """Return the right windows of longer sequences, and those with every second tap left out."""
    counts, truth = sensors.presses.counts, sensors.patterns()
    return {
        "right, longer sequences": Windows(counts[:, :taps], truth),
        "twice the angle": Windows(counts[:, ::2][:, :taps], truth),
    }


def next_of_pad(pads: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return for each press the next one of its pad, or of all where the pad has one alone, (n,)."""
    result = np.roll(np.arange(len(pads)), -1)
    for pad in np.unique(pads):
        mine = np.flatnonzero(pads == pad)
        if len(mine) > 1:
            result[mine] = np.roll(mine, -1)
    return result


def guarded(model: Model, windows: Windows, taps: int) -> Guarded:
    """Push each window through a runtime of its own, the newest tap being inferred."""
    patterns, used, foreign = [], [], []
    for number, counts in enumerate(windows.counts):
        result = PushedSensor(model, seed=number, options=EVERY_TAP).tap(counts[:taps])
        patterns.append(np.asarray(result.pattern))  # there is one, since taps that begin no contact are left out
        used.append(result.taps_used)
        foreign.append([share >= 0.5 for share in result.tap_mismatch or ()])
    return Guarded(
        psnr_db(np.stack(patterns), windows.truth, MAX_INDENTATION_MM), np.array(used), np.array(foreign, dtype=bool)
    )
