"""Small fully connected network with one output, computed in numpy: a check that a session would cost more than."""

import base64
import binascii
import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

MOST_INPUTS: Final = 1024
MOST_LAYERS: Final = 4
MOST_UNITS: Final = 256


class SmallNetwork:
    """Layers with a rectifier between them, from a row of features to one number.

    Args:
        layers: weights (outputs, inputs) and offsets (outputs,) of each layer.

    Raises:
        ValueError: layers that do not follow each other, are too large, or do not end in one number.
    """

    def __init__(self, layers: Sequence[tuple[NDArray[np.floating], NDArray[np.floating]]]) -> None:
        if not 1 <= len(layers) <= MOST_LAYERS:
            raise ValueError(f"{len(layers)} layers, expected 1 to {MOST_LAYERS}")
        width = layers[0][0].shape[-1]
        if not 1 <= width <= MOST_INPUTS:
            raise ValueError(f"{width} inputs, expected 1 to {MOST_INPUTS}")
        self.inputs: Final = width
        self._layers = tuple(
            (weights.T.astype(np.float32, order="C"), offsets.astype(np.float32)) for weights, offsets in layers
        )
        for weights, offsets in self._layers:
            if weights.ndim != 2 or weights.shape != (width, len(offsets)) or len(offsets) > MOST_UNITS:
                raise ValueError(f"a layer of {weights.shape[::-1]} after {width} units, of at most {MOST_UNITS}")
            if not (np.isfinite(weights).all() and np.isfinite(offsets).all()):
                raise ValueError("a weight is not finite")
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
    """Return the network of a value that `SmallNetwork.to_json` has made.

    Raises:
        ValueError: it is none.
    """
    try:
        return SmallNetwork([(unpacked(layer["weights"]), unpacked(layer["offsets"])) for layer in value])
    except (TypeError, KeyError, IndexError) as error:
        raise ValueError(f"no list of layers ({error})") from error


def packed(values: NDArray[np.floating]) -> dict[str, Any]:
    """Return an array as JSON: its shape, and its numbers in half precision as base64."""
    half = np.ascontiguousarray(values, dtype="<f2")
    return {"shape": list(half.shape), "f2": base64.b64encode(half.tobytes()).decode()}


def unpacked(value: Any) -> NDArray[np.float32]:
    """Return the array of a value that `packed` has made.

    Raises:
        ValueError: the numbers are not as many as the shape needs, or not finite.
    """
    try:
        shape = [int(length) for length in value["shape"]]
        if not all(0 < length <= 1 << 16 for length in shape):
            raise ValueError(f"shape is {shape}")
        content = base64.b64decode(value["f2"], validate=True)
    except (TypeError, KeyError, OverflowError, binascii.Error) as error:
        raise ValueError(f"no packed array ({error})") from error
    if len(content) != 2 * math.prod(shape):
        raise ValueError(f"{len(content)} bytes for an array of {shape}")
    values = np.frombuffer(content, dtype="<f2").astype(np.float32).reshape(shape)
    if not np.isfinite(values).all():
        raise ValueError("a number is not finite")
    return values
