"""Check that separates earlier taps of the same contact from taps of another contact or another pose."""

from dataclasses import replace
from itertools import combinations, permutations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.familiarity import Check, tap_features
from edge.inference.small_network import SmallNetwork
from edge.perception.pattern_check import LEAST_COUNTS
from train.data.batches import COUNTS_PER_UNIT
from train.data.press_batches import read_presses
from train.data.presses import PressSet
from train.learning.contact_check import limit_of, moved
from train.learning.small_classifier import fit_classifier
from train.physics.sensor_noise import Nuisances

_ROUNDS: Final = 4
"""Readings of each sequence, and of its mirror image, each by another sensor."""
_WIDTHS: Final = (192, 96)
_WEIGHT_DECAY: Final = 0.3
"""So much, because sequences of several taps are few: with a hundredth of it limits rose to seven and more."""
_DEPTHS: Final = (0.85, 1.15)
_UNIT: Final = np.array(COUNTS_PER_UNIT, dtype=np.float32)[:, None, None]


def fit_tap_network(presses: PressSet, seed: int, steps: int) -> SmallNetwork:
    """Fit the network to taps turned as the schedule states, and to others.

    Args:
        presses: sequences of several taps.
        seed: of nuisances, draws and weights.
        steps: of the optimizer.
    """
    rng = np.random.default_rng([seed, 5])
    both = presses, seen_in_a_mirror(presses)
    right, wrong = [], []
    for number in range(2 * _ROUNDS):
        # Turns keep the direction of the schedule, mirror images alone would not.
        windows = moved(rng, read_twice(both[number % 2], seed + number), mirror=False)
        taps = presses.taps
        for newest, earlier in combinations(range(taps), 2):
            pair, claimed = (windows[:, newest], windows[:, earlier]), earlier - newest
            right.append(pair_features(*pair, claimed))
            wrong.append(pair_features(pair[0], pair[1][rng.permutation(len(windows))], claimed))
            wrong.append(pair_features(pair[1], pair[0], claimed))  # turned back
        for claimed in range(1, taps):
            wrong.append(pair_features(windows[:, 0], windows[:, taps], claimed))  # not turned
        for claimed, true in permutations(range(1, taps), 2):
            if abs(claimed - true) > 1 or claimed == 1:
                wrong.append(pair_features(windows[:, 0], windows[:, true], claimed))
    return fit_classifier(np.concatenate(right), np.concatenate(wrong), _WIDTHS, steps, seed, _WEIGHT_DECAY)


def seen_in_a_mirror(presses: PressSet) -> PressSet:
    """Return the readings of the sequences' mirror images, the last tap first: so they turn as the schedule does."""
    signs = np.array([-1, 1, 1], dtype=np.float32)[:, None, None]
    counts = np.ascontiguousarray(presses.counts[:, ::-1, :, :, ::-1] * signs)
    return replace(presses, counts=counts, angle_deg=-presses.angle_deg[:, ::-1])


def read_twice(presses: PressSet, seed: int) -> NDArray[np.float32]:
    """Return windows (n, K + 1, 3, rows, cols) in counts; the last tap is the newest again, at another depth.

    Only sequences whose taps are all strong enough are kept.
    """
    depth = np.random.default_rng([seed, 6]).uniform(*_DEPTHS, (len(presses), 1, 1, 1)).astype(np.float32)
    counts = np.concatenate([presses.counts, (presses.counts[:, 0] * depth)[:, None]], axis=1)
    angles = np.concatenate([presses.angle_deg, presses.angle_deg[:, :1]], axis=1)
    windows = read_presses(replace(presses, counts=counts, angle_deg=angles), Nuisances(), seed)
    return windows[(windows[:, :, 2].max(axis=(2, 3)) > LEAST_COUNTS).all(axis=1)]


def pair_features(newest: NDArray[np.float32], earlier: NDArray[np.float32], steps: int) -> NDArray[np.float32]:
    """Return the features (n, inputs) of pairs of taps, both (n, 3, rows, cols) in counts."""
    pairs = np.stack([newest, earlier], axis=1) / _UNIT
    return np.concatenate([tap_features(pair, (steps,)) for pair in pairs])


def tap_check(network: SmallNetwork, presses: PressSet, false_alarms: float, seed: int = 0) -> Check:
    """Return the check whose limit a share of the earlier taps of these presses exceeds."""
    windows = read_twice(presses, seed)
    rows = [pair_features(windows[:, 0], windows[:, steps], steps) for steps in range(1, presses.taps)]
    return Check(network, limit_of(np.array(network(np.concatenate(rows))), false_alarms))
