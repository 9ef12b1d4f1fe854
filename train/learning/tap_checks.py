"""Check that separates earlier taps of a contact from taps of another one or at another pose."""

from itertools import permutations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.small_network import SmallNetwork
from edge.inference.trust import Check, pair_width, pose_tap_features
from edge.perception.pattern_check import LEAST_COUNTS
from train.data.press_batches import in_units, read_presses, stated_poses
from train.data.presses import PressSet
from train.learning.contact_check import fit_classifier, limited
from train.networks.symmetric import moved_scans
from train.physics.sensor_noise import Nuisances

_DEPTHS: Final = (0.85, 1.15)
_ROUNDS: Final = 3
"""Readings of each sequence, each by another sensor, and half of them of mirror images."""
_PAIRS: Final = 6
"""Pairs of taps of each reading of a sequence."""
_WIDTHS: Final = (192, 96)
_WEIGHT_DECAY: Final = 0.1
_OFF_MM: Final = (1.5, 6.0)
_OFF_DEG: Final = (10.0, 90.0)
"""Bounds of the errors of a pose that is wrong, or a tap that is there although the pad did not move."""
_FAR: Final = 3.0
"""Errors of a pose that is wrong, in stated deviations at least."""
_USUAL: Final = (0.2, 1.0)
_MIRROR: Final = 4
"""Number of the mirror image, left for right, among the symmetries."""
_MIRRORED_POSE: Final = np.array([-1, 1, -1], dtype=np.float32)


def fit_tap_network(presses: PressSet, seed: int, steps: int) -> SmallNetwork:
    """Fit the network to pairs of taps at poses as stated, and to others."""
    rng = np.random.default_rng([seed, 7])
    right, wrong = [], []
    for number in range(_ROUNDS):
        readings, poses = _strong(presses, seed + number, mirror=number % 2 == 1)
        for newest, earlier in rng.permutation([*permutations(range(presses.taps), 2)])[:_PAIRS]:
            there = readings[:, [newest, earlier]].any(axis=(2, 3, 4)).min(axis=1)
            pair = readings[there][:, [newest, earlier]]
            pose = relative(poses[there, newest], poses[there, earlier])
            stated = stated_poses(rng, np.stack([np.zeros_like(pose), pose], axis=1))
            # What is astray in the network's training, by more than a few of its errors, is wrong here.
            off = np.abs(stated[:, 1, :3] - pose)
            near = (np.hypot(*off[:, :2].T) <= _FAR * stated[:, 1, 3]) & (off[:, 2] <= _FAR * stated[:, 1, 4])
            right.append(pair_features(pair[near], stated[near]))
            wrong += [pair_features(*one) for one in _wrong(rng, pair, pose, stated)]
    return fit_classifier(np.concatenate(right), np.concatenate(wrong), _WIDTHS, steps, seed, _WEIGHT_DECAY)


def tap_check(network: SmallNetwork, presses: PressSet, false_alarms: float, seed: int = 0) -> Check:
    """Return the check whose limit a share of the earlier taps of these presses exceeds, with usual errors of poses."""
    rng = np.random.default_rng([seed, 8])
    readings, poses = _strong(presses, seed)
    rows = []
    for earlier in range(1, presses.taps):
        there = readings[:, earlier].any(axis=(1, 2, 3))
        pair, pose = readings[there][:, [0, earlier]], poses[there][:, earlier]
        rows.append(pair_features(pair, stated_poses(rng, np.stack([np.zeros_like(pose), pose], axis=1), _USUAL)))
    return limited(network, np.concatenate(rows), false_alarms)


def pair_features(pairs: NDArray[np.float32], poses: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the features (n, inputs) of pairs of taps (n, 2, 3, rows, cols) in counts, with poses (n, 2, 5)."""
    none = np.empty((0, pair_width(int(np.prod(pairs.shape[2:])))), np.float32)
    return np.concatenate([none, *(pose_tap_features(*one) for one in zip(in_units(pairs), poses, strict=True))])


def relative(newest: NDArray[np.floating], earlier: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return poses (n, 3) of earlier taps in newer ones' axes, both in the axes of a third; see `PadPose.seen_from`."""
    turn = np.radians(newest[:, 2])
    x, y = (earlier[:, :2] - newest[:, :2]).T
    turned = (earlier[:, 2] - newest[:, 2] + 180) % 360 - 180
    cosine, sine = np.cos(turn), np.sin(turn)
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, turned], axis=1).astype(np.float32)


def _strong(presses: PressSet, seed: int, *, mirror: bool = False) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return windows (n, K, 3, rows, cols) in counts whose taps are strong enough or absent, and their poses."""
    readings, poses = read_presses(presses, Nuisances(), seed), presses.poses
    if mirror:
        readings, poses = moved_scans(readings, _MIRROR), poses * _MIRRORED_POSE
    there = presses.counts.any(axis=(2, 3, 4))
    strong = ((readings[:, :, 2].max(axis=(2, 3)) > LEAST_COUNTS) | ~there).all(axis=1)
    return readings[strong], poses[strong]


def _wrong(
    rng: np.random.Generator, pair: NDArray[np.float32], pose: NDArray[np.float32], stated: NDArray[np.float32]
) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Return pairs with another contact's tap, with a pose that is off, and with a pad that did not move."""
    foreign = np.stack([pair[:, 0], pair[rng.permutation(len(pair)), 1]], axis=1)
    way, sign = rng.uniform(0, 2 * np.pi, len(pair)), rng.choice([-1, 1], len(pair))
    far_mm = np.maximum(rng.uniform(*_OFF_MM, len(pair)), _FAR * stated[:, 1, 3])
    far_deg = np.maximum(rng.uniform(*_OFF_DEG, len(pair)), _FAR * stated[:, 1, 4])
    which = rng.random((len(pair), 2)) < (0.7, 0.4)
    which[~which.any(axis=1), 0] = True
    shifted = stated.copy()
    shifted[:, 1, 0] += np.where(which[:, 0], far_mm * np.cos(way), 0)
    shifted[:, 1, 1] += np.where(which[:, 0], far_mm * np.sin(way), 0)
    shifted[:, 1, 2] += np.where(which[:, 1], far_deg * sign, 0)
    depth = rng.uniform(*_DEPTHS, (len(pair), 1, 1, 1)).astype(np.float32)
    off_mm, off_deg = np.hypot(*pose[:, :2].T), np.abs(pose[:, 2])
    moved = off_mm > np.maximum(_OFF_MM[0], _FAR * stated[:, 1, 3])
    moved |= off_deg > np.maximum(_OFF_DEG[0], _FAR * stated[:, 1, 4])
    still = np.stack([pair[:, 0], np.rint(pair[:, 0] * depth)], axis=1)
    return [(foreign, stated), (pair, shifted), (still[moved], stated[moved])]
