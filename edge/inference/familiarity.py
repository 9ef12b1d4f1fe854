"""Features of a contact's readings by which small networks tell whether any contact reads like that.

The features do not depend on the force but for its size. Training and runtime make them here, so that both see the
same; the networks and their limits travel in a model's contract.
"""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.small_network import SmallNetwork, small_network

QUIET_UNITS: Final = 0.02
"""Amplitude in network units, added to a scan's own before the division by it: noise stays small."""
_MOST: Final = 12.0
"""Largest reading over the amplitude; a contact on one taxel alone has 4."""


@dataclass(frozen=True, slots=True)
class Check:
    """Network that scores readings, and the score from which they are not believed.

    Attributes:
        network: higher scores are less familiar.
        limit: score that one in a hundred simulated contacts exceeds.
    """

    network: SmallNetwork
    limit: float

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
    """Return the features of one tap (3, rows, cols) in network units, with the model's pad input."""
    size = amplitude(tap)
    features = np.empty(tap.size + 1 + pad_row.size, dtype=np.float32)
    shape = features[: tap.size]
    np.multiply(tap.reshape(-1), 1 / size, out=shape)
    np.clip(shape, -_MOST, _MOST, out=shape)
    features[tap.size] = math.log(size)
    features[tap.size + 1 :] = pad_row
    return features


def tap_features(newest: NDArray[np.float32], earlier: NDArray[np.float32], steps: int) -> NDArray[np.float32]:
    """Return the features of an earlier tap beside the newest one, both (3, rows, cols) in network units.

    Args:
        newest: the tap that goes on.
        earlier: the tap that should be of the same contact.
        steps: turns of the schedule between them.
    """
    sizes = amplitude(newest), amplitude(earlier)
    features = np.empty(2 * newest.size + 4, dtype=np.float32)
    one, difference = features[: newest.size], features[newest.size : 2 * newest.size]
    np.multiply(newest.reshape(-1), 1 / sizes[0], out=one)
    np.multiply(earlier.reshape(-1), 1 / sizes[1], out=difference)
    np.clip(features[: 2 * newest.size], -_MOST, _MOST, out=features[: 2 * newest.size])
    difference -= one
    features[2 * newest.size :] = (math.log(sizes[0]), math.log(sizes[1]), steps, steps * steps)
    return features
