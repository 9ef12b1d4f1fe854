"""Linear forward model of a sensor: readings that a pattern and its tangential traction make.

Made by train.trust from the simulated world, kept in the model's contract, in network units. It explains a contact
only in part, because pads, gains and large deformations differ; what it leaves is weighed by that.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.small_network import packed, unpacked
from firmware_bridge.pad_geometry import AXES

GRID: Final = 8
"""Cells of the pattern along a side: 2.35 mm. A wave finer than twice that loses 97 % of its amplitude in the layer."""
_CELLS: Final = GRID**2
KPA: Final = 30.0  # tangential traction that counts as 1, in [kPa]
_DRAG_GRID: Final = 4
"""Cells of the drag along a side in the contract; the traction has twice as many, and four of them share a weight."""
FEATURES: Final = _CELLS + 2 * _DRAG_GRID**2
_INPUTS: Final = 3 * _CELLS
_KEYS: Final = ("operator", "noise", "model_error")
_FORMER: Final = ("inverse", "spread", "unexplained", "limit")
"""Keys of earlier releases, of a limit for each model and of the pattern shown in place of one not to be believed."""


@dataclass(frozen=True)
class ForwardModel:
    """Operator from pattern and traction to the readings of a 4 x 4 sensor, linear in the pad's constants.

    Attributes:
        operator: (1 + p, 48, FEATURES), of the middle pad, then the change by one spread of each constant.
        noise: (3,), deviation of a reading of x, y, z from drift, field and noise.
        model_error: (3,), RMS of what the operator leaves of true patterns' readings, over their amplitude.
    """

    operator: NDArray[np.float32]
    noise: NDArray[np.float32]
    model_error: NDArray[np.float32]

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

        Readings count less where noise, drift, gains and the operator itself make them uncertain.

        Args:
            operator: of the pad.
            tap: (3, rows, cols) in network units.
            pattern: (H, W) in [mm].
            traction: (3, h, w) in [kPa].
            gain_error: standard deviation of the gains that remain.
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
        return {name: packed(getattr(self, name)) for name in _KEYS}


def forward_model(value: Any, constants: int) -> ForwardModel:
    """Return the forward model of a value that `ForwardModel.to_json` has made, for a model that takes `constants`.

    Raises:
        ValueError: it is none, or of other constants.
    """
    if not isinstance(value, dict) or set(value) - {*_FORMER} != {*_KEYS}:
        raise ValueError(f"expected {', '.join(_KEYS)}")
    arrays = {name: unpacked(value[name]) for name in _KEYS}
    readings = arrays["operator"].shape[1] if arrays["operator"].ndim > 1 else 0
    expected = {
        "operator": (1 + constants, readings, FEATURES),
        "noise": (len(AXES),),
        "model_error": (len(AXES),),
    }
    for name, shape in expected.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{name} is {arrays[name].shape}, expected {shape}")
    if not ((arrays["noise"] > 0).all() and (arrays["model_error"] > 0).all()):
        raise ValueError("noise and model_error, expected above 0")
    return ForwardModel(**arrays)


def features(pattern: NDArray[np.float32], traction: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return what a pad's operator is applied to: means of the pattern's cells, then the drag x, y in KPA."""
    inputs = np.empty(_INPUTS, dtype=np.float32)
    np.matmul(pooling(pattern.shape[0]) @ pattern, pooling(pattern.shape[1]).T, out=inputs[:_CELLS].reshape(GRID, GRID))
    np.multiply(traction[:2].reshape(-1), np.float32(1 / KPA), out=inputs[_CELLS:])
    return inputs


def condensed(inputs: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return features (n, inputs) with the means of four cells of the drag each, (n, FEATURES)."""
    drag = inputs[:, _CELLS:].reshape(len(inputs), 2, _DRAG_GRID, 2, _DRAG_GRID, 2).mean(axis=(3, 5))
    return np.concatenate([inputs[:, :_CELLS], drag.reshape(len(inputs), -1)], axis=1)


@lru_cache
def pooling(length: int, cells: int = GRID) -> NDArray[np.float32]:
    """Return the matrix (cells, length) of means over equal parts of a side."""
    edges = np.linspace(0, length, cells + 1)
    places = np.arange(length)
    share = np.minimum(edges[1:, None], places + 1) - np.maximum(edges[:-1, None], places)
    return (share.clip(0) / (length / cells)).astype(np.float32)
