"""Limits of a model's checks, set on presses that nothing was trained on."""

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from edge.inference.familiarity import Check
from edge.inference.forward_model import forward_model
from edge.inference.small_network import small_network
from edge.inference.trust import Trust
from edge.perception.pattern_check import PatternCheck
from edge.perception.runtime import Model
from train.data.presses import PressSet
from train.errors import CheckpointError
from train.learning.contact_check import contact_check, drawn_readings, in_contact, limit_of
from train.learning.posed_tap_check import posed_tap_check
from train.learning.tap_check import tap_check
from train.physics.pad_draws import INPUTS

FALSE_ALARMS: Final = 0.01
"""Share of simulated contacts that are not believed: half of them unfamiliar, half unexplained."""


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
        contact = contact_check(small_network(self.fitted["contact"]), self.validation, FALSE_ALARMS / 2)
        tap = tap_check(small_network(self.fitted["tap"]), self.validation.only_turned(), FALSE_ALARMS)
        posed = posed_tap_check(small_network(self.fitted["posed_tap"]), self.validation, FALSE_ALARMS)
        return contact, tap, posed

    def of(self, model: Model) -> Trust:
        """Return forward model and checks for a model, the limit of the mismatch being that of its own patterns."""
        contact, tap, posed_tap = self._checks
        tap = posed_tap if model.contract.takes_poses else tap
        forward = forward_model(self.fitted["forward"], len(model.contract.pad_inputs))
        trust = Trust(forward, contact, tap)
        return replace(
            trust, forward=replace(forward, limit=limit_of(self._mismatches(model, trust), FALSE_ALARMS / 2))
        )

    def _mismatches(self, model: Model, trust: Trust) -> NDArray[np.float64]:
        """Return the mismatches of a model's patterns of one tap, on sensors of several certainties."""
        readings, pads = drawn_readings(self.validation, seed=1)
        met = in_contact(readings)
        return np.array([_mismatch(model, trust, *one) for one in zip(readings[met], pads[met], strict=True)])


def _mismatch(model: Model, trust: Trust, readings: NDArray[np.float32], pad: NDArray[np.float32]) -> float:
    contract: Contract = model.contract
    window = np.zeros((contract.taps, *readings.shape), dtype=np.float32)
    window[0] = readings
    window = contract.scale_window(window)
    pattern, traction = model.run(window, pad), model.traction
    check = PatternCheck(trust, contract)
    check.use_pad(pad)
    mismatch = check.judge(0, window[0], pattern, traction, 0).mismatch
    return 0.0 if mismatch is None else mismatch


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
