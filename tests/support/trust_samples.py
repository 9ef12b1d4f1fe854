"""Checks with closed forms for the fake model: its patterns explain their readings, and what is foreign is plain."""

import numpy as np
from edge_samples import make_pad_contract

from edge.inference.contract import POSE_WIDTH, Contract
from edge.inference.trust_model import (
    FEATURES,
    GRID,
    KPA,
    PLACE_MM,
    FamiliarityCheck,
    ForwardModel,
    SmallNetwork,
    Trust,
    pair_width,
)

CONSTANTS = 2
UNFAMILIAR = 0.5
"""Reading of x on taxel 0, over the amplitude of z, from which the sample's contacts are not familiar."""
FOREIGN_TAXEL = 5


def linear(inputs: int, weights: dict[int, float]) -> SmallNetwork:
    """Return a network that sums some features."""
    row = np.zeros((1, inputs))
    for index, weight in weights.items():
        row[0, index] = weight
    return SmallNetwork([(row, np.zeros(1))])


def make_forward() -> ForwardModel:
    """Return the forward model of the tiny model: z is the mean of a taxel's pixels, x and y that of its traction."""
    operator = np.zeros((1 + CONSTANTS, 48, FEATURES), dtype=np.float32)
    cells = np.kron(np.eye(16).reshape(16, 4, 4), np.ones((1, 2, 2))).reshape(16, GRID**2)
    operator[0, 32:, : GRID**2] = cells / 4
    operator[0, :32, GRID**2 :] = KPA * np.eye(32)
    return ForwardModel(
        operator=operator, noise=np.full(3, 0.03125, dtype=np.float32), model_error=np.full(3, 0.125, dtype=np.float32)
    )


def make_trust() -> Trust:
    """Return checks: x on taxel 0 is unfamiliar, and so is an earlier tap that was less on the newest one's taxel 5."""
    contact = FamiliarityCheck(linear(48 + 1 + 2 * CONSTANTS + 1, {0: 10.0}), 10 * UNFAMILIAR)
    tap = FamiliarityCheck(linear(pair_width(48), {48 + 32 + FOREIGN_TAXEL: -4.0}), 2.0)
    return Trust(make_forward(), contact, tap)


def make_posed_trust(farthest_mm: float) -> Trust:
    """Return checks of a model that takes poses: an earlier tap belongs up to a distance along x."""
    trust = make_trust()
    width = pair_width(48)
    tap = FamiliarityCheck(linear(width, {width - POSE_WIDTH - 1: 20 * PLACE_MM}), 20 * farthest_mm)
    return Trust(trust.forward, trust.contact, tap)


def make_trusted_contract(**changes) -> Contract:
    """Return the contract of the fake model with these checks."""
    return make_pad_contract(
        **({"trust": make_trust().to_json(), "interval_factor": 1.6, "output_full_scale": 10.0} | changes)
    )


def make_checked_contract(trust: Trust) -> Contract:
    """Return the contract of a model that takes a pad and poses, with such checks."""
    return make_pad_contract(taps=7, takes_poses=True, reach_mm=10.0, trust=trust.to_json())
