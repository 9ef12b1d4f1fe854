"""Check that separates readings of contacts from others, and the training of the small networks of all checks."""

from itertools import pairwise
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional as F

from edge.inference.familiarity import Check, contact_features
from edge.inference.small_network import SmallNetwork, small_network
from edge.perception.contact_options import OFF_COUNTS
from edge.perception.pattern_check import LEAST_COUNTS
from train.data.batches import COUNTS_PER_UNIT
from train.data.press_batches import read_presses
from train.data.presses import PressSet
from train.learning.wrong_readings import spoiled
from train.networks.symmetric import symmetries
from train.physics.pad_draws import known_numbers
from train.physics.sensor_noise import Nuisances

_ROUNDS: Final = 5
"""Readings of each press."""
_WIDTHS: Final = (256, 128, 64)
_WEIGHT_DECAY: Final = 0.03
_CERTAINTIES: Final = (0.0, 0.0, 0.5, 0.8)
_BATCH: Final = 512
_LEARNING_RATE: Final = 4e-3
_LEAST_SPREAD: Final = 1e-3
_UNIT: Final = np.array(COUNTS_PER_UNIT, dtype=np.float32)[:, None, None]


def fit_contact_network(presses: PressSet, seed: int, steps: int) -> SmallNetwork:
    """Fit the network to presses read by sensors with gains more or less certain, and to the same, spoiled."""
    rng = np.random.default_rng([seed, 3])
    right, wrong = [], []
    for number in range(_ROUNDS):
        readings, pads = drawn_readings(presses, seed + number)
        strong = readings[:, 2].max(axis=(1, 2)) > LEAST_COUNTS
        readings, pads = moved(rng, readings[strong]), pads[strong]
        right.append(features_of(readings, pads))
        for _ in range(2):
            faulty, _ = spoiled(rng, readings)
            changed = (faulty != readings).any(axis=(1, 2, 3))
            wrong.append(features_of(faulty[changed], pads[changed]))
    return fit_classifier(np.concatenate(right), np.concatenate(wrong), _WIDTHS, steps, seed, _WEIGHT_DECAY)


def drawn_readings(presses: PressSet, seed: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return readings (n, 3, rows, cols) in counts by sensors of several certainties, and the pad inputs."""
    rng = np.random.default_rng([seed, 4])
    certainty = np.array(_CERTAINTIES, dtype=np.float32)[rng.integers(len(_CERTAINTIES), size=len(presses))]
    readings = np.empty(presses.counts[:, 0].shape, dtype=np.float32)
    for one in sorted(set(_CERTAINTIES)):
        part = certainty == np.float32(one)
        if part.any():
            nuisances = Nuisances(gain_spread=Nuisances().gain_spread * (1 - one))
            readings[part] = read_presses(presses.pick(part).with_taps(1), nuisances, int(rng.integers(2**62)))[:, 0]
    known = rng.random(presses.constants.shape) < rng.choice([0, 0, 0.5, 1], size=(len(presses), 1))
    return readings, known_numbers(presses.constants, known, certainty)


def features_of(counts: NDArray[np.float32], pads: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the features of readings (n, 3, rows, cols) in counts, with the pad inputs (n, p)."""
    return np.concatenate([contact_features(tap, pad) for tap, pad in zip(counts / _UNIT, pads, strict=True)])


def moved(rng: np.random.Generator, counts: NDArray[np.float32], *, mirror: bool = True) -> NDArray[np.float32]:
    """Turn each sequence of readings (n, ..., 3, rows, cols) as a whole, axes and all, and mirror half of them."""
    which = rng.integers(8 if mirror else 4, size=len(counts))
    result = counts.copy()
    for number, move in enumerate(symmetries("p4m")):
        part = which == number
        result[part] = _as_vectors(
            np.array(move(counts[part]), dtype=np.float32), turns=number % 4, mirrored=number >= 4
        )
    return result


def _as_vectors(maps: NDArray[np.float32], turns: int, *, mirrored: bool) -> NDArray[np.float32]:
    """Turn the axes x, y of maps (..., 3, rows, cols) with their places: x to the right, y down."""
    x, y = maps[..., 0, :, :].copy(), maps[..., 1, :, :].copy()
    if mirrored:
        x = -x
    for _ in range(turns):  # np.rot90 turns counter-clockwise: right becomes up, which is -y, and down becomes right
        x, y = y, -x
    maps[..., 0, :, :], maps[..., 1, :, :] = x, y
    return maps


def in_contact(counts: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which readings (n, 3, rows, cols) in counts the runtime checks: lighter ones would set limits by noise."""
    z = counts[:, 2]
    return (z.max(axis=(1, 2)) > LEAST_COUNTS) & (z.sum(axis=(1, 2)) >= OFF_COUNTS)


def limit_of(scores: NDArray[np.floating], false_alarms: float) -> float:
    """Return the score that a share of right rows exceeds."""
    return float(np.quantile(scores, 1 - false_alarms, method="higher"))


def contact_check(network: SmallNetwork, presses: PressSet, false_alarms: float, seed: int = 0) -> Check:
    """Return the check whose limit a share of these presses exceeds, read by sensors of several certainties."""
    readings, pads = drawn_readings(presses, seed)
    met = in_contact(readings)
    scores = network(features_of(readings[met], pads[met]))
    return Check(network, limit_of(np.array(scores), false_alarms))


def fit_classifier(
    right: NDArray[np.float32],
    wrong: NDArray[np.float32],
    widths: tuple[int, ...],
    steps: int,
    seed: int,
    weight_decay: float,
) -> SmallNetwork:
    """Fit a network whose output is the log odds of a wrong row, right and wrong ones being equally frequent.

    Args:
        right: (n, inputs).
        wrong: (m, inputs).
        widths: units of the layers in between.
        steps: of the optimizer.
        seed: of weights and order.
        weight_decay: of the optimizer; the fewer the rows, the more.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    centre = right.mean(axis=0)
    spread = right.std(axis=0) + _LEAST_SPREAD
    sides = [torch.from_numpy((rows - centre) / spread) for rows in (right, wrong)]
    sizes = [right.shape[1], *widths, 1]
    layers = [nn.Linear(a, b) for a, b in pairwise(sizes)]
    network = nn.Sequential(*(part for layer in layers for part in (layer, nn.ReLU())))[:-1]
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _LEARNING_RATE, total_steps=steps)
    truth = torch.cat([torch.zeros(_BATCH), torch.ones(_BATCH)])
    for _ in range(steps):
        rows = torch.cat([side[torch.from_numpy(rng.integers(len(side), size=_BATCH))] for side in sides])
        loss = F.binary_cross_entropy_with_logits(network(rows)[:, 0], truth)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    found = [(layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()) for layer in layers]
    # The features are centred and scaled by the first layer, so that the runtime has nothing to know of it.
    weights, offsets = found[0]
    found[0] = (weights / spread, offsets - (weights / spread) @ centre)
    rounded = SmallNetwork(found)
    return small_network(rounded.to_json())  # as the contract holds it
