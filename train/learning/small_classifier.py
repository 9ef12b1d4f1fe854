"""Training of a small network that separates right rows of features from wrong ones."""

from itertools import pairwise
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional as F

from edge.inference.small_network import SmallNetwork, small_network

_BATCH: Final = 512
_LEARNING_RATE: Final = 4e-3
_LEAST_SPREAD: Final = 1e-3


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
