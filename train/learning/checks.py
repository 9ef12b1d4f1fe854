"""Checks of readings and of earlier taps: their small networks and limits.

One tells readings of a contact from those that none makes: magnets near the pad, wrong maps and axes, taxels of another
contact, wrong gains. The other tells earlier taps of a contact from taps of another one or at another pose.
"""

from collections.abc import Callable
from itertools import pairwise, permutations
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional as F

from edge.inference.trust_model import (
    FamiliarityCheck,
    SmallNetwork,
    contact_features,
    pair_width,
    pose_tap_features,
    small_network,
)
from edge.perception.run_options import OFF_COUNTS
from edge.perception.trust_check import LEAST_COUNTS
from firmware_bridge.pad_geometry import USPA44
from train.data.press_batches import in_units, read_presses, stated_poses
from train.data.presses import PressSet
from train.networks.symmetric import moved_scans, symmetries
from train.physics.pad_draws import known_numbers
from train.physics.sensor_noise import Nuisances

_FAR_MM: Final = (25.0, 80.0)
# Largest count of a far magnet's field on the pad: from a tenth of a firm press to the end of the range of x and y.
_FIELD_COUNTS: Final = (150.0, 1500.0)
Counts = NDArray[np.float32]
Spoiling = Callable[[np.random.Generator, Counts], Counts]


def magnet_field(rng: np.random.Generator, count: int) -> Counts:
    """Draw the counts (n, 3, rows, cols) that far dipoles above the pad add, with moments that point anywhere."""
    ways = rng.standard_normal((2, count, 3))
    towards, moment = ways / np.linalg.norm(ways, axis=-1, keepdims=True)
    towards[:, 2] = np.abs(towards[:, 2])
    place_mm = towards * rng.uniform(*_FAR_MM, count)[:, None]
    centres_mm = USPA44.taxel_centres_mm().reshape(USPA44.rows, USPA44.cols, 2)
    chips = np.pad(centres_mm, [(0, 0), (0, 0), (0, 1)])
    away = chips - place_mm[:, None, None]
    length = np.linalg.norm(away, axis=-1, keepdims=True)
    away /= length
    along = (away * moment[:, None, None]).sum(axis=-1, keepdims=True)
    field = ((3 * away * along - moment[:, None, None]) / length**3).transpose(0, 3, 1, 2)
    field /= np.abs(field).max(axis=(1, 2, 3), keepdims=True)
    return (field * rng.uniform(*_FIELD_COUNTS, count)[:, None, None, None]).astype(np.float32)


def _near_magnet(rng: np.random.Generator, counts: Counts) -> Counts:
    free = rng.random((len(counts), 1, 1, 1)) < 0.25
    return np.where(free, np.float32(0), counts) + magnet_field(rng, len(counts))


def _rearranged(counts: Counts, order: NDArray[np.integer]) -> Counts:
    """Return readings with their taxels in another order, (n, taxels)."""
    flat = counts.reshape(*counts.shape[:2], -1)
    return np.take_along_axis(flat, order[:, None], axis=2).reshape(counts.shape)


def _shuffled(rng: np.random.Generator, counts: Counts) -> Counts:
    return _rearranged(counts, rng.random((len(counts), USPA44.taxel_count)).argsort(axis=1))


def _two_exchanged(rng: np.random.Generator, counts: Counts) -> Counts:
    rows, (first, second) = np.arange(len(counts)), rng.integers(USPA44.taxel_count, size=(2, len(counts)))
    order = np.tile(np.arange(USPA44.taxel_count), (len(counts), 1))
    order[rows, first], order[rows, second] = second, first
    return _rearranged(counts, order)


def _places_moved(rng: np.random.Generator, counts: Counts) -> Counts:
    """Turn or mirror the places of the taxels, but not their axes, as another id map does."""
    moves = symmetries("p4m")[1:]
    which = rng.integers(len(moves), size=len(counts))
    return np.stack([np.asarray(move(counts), np.float32) for move in moves])[which, np.arange(len(counts))]


def _axes_exchanged(rng: np.random.Generator, counts: Counts) -> Counts:
    orders = np.array([(1, 0, 2), (1, 0, 2), (2, 1, 0), (0, 2, 1)])
    return np.take_along_axis(counts, orders[rng.integers(len(orders), size=len(counts))][:, :, None, None], axis=1)


def _axes_turned(rng: np.random.Generator, counts: Counts) -> Counts:
    signs = np.array([(-1, 1, 1), (1, -1, 1), (-1, -1, 1)], dtype=np.float32)
    return counts * signs[rng.integers(len(signs), size=len(counts))][:, :, None, None]


def _one_of_another(rng: np.random.Generator, counts: Counts) -> Counts:
    """Let one taxel hold what it read in another contact, or its rest level."""
    spoiled = counts.reshape(*counts.shape[:2], -1).copy()
    rows, taxel = np.arange(len(counts)), rng.integers(spoiled.shape[2], size=len(counts))
    held = spoiled[rng.permutation(len(counts))][rows, :, taxel]
    at_rest = rng.random((len(counts), 1)) < 1 / 3
    spoiled[rows, :, taxel] = np.where(at_rest, np.float32(0), held)
    return spoiled.reshape(counts.shape)


def _half_of_another(rng: np.random.Generator, counts: Counts) -> Counts:
    mixed = rng.random((len(counts), 1, *counts.shape[2:])) < 0.5
    return np.where(mixed, counts[rng.permutation(len(counts))], counts)


def _wrong_gains(rng: np.random.Generator, counts: Counts) -> Counts:
    return (counts * (1 + 0.25 * rng.standard_normal(counts.shape))).astype(np.float32)


SPOILINGS: Final[tuple[Spoiling, ...]] = (
    *(_near_magnet, _shuffled, _two_exchanged, _places_moved, _axes_exchanged, _axes_turned),
    *(_one_of_another, _half_of_another, _wrong_gains),
)
"""Ways in which readings are wrong; each takes readings (n, 3, rows, cols) and leaves them as they are."""


def spoiled(rng: np.random.Generator, counts: Counts) -> Counts:
    """Return readings (n, 3, rows, cols) with one fault each."""
    which = rng.permutation(len(counts)) % len(SPOILINGS)
    wrong = counts.copy()
    for number, spoil in enumerate(SPOILINGS):
        wrong[which == number] = spoil(rng, counts[which == number])
    return wrong


_CERTAINTIES: Final = (0.0, 0.0, 0.5, 0.8)
_BATCH: Final = 512


def fit_contact_network(presses: PressSet, seed: int, steps: int) -> SmallNetwork:
    """Fit the network to presses read by sensors with gains more or less certain, and to the same, spoiled."""
    rng = np.random.default_rng([seed, 3])
    right, wrong = [], []
    for number in range(5):  # readings of each press
        readings, pads = drawn_readings(presses, seed + number)
        strong = readings[:, 2].max(axis=(1, 2)) > LEAST_COUNTS
        readings, pads = moved(rng, readings[strong]), pads[strong]
        right.append(features_of(readings, pads))
        for _ in range(2):
            faulty = spoiled(rng, readings)
            changed = (faulty != readings).any(axis=(1, 2, 3))
            wrong.append(features_of(faulty[changed], pads[changed]))
    sides = np.concatenate(right), np.concatenate(wrong)
    return fit_classifier(*sides, (256, 128, 64), steps, seed, 0.03)


def drawn_readings(presses: PressSet, seed: int) -> tuple[Counts, NDArray[np.float32]]:
    """Return readings (n, 3, rows, cols) in counts by sensors of several certainties, and the pad inputs."""
    rng = np.random.default_rng([seed, 4])
    certainty = np.array(_CERTAINTIES, dtype=np.float32)[rng.integers(len(_CERTAINTIES), size=len(presses))]
    readings = np.empty(presses.counts[:, 0].shape, dtype=np.float32)
    for level in sorted(set(_CERTAINTIES)):
        part = certainty == np.float32(level)
        if part.any():
            nuisances = Nuisances(gain_spread=Nuisances().gain_spread * (1 - level))
            readings[part] = read_presses(presses.pick(part).with_taps(1), nuisances, int(rng.integers(2**62)))[:, 0]
    stated = rng.random(presses.constants.shape) < rng.choice([0, 0, 0.5, 1], size=(len(presses), 1))
    return readings, known_numbers(presses.constants, stated, certainty)


def features_of(counts: Counts, pads: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the features of readings (n, 3, rows, cols) in counts, with the pad inputs (n, p)."""
    return np.concatenate([contact_features(tap, pad) for tap, pad in zip(in_units(counts), pads, strict=True)])


def moved(rng: np.random.Generator, counts: Counts) -> Counts:
    """Turn each reading of (n, 3, rows, cols), axes and all, and mirror half of them."""
    which = rng.integers(8, size=len(counts))
    result = counts.copy()
    for number in range(8):
        result[which == number] = moved_scans(counts[which == number], number)
    return result


def in_contact(counts: Counts) -> NDArray[np.bool_]:
    """Return which readings (n, 3, rows, cols) in counts the runtime checks: lighter ones would set limits by noise."""
    z = counts[:, 2]
    return (z.max(axis=(1, 2)) > LEAST_COUNTS) & (z.sum(axis=(1, 2)) >= OFF_COUNTS)


def _limited(network: SmallNetwork, features: NDArray[np.float32], false_alarms: float) -> FamiliarityCheck:
    scores = np.array(network(features))
    return FamiliarityCheck(network, float(np.quantile(scores, 1 - false_alarms, method="higher")))


def contact_check(network: SmallNetwork, presses: PressSet, false_alarms: float, seed: int = 0) -> FamiliarityCheck:
    """Return the check whose limit a share of these presses exceeds, read by sensors of several certainties."""
    readings, pads = drawn_readings(presses, seed)
    met = in_contact(readings)
    return _limited(network, features_of(readings[met], pads[met]), false_alarms)


_DEPTHS: Final = (0.85, 1.15)
_OFF_MM: Final = (1.5, 6.0)  # bounds of the error of a pose that is wrong, and of the way that a still pad did not go
_OFF_DEG: Final = (10.0, 90.0)
_FAR: Final = 3.0  # errors of a pose that is wrong, in stated deviations at least
_USUAL: Final = (0.2, 1.0)


def fit_tap_network(presses: PressSet, seed: int, steps: int) -> SmallNetwork:
    """Fit the network to pairs of taps at poses as stated, and to others."""
    rng = np.random.default_rng([seed, 7])
    right, wrong = [], []
    for number in range(3):  # readings of each sequence, each by another sensor, and half of them of mirror images
        readings, poses = strong_taps(presses, seed + number, mirror=number % 2 == 1)
        for newest, earlier in rng.permutation([*permutations(range(presses.taps), 2)])[:6]:
            there = readings[:, [newest, earlier]].any(axis=(2, 3, 4)).min(axis=1)
            pair = readings[there][:, [newest, earlier]]
            pose = relative(poses[there, newest], poses[there, earlier])
            stated = stated_poses(rng, np.stack([np.zeros_like(pose), pose], axis=1))
            # What is astray in the network's training, by more than a few of its errors, is wrong here.
            off = np.abs(stated[:, 1, :3] - pose)
            near = (np.hypot(*off[:, :2].T) <= _FAR * stated[:, 1, 3]) & (off[:, 2] <= _FAR * stated[:, 1, 4])
            right.append(pair_features(pair[near], stated[near]))
            wrong += [pair_features(*faulty) for faulty in _wrong(rng, pair, pose, stated)]
    return fit_classifier(np.concatenate(right), np.concatenate(wrong), (192, 96), steps, seed, 0.1)


def tap_check(network: SmallNetwork, presses: PressSet, false_alarms: float, seed: int = 0) -> FamiliarityCheck:
    """Return the check whose limit a share of the earlier taps of these presses exceeds, with usual errors of poses."""
    rng = np.random.default_rng([seed, 8])
    readings, poses = strong_taps(presses, seed)
    rows = []
    for earlier in range(1, presses.taps):
        there = readings[:, earlier].any(axis=(1, 2, 3))
        pair, pose = readings[there][:, [0, earlier]], poses[there][:, earlier]
        rows.append(pair_features(pair, stated_poses(rng, np.stack([np.zeros_like(pose), pose], axis=1), _USUAL)))
    return _limited(network, np.concatenate(rows), false_alarms)


def pair_features(pairs: Counts, poses: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the features (n, inputs) of pairs of taps (n, 2, 3, rows, cols) in counts, with poses (n, 2, 5)."""
    none = np.empty((0, pair_width(int(np.prod(pairs.shape[2:])))), np.float32)
    rows = [pose_tap_features(pair, pose) for pair, pose in zip(in_units(pairs), poses, strict=True)]
    return np.concatenate([none, *rows])


def relative(newest: NDArray[np.floating], earlier: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return poses (n, 3) of earlier taps in newer ones' axes, both in the axes of a third; see `PadPose.seen_from`."""
    turn = np.radians(newest[:, 2])
    x, y = (earlier[:, :2] - newest[:, :2]).T
    turned = (earlier[:, 2] - newest[:, 2] + 180) % 360 - 180
    cosine, sine = np.cos(turn), np.sin(turn)
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, turned], axis=1).astype(np.float32)


def strong_taps(presses: PressSet, seed: int, *, mirror: bool = False) -> tuple[Counts, NDArray[np.float32]]:
    """Return windows (n, K, 3, rows, cols) in counts whose taps are strong enough or absent, and their poses."""
    readings, poses = read_presses(presses, Nuisances(), seed), presses.poses
    if mirror:
        # Left for right.
        readings, poses = moved_scans(readings, 4), poses * np.array([-1, 1, -1], dtype=np.float32)
    there = presses.counts.any(axis=(2, 3, 4))
    strong = ((readings[:, :, 2].max(axis=(2, 3)) > LEAST_COUNTS) | ~there).all(axis=1)
    return readings[strong], poses[strong]


def _wrong(
    rng: np.random.Generator, pair: Counts, pose: NDArray[np.float32], stated: NDArray[np.float32]
) -> list[tuple[Counts, NDArray[np.float32]]]:
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


def fit_classifier(
    right: NDArray[np.float32],
    wrong: NDArray[np.float32],
    widths: tuple[int, ...],
    steps: int,
    seed: int,
    weight_decay: float,
) -> SmallNetwork:
    """Fit a network from rows (n, inputs) to the log odds of a wrong one, right and wrong ones being equally frequent.

    `widths` are units of the layers in between; the fewer the rows, the more `weight_decay`.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    centre = right.mean(axis=0)
    spread = right.std(axis=0) + 1e-3
    sides = [torch.from_numpy((rows - centre) / spread) for rows in (right, wrong)]
    sizes = [right.shape[1], *widths, 1]
    layers = [nn.Linear(a, b) for a, b in pairwise(sizes)]
    network = nn.Sequential(*(part for layer in layers for part in (layer, nn.ReLU())))[:-1]
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, total_steps=steps)
    truth = torch.cat([torch.zeros(_BATCH), torch.ones(_BATCH)])
    for _ in range(steps):
        rows = torch.cat([side[torch.from_numpy(rng.integers(len(side), size=_BATCH))] for side in sides])
        loss = F.binary_cross_entropy_with_logits(network(rows)[:, 0], truth)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    fitted = [(layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()) for layer in layers]
    # The features are centred and scaled by the first layer, so that the runtime has nothing to know of it.
    weights, offsets = fitted[0]
    fitted[0] = (weights / spread, offsets - (weights / spread) @ centre)
    return small_network(SmallNetwork(fitted).to_json())  # as the contract holds it
