"""Checks of a contract: what its forward model leaves unexplained, and that no damaged one is taken."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from trust_samples import CONSTANTS, make_forward, make_trust, make_trusted_contract

from edge.api import Contract, ModelError
from edge.inference.trust_model import (
    GRID,
    KPA,
    SmallNetwork,
    condensed,
    contact_features,
    features,
    packed,
)

GAIN_ERROR = 0.075
DAMAGE = [
    ("tap", None),
    ("forward", "more", 1),
    ("forward", "operator", packed(np.ones((2 + CONSTANTS, 48, 96)))),  # for other constants
    ("forward", "noise", "shape", [math.inf]),
    ("forward", "noise", "f2", "AAAA"),  # bytes cut short
    ("forward", "noise", packed(np.array([1.0, 1.0, -1.0]))),
    ("contact", "limit", math.nan),
    ("contact", "layers", []),
    ("tap", make_trust().contact.to_json()),  # of other features
    ("contact", "layers", 0, "offsets", packed(np.full(1, np.inf))),
]


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_told_in_a_line_that_names_the_key(damage):
    *road, last, damaged = damage
    contract = make_trusted_contract()
    part: Any = contract.trust
    for step in road:
        part = part[step]
    part[last] = damaged
    with pytest.raises(ModelError, match="contract key 'trust' is damaged") as told:
        Contract.from_metadata(contract.to_metadata())
    assert "\n" not in str(told.value) and "export the model again" in str(told.value)


def layers(*widths):
    return [(np.ones((after, before)), np.ones(after)) for before, after in pairwise(widths)]


def test_layers_that_are_none_are_refused():
    for made, said in (([*layers(4, 3), *layers(4, 1)], "after 3 units"), (layers(4, 2), "2 outputs")):
        with pytest.raises(ValueError, match=said):
            SmallNetwork(made)


def make_maps():
    """Return a pattern in [mm] and a traction in [kPa], both even enough to be told apart by cells."""
    rng = np.random.default_rng(0)
    pattern = np.kron(rng.uniform(0, 0.5, (8, 8)), np.ones((5, 5))).astype(np.float32)
    traction = np.kron(rng.normal(0, 20, (3, 4, 4)), np.ones((1, 2, 2))).astype(np.float32)
    return pattern, traction


def test_readings_of_this_pad_alone_leave_nothing():
    forward, (pattern, traction) = make_forward(), make_maps()
    forward.operator[:] = np.random.default_rng(4).normal(0, 0.2, forward.operator.shape)
    operator, other = (forward.of_pad(np.full(CONSTANTS, value, dtype=np.float32)) for value in (0.7, 0.0))
    tap = (operator @ features(pattern, traction)).reshape(3, 4, 4).astype(np.float32)
    assert forward.mismatch(operator, tap, pattern, traction, GAIN_ERROR) == pytest.approx(0, abs=1e-9)
    assert forward.mismatch(other, tap, pattern, traction, 0) > 0.1
    assert forward.mismatch(operator, tap, 0 * pattern, 0 * traction, GAIN_ERROR) == pytest.approx(1)


def test_drag_is_condensed_to_means_and_large_readings_bounded():
    pattern, traction = make_maps()
    found = condensed(features(pattern, traction)[None])[0]
    assert found[GRID**2 :] == pytest.approx(traction[:2, ::2, ::2].ravel() / KPA, rel=1e-5)
    tap = np.zeros((3, 4, 4), dtype=np.float32)
    tap[0, 0, 0] = 1e6
    assert np.abs(contact_features(tap, np.ones(5, dtype=np.float32))[0, :48]).max() <= 12
