"""Pad of a sensor from contacts that are all there already: as a running sensor learns, but over them several times."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.perception.gain_learning import ContactModel, GainLearner
from firmware_bridge.scans.pad_constants import Pad
from train.errors import DatasetError

PASSES: Final = 3


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
    return learned(counts, model).pad()
