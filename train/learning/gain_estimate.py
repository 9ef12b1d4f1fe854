"""Pad of a sensor from contacts that are all there already: as a running sensor learns, but over them several times."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.perception.gain_learning import ContactModel, GainLearner
from firmware_bridge.scans.pad_constants import LEVEL_90, PAD_RANGES, Pad
from train.errors import DatasetError
from train.learning.contact_mixture import CONSTANTS
from train.physics.pad_draws import RANGES

PASSES: Final = 3
TOLD: Final = 0.7
"""Largest deviation of a constant that counts as determined, over that of its prior."""
CONSTANT_SPREAD: Final = 1 / np.sqrt(3)
"""Prior deviation of a constant over half of its range: uniform within it."""


def learned(counts: NDArray[np.floating], model: ContactModel, passes: int = PASSES) -> GainLearner:
    """Return the learner after several passes over contacts (n, 3, rows, cols), zeroed, each that differs once a pass.

    Raises:
        DatasetError: no contact is strong enough.
    """
    learner = GainLearner(model)
    for number in range(passes):
        if number:
            learner = learner.again()
        for contact in counts:
            learner.learn(contact)
        learner.solve()
    if not learner.contacts:
        raise DatasetError(
            f"none of {len(counts)} contacts is strong and unclipped: press so that z exceeds 200 counts"
        )
    return learner


def pad_of(counts: NDArray[np.floating], model: ContactModel) -> Pad:
    """Return gains with half widths, and constants with intervals where they are determined, from contacts.

    Raises:
        DatasetError: no contact is strong enough.
    """
    return pad_learned(learned(counts, model))


def pad_learned(learner: GainLearner) -> Pad:
    """Return a learner's pad; constants that are as open as in a simulated world are left out."""
    gains = learner.pad()
    constants: dict[str, float] = {}
    intervals: dict[str, tuple[float, float]] = {}
    for name, told, value, deviation in zip(
        CONSTANTS, determined(learner), learner.constants, learner.constant_deviations, strict=True
    ):
        if told and name in PAD_RANGES:
            low, high = RANGES[name]
            ends = np.clip(value + LEVEL_90 * deviation * np.array([-1, 1]), -1, 1)
            at = [float(f"{low + (one + 1) / 2 * (high - low):.4g}") for one in (value, *ends)]
            constants[name], intervals[name] = at[0], (at[1], at[2])
    return Pad(**constants, intervals=intervals, gains=gains.gains, gain_half_widths=gains.gain_half_widths)


def determined(learner: GainLearner) -> NDArray[np.bool_]:
    """Return which constants (p,) are well within the prior, and not at an end of the range."""
    narrow = learner.constant_deviations < TOLD * CONSTANT_SPREAD
    return narrow & (np.abs(learner.constants) < 1)
