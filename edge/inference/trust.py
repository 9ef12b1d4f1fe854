"""Forward model and checks of a model, by which the runtime decides whether a pattern is to be believed."""

from dataclasses import dataclass
from typing import Any, Final

from edge.inference.familiarity import Check, check_of, pair_width
from edge.inference.forward_model import ForwardModel, forward_model

_KEYS: Final = ("forward", "contact", "tap")


@dataclass(frozen=True, slots=True)
class Trust:
    """Content of a model's contract under `trust`.

    Attributes:
        forward: explains readings by a pattern.
        contact: tells readings that a contact makes from others.
        tap: tells earlier taps of the same contact from others.
    """

    forward: ForwardModel
    contact: Check
    tap: Check

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON."""
        return {name: getattr(self, name).to_json() for name in _KEYS}


def trust_of(value: Any, constants: int, *, poses: bool = False) -> Trust | None:
    """Return what `Trust.to_json` has made of it, for a model that takes so many constants; None if it is empty.

    Args:
        value: as read from a file.
        constants: of the pad that the model takes.
        poses: True for a model that takes poses, whose check of earlier taps takes them, too.

    Raises:
        ValueError: it is damaged, or of other constants; the message names the part.
    """
    if value == {}:
        return None
    if not isinstance(value, dict) or set(value) != set(_KEYS):
        raise ValueError(f"expected {', '.join(_KEYS)}, or nothing")
    forward = forward_model(value["forward"], constants)
    contact, tap = check_of(value["contact"]), check_of(value["tap"])
    readings = forward.operator.shape[1]
    expected = {"contact": (contact, readings + 1 + 2 * constants + 1), "tap": (tap, pair_width(readings, poses=poses))}
    for name, (check, inputs) in expected.items():
        if check.network.inputs != inputs:
            raise ValueError(f"{name} takes {check.network.inputs} features, expected {inputs}")
    return Trust(forward, contact, tap)
