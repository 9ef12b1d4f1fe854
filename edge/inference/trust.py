"""Forward model and checks of a model, by which the runtime decides whether a pattern is to be believed.

Two small networks tell whether any contact reads like that, by features that training and runtime make here. They do
not depend on the force but for its size. Networks and limits travel in a model's contract.
"""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.forward_model import ForwardModel, forward_model
from edge.inference.small_network import SmallNetwork, small_network

QUIET_UNITS: Final = 0.02
"""Amplitude in network units, added to a scan's own before the division by it: noise stays small."""
_MOST: Final = 12.0  # largest reading over the amplitude; a contact on one taxel alone has 4
PLACE_MM: Final = 5.0  # unit of a tap's place among features: about a taxel pitch
ERROR_UNITS: Final = np.array([1.0, 5.0], dtype=np.float32)
"""Units of the errors of a pose among features, in [mm] and [deg]: five usual errors."""
MOST_ERROR: Final = 5.0  # largest error of a pose among features, in its unit: beyond it a pose states nothing
_POSE_FEATURES: Final = 6
_KEYS: Final = ("forward", "contact", "tap")


@dataclass(frozen=True, slots=True)
class Check:
    """Network that scores readings, and the score from which they are not believed."""

    network: SmallNetwork  # higher scores are less familiar
    limit: float  # score that one in a hundred simulated contacts exceeds

    def to_json(self) -> dict[str, Any]:
        """Return the check as JSON."""
        return {"layers": self.network.to_json(), "limit": self.limit}


def check_of(value: Any) -> Check:
    """Return the check of a value that `Check.to_json` has made.

    Raises:
        ValueError: it is none.
    """
    if not isinstance(value, dict) or set(value) != {"layers", "limit"}:
        raise ValueError("no check: expected layers and a limit")
    limit = value["limit"]
    if not isinstance(limit, float) or not math.isfinite(limit):
        raise ValueError(f"limit is {limit!r}, expected a number")
    return Check(small_network(value["layers"]), limit)


def amplitude(tap: NDArray[np.float32]) -> float:
    """Return the RMS of z of a tap (3, rows, cols) in network units, and a little more."""
    z = tap[2].ravel()
    return math.sqrt(float(z @ z) / z.size) + QUIET_UNITS


def contact_features(tap: NDArray[np.float32], pad_row: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the features (1, inputs) of one tap (3, rows, cols) in network units, with the model's pad input."""
    features = np.empty((1, tap.size + 1 + pad_row.size), dtype=np.float32)
    features[0, tap.size] = math.log(_put_shape(tap, features[0, : tap.size]))
    features[0, tap.size + 1 :] = pad_row
    return features


def pair_width(readings: int) -> int:
    """Return the number of features of a pair of taps with so many readings each."""
    return 2 * readings + 2 + _POSE_FEATURES


def pose_tap_features(window: NDArray[np.float32], poses: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the features (K - 1, inputs) of the earlier taps of a window, each beside the newest one.

    They are the newest tap, its difference to the earlier one, the sizes of both, and the earlier tap's pose: place,
    cosine and sine of the turn, and the errors of both.

    Args:
        window: (K, 3, rows, cols) in network units, newest tap first.
        poses: (K, 5), as edge.inference.pose_input makes them.
    """
    readings = window[0].size
    features = np.empty((len(window) - 1, pair_width(readings)), dtype=np.float32)
    newest, differences = features[:, :readings], features[:, readings : 2 * readings]
    features[:, 2 * readings] = math.log(_put_shape(window[0], newest[0]))
    newest[1:] = newest[0]
    for row, tap in enumerate(window[1:]):
        features[row, 2 * readings + 1] = math.log(_put_shape(tap, differences[row]))
    differences -= newest
    posed, earlier = features[:, -_POSE_FEATURES:], poses[1:]
    turn = np.radians(earlier[:, 2])
    np.multiply(earlier[:, :2], 1 / PLACE_MM, out=posed[:, :2])
    np.cos(turn, out=posed[:, 2])
    np.sin(turn, out=posed[:, 3])
    np.minimum(earlier[:, 3:] / ERROR_UNITS, MOST_ERROR, out=posed[:, 4:])
    return features


def _put_shape(tap: NDArray[np.float32], place: NDArray[np.float32]) -> float:
    """Put the readings of a tap, over its amplitude, into a row, and return the amplitude."""
    size = amplitude(tap)
    np.multiply(tap.reshape(-1), 1 / size, out=place)
    np.clip(place, -_MOST, _MOST, out=place)
    return size


@dataclass(frozen=True, slots=True)
class Trust:
    """Content of a model's contract under `trust`."""

    forward: ForwardModel  # explains readings by a pattern
    contact: Check  # tells readings that a contact makes from others
    tap: Check  # tells earlier taps of the same contact from others

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON."""
        return {name: getattr(self, name).to_json() for name in _KEYS}


def trust_of(value: Any, constants: int) -> Trust | None:
    """Return what `Trust.to_json` has made of it, for a model that takes so many constants; None if it is empty.

    Args:
        value: as read from a file.
        constants: of the pad that the model takes.

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
    expected = {"contact": (contact, readings + 1 + 2 * constants + 1), "tap": (tap, pair_width(readings))}
    for name, (check, inputs) in expected.items():
        if check.network.inputs != inputs:
            raise ValueError(f"{name} takes {check.network.inputs} features, expected {inputs}")
    return Trust(forward, contact, tap)
