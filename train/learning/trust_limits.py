"""Limits of the checks that a model's contract holds, set on presses that nothing was trained on."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from edge.inference.contract import Contract
from edge.inference.familiarity import Check
from edge.inference.forward_model import forward_model
from edge.inference.small_network import small_network
from edge.inference.trust import Trust
from train.data.presses import PressSet
from train.errors import CheckpointError
from train.learning.contact_check import contact_check
from train.learning.tap_checks import posed_tap_check, tap_check
from train.physics.pad_draws import INPUTS

UNFAMILIAR: Final = 0.005
"""Share of simulated contacts whose readings are said to be those of no contact."""
FOREIGN: Final = 0.01
"""Share of earlier taps that are dropped although they belong."""


@dataclass(frozen=True)
class TrustFit:
    """Forward model and checks of `train.trust`, and presses to set their limits by.

    Attributes:
        fitted: content of trust.json.
        validation: presses of several taps, on pads of their own.
    """

    fitted: dict[str, Any]
    validation: PressSet

    @cached_property
    def _checks(self) -> tuple[Check, Check, Check]:
        contact = contact_check(small_network(self.fitted["contact"]), self.validation, UNFAMILIAR)
        tap = tap_check(small_network(self.fitted["tap"]), self.validation.only_turned(), FOREIGN)
        posed = posed_tap_check(small_network(self.fitted["posed_tap"]), self.validation, FOREIGN)
        return contact, tap, posed

    def of(self, contract: Contract) -> Trust:
        """Return forward model and checks for a model of that contract, the same for all but for those of taps."""
        contact, tap, posed_tap = self._checks
        forward = forward_model(self.fitted["forward"], len(contract.pad_inputs))
        return Trust(forward, contact, posed_tap if contract.takes_poses else tap)


def load_trust(path: Path, validation: PressSet) -> TrustFit:
    """Load the file of train.trust.

    Raises:
        CheckpointError: absent or damaged.
    """
    try:
        fitted = json.loads(path.read_text())
        forward_model(fitted["forward"], len(INPUTS))
        small_network(fitted["contact"])
        small_network(fitted["tap"])
        small_network(fitted["posed_tap"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise CheckpointError(f"{path}: {reason}; make it with 'python -m train.trust {path} --data ...'") from error
    return TrustFit(fitted, validation)
