"""Forward model and checks that a model brings along, by which `edge.perception.trust_check` decides what to believe.

Two small networks tell whether any contact reads like that, by features that training and runtime make here. The
forward model gives the readings that a pattern makes: it explains a contact only in part, because pads, gains and large
deformations differ; what it leaves is weighed by that. train.trust makes all of it, in network units.
"""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import AXES


class SmallNetwork:
    """Layers of weights (outputs, inputs) and offsets (outputs,), rectified, from a row of features to one number."""

    def __init__(self, layers: Sequence[tuple[NDArray[np.floating], NDArray[np.floating]]]) -> None:
        width = layers[0][0].shape[-1]
        self.inputs: Final = width
        self._layers = tuple(
            (weights.T.astype(np.float32, order="C"), offsets.astype(np.float32)) for weights, offsets in layers
        )
        for weights, offsets in self._layers:
            if weights.shape != (width, *offsets.shape) or offsets.ndim != 1:
                raise ValueError(f"a layer of {weights.shape[::-1]} after {width} units")
            width = len(offsets)
        if width != 1:
            raise ValueError(f"{width} outputs, expected 1")

    def __call__(self, features: NDArray[np.float32]) -> list[float]:
        """Return the output for each row of features (n, inputs)."""
        rows = features
        for weights, offsets in self._layers[:-1]:
            rows = rows @ weights
            rows += offsets
            np.maximum(rows, 0.0, out=rows)
        weights, offsets = self._layers[-1]
        return (rows @ weights + offsets).ravel().tolist()

    def to_json(self) -> list[dict[str, Any]]:
        """Return the layers as JSON, in half precision."""
        return [{"weights": packed(weights.T), "offsets": packed(offsets)} for weights, offsets in self._layers]


def small_network(value: Any) -> SmallNetwork:
    """Return the network of `SmallNetwork.to_json`, or raise one of DAMAGE."""
    return SmallNetwork([(unpacked(layer["weights"]), unpacked(layer["offsets"])) for layer in value])


# Errors of reading what is no packed array, network or model.
DAMAGE: Final = (TypeError, KeyError, IndexError, ValueError, OverflowError, AttributeError)


def packed(values: NDArray[np.floating]) -> dict[str, Any]:
    """Return an array as JSON: shape, and numbers in half precision as base64."""
    half = np.ascontiguousarray(values, dtype="<f2")
    return {"shape": list(half.shape), "f2": base64.b64encode(half.tobytes()).decode()}


def unpacked(value: Any) -> NDArray[np.float32]:
    """Return the array of `packed`, or raise one of DAMAGE."""
    shape = [int(length) for length in value["shape"]]
    content = base64.b64decode(value["f2"], validate=True)
    if not all(length > 0 for length in shape) or len(content) != 2 * math.prod(shape):
        raise ValueError(f"{len(content)} bytes for an array of {shape}")
    values = np.frombuffer(content, dtype="<f2").astype(np.float32).reshape(shape)
    if not np.isfinite(values).all():
        raise ValueError("a number is not finite")
    return values


GRID: Final = 8  # cells of the pattern along a side: a wave finer than two loses 97 % of its amplitude in the pad
_CELLS: Final = GRID**2
KPA: Final = 30.0  # tangential traction that counts as 1, in [kPa]
_DRAG_GRID: Final = 4  # cells of the drag along a side; the traction has twice as many, four of which share a weight
FEATURES: Final = _CELLS + 2 * _DRAG_GRID**2


@dataclass(frozen=True)
class ForwardModel:
    """Operator from pattern and traction to the readings of a 4 x 4 sensor, linear in the pad's constants."""

    operator: NDArray[np.float32]  # (1 + p, 48, FEATURES), of the middle pad, then the change by a constant's spread
    noise: NDArray[np.float32]  # (3,), deviation of a reading of x, y, z from drift, field and noise
    model_error: NDArray[np.float32]  # (3,), RMS of what the operator leaves of true readings, over their amplitude

    def of_pad(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the operator of a pad for `features`, by its constants (p,) over their spread, 0 where unknown."""
        short = np.tensordot(values, self.operator[1:], 1) + self.operator[0]
        drag = short[:, _CELLS:].reshape(len(short), 2, _DRAG_GRID, 1, _DRAG_GRID, 1)
        spread = np.broadcast_to(drag / 4, (*drag.shape[:3], 2, _DRAG_GRID, 2)).reshape(len(short), -1)
        return np.concatenate([short[:, :_CELLS], spread], axis=1, dtype=np.float32)

    def mismatch(
        self,
        operator: NDArray[np.float32],
        tap: NDArray[np.float32],
        pattern: NDArray[np.float32],
        traction: NDArray[np.float32],
        gain_error: float,
    ) -> float:
        """Return the share of the energy of a tap's readings that its pattern leaves unexplained.

        Readings (3, rows, cols) in network units count less where noise, drift, the operator, and what remains of the
        gains make them uncertain. The pattern (H, W) is in [mm], the traction (3, h, w) in [kPa].
        """
        readings, z = tap.reshape(-1), tap[2].reshape(-1)
        energy = readings * readings
        weight = energy * np.float32(gain_error**2)
        noise, model_error = self._variances
        weight += model_error * np.float32((z @ z) / z.size) + noise
        np.reciprocal(weight, out=weight)
        left = operator @ features(pattern, traction)
        left -= readings
        left *= left
        return float(left @ weight) / max(float(energy @ weight), 1e-12)

    @cached_property
    def _variances(self) -> NDArray[np.float32]:
        """Variances (2, 48) of noise, and of the operator's error over the square of the amplitude."""
        return np.repeat(np.square([self.noise, self.model_error]), self.operator.shape[1] // len(AXES), axis=1)

    def to_json(self) -> dict[str, Any]:
        """Return the model as JSON."""
        return {field.name: packed(getattr(self, field.name)) for field in fields(self)}


def forward_model(value: Any, constants: int) -> ForwardModel:
    """Return the forward model of `ForwardModel.to_json` for so many constants, or raise one of DAMAGE."""
    arrays = {name: unpacked(packed_array) for name, packed_array in value.items()}
    model = ForwardModel(**arrays)
    expected = {
        "operator": (1 + constants, model.operator.shape[1], FEATURES),
        "noise": (len(AXES),),
        "model_error": (len(AXES),),
    }
    for name, shape in expected.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{name} is {arrays[name].shape}, expected {shape}")
    if not ((model.noise > 0).all() and (model.model_error > 0).all()):
        raise ValueError("noise and model_error, expected above 0")
    return model


def features(pattern: NDArray[np.float32], traction: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return what a pad's operator is applied to: means of the pattern's cells, then the drag x, y in KPA."""
    inputs = np.empty(3 * _CELLS, dtype=np.float32)
    np.matmul(pooling(pattern.shape[0]) @ pattern, pooling(pattern.shape[1]).T, out=inputs[:_CELLS].reshape(GRID, GRID))
    np.multiply(traction[:2].reshape(-1), np.float32(1 / KPA), out=inputs[_CELLS:])
    return inputs


def condensed(inputs: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return features (n, inputs) with the means of four cells of the drag each, (n, FEATURES)."""
    drag = inputs[:, _CELLS:].reshape(len(inputs), 2, _DRAG_GRID, 2, _DRAG_GRID, 2).mean(axis=(3, 5))
    return np.concatenate([inputs[:, :_CELLS], drag.reshape(len(inputs), -1)], axis=1)


@lru_cache
def pooling(length: int) -> NDArray[np.float32]:
    """Return the matrix (GRID, length) of means over equal parts of a side."""
    edges = np.linspace(0, length, GRID + 1)
    places = np.arange(length)
    share = np.minimum(edges[1:, None], places + 1) - np.maximum(edges[:-1, None], places)
    return (share.clip(0) / (length / GRID)).astype(np.float32)


QUIET_UNITS: Final = 0.02  # added to a scan's amplitude before the division by it: noise stays small
_MOST: Final = 12.0  # largest reading over the amplitude; a contact on one taxel alone has 4
PLACE_MM: Final = 5.0  # unit of a tap's place among features: about a taxel pitch
ERROR_UNITS: Final = np.array([1.0, 5.0], dtype=np.float32)  # of a pose's errors, in [mm] and [deg]: five usual ones
MOST_ERROR: Final = 5.0  # in these units: beyond it a pose states nothing
_POSE_FEATURES: Final = 6


@dataclass(frozen=True, slots=True)
class FamiliarityCheck:
    """Network that scores readings, and the score from which they are not believed."""

    network: SmallNetwork  # higher scores are less familiar
    limit: float  # score that one in 200 simulated contacts exceeds, and one in 100 earlier taps

    def to_json(self) -> dict[str, Any]:
        """Return the check as JSON."""
        return {"layers": self.network.to_json(), "limit": self.limit}


def check_of(value: Any) -> FamiliarityCheck:
    """Return the check of `FamiliarityCheck.to_json`, or raise one of DAMAGE."""
    if type(limit := value["limit"]) is not float or not math.isfinite(limit):
        raise ValueError(f"limit is {limit!r}, expected a number")
    return FamiliarityCheck(small_network(value["layers"]), limit)


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
    """Return the features (K - 1, inputs) of the earlier taps of a window in network units, each beside the newest one.

    They are the newest tap, its difference to the earlier one, the sizes of both, and the earlier tap's pose: place,
    cosine and sine of the turn, and the errors of both.
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
    """Put the readings of a tap, over its amplitude, into a row, and return the amplitude: the RMS of z, and a bit."""
    z = tap[2].ravel()
    size = math.sqrt(float(z @ z) / z.size) + QUIET_UNITS
    np.multiply(tap.reshape(-1), 1 / size, out=place)
    np.minimum(np.maximum(place, -_MOST, out=place), _MOST, out=place)  # np.clip takes four times as long on 48 numbers
    return size


@dataclass(frozen=True, slots=True)
class Trust:
    """Content of a model's contract under `trust`."""

    forward: ForwardModel  # explains readings by a pattern
    contact: FamiliarityCheck  # tells readings that a contact makes from others
    tap: FamiliarityCheck  # tells earlier taps of the same contact from others

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON."""
        return {"forward": self.forward.to_json(), "contact": self.contact.to_json(), "tap": self.tap.to_json()}


def trust_of(value: Any, constants: int) -> Trust | None:
    """Return the checks of `Trust.to_json` for so many constants, None if empty; raises ValueError for damage."""
    if value == {}:
        return None
    try:
        forward, contact, tap = (value[part] for part in ("forward", "contact", "tap"))
        forward, contact, tap = forward_model(forward, constants), check_of(contact), check_of(tap)
    except DAMAGE as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error
    readings = forward.operator.shape[1]
    for check, inputs in ((contact, readings + 1 + 2 * constants + 1), (tap, pair_width(readings))):
        if check.network.inputs != inputs:
            raise ValueError(f"a network takes {check.network.inputs} features, expected {inputs}")
    return Trust(forward, contact, tap)
