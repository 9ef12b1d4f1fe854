"""Contract between a trained model and the runtime, in the ONNX metadata; poses as model input; the model itself."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from types import MappingProxyType
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from edge.errors import ModelError
from edge.inference.intervals import is_confidence, is_number
from edge.inference.trust_model import Trust, trust_of
from firmware_bridge.pad_geometry import AXES, SensorGeometry
from firmware_bridge.poses import PLACE_ERROR_MM, TURN_ERROR_DEG, PadPose
from firmware_bridge.scans.pad_constants import LEVEL_90, PAD_RANGES, Pad

CONTRACT_VERSION: Final = 9
TAP_ORDER: Final = "newest first"
INPUT_NAME: Final = "window"
PAD_NAME: Final = "pad"
POSES_NAME: Final = "poses"
OUTPUT_NAME: Final = "pattern"
DEVIATION_NAME: Final = "deviation"
TRACTION_NAME: Final = "traction"
ANY_BATCH: Final = "any"  # first dimension of every input and output: any number of windows in one run
ANY_TAPS: Final = "taps"  # second dimension of window and poses of a graph that takes poses: 1 to K taps in one run
ARITHMETICS: Final = ("float32", "int8")
KEY_PREFIX: Final = "tactile."
MOST: Final = MappingProxyType({"taps": 64, "scale": 256, "rows": 64, "cols": 64})
MOST_PIXELS: Final = 1 << 20
LONGEST_VALUE: Final = 1 << 20  # most characters of a key's JSON; `trust` of a bundled model has a quarter of them
LONGEST_SHOWN: Final = 100
GAINS_CERTAINTY: Final = "gains_certainty"
POSE_KEYS: Final = ("dx_mm", "dy_mm", "turn_deg", "error_mm", "error_deg")  # of a row; the newest tap has zeros
POSE_WIDTH: Final = len(POSE_KEYS)
LEAST_UNIT: Final = 1e-6  # least divisor in counts, newtons or millimetres, so that float32 holds the quotient

Shape = tuple[Any, ...]  # of an input or output: a number for each dimension, or a name where it is free


@dataclass(frozen=True, slots=True)
class Contract:
    """Inputs, outputs and measured errors of a model; "The contract in a model" of docs/formats.md has each key."""

    version: int
    taps: int
    scale: int
    tap_order: str
    angle_step_deg: float
    counts_per_unit: tuple[float, float, float]
    output_unit: str
    output_full_scale: float
    contact_level: float
    sensor: str
    rows: int
    cols: int
    pitch_mm: float
    arithmetic: str
    interval_factor: float | None
    confidence: dict[str, dict[str, list[float]]]  # number of taps -> table as edge.inference.intervals takes it
    training_sha256: str
    test_set_sha256: str
    test_error: dict[str, dict[str, float]]  # number of taps -> metric; empty if the test set has another scale
    pad_inputs: tuple[tuple[str, float, float], ...] = ()
    takes_gains: bool = False
    traction_scale: int | None = None
    trust: dict[str, Any] = field(default_factory=dict)  # as edge.inference.trust_model reads it
    interval_levels: dict[str, list[float]] = field(default_factory=dict)  # percentage -> deviations for each region
    takes_poses: bool = False
    reach_mm: float = 0.0
    unposed_taps: int = 1
    made_for: dict[str, list[float]] = field(default_factory=dict)  # bounds of one sensor's pad; empty for any sensor

    @property
    def window_shape(self) -> Shape:
        """Shape of the window: a tap's x, y, z side by side; with poses (any, taps, 3, rows, cols)."""
        if self.takes_poses:
            return (ANY_BATCH, ANY_TAPS, len(AXES), self.rows, self.cols)
        return (ANY_BATCH, 3 * self.taps, self.rows, self.cols)

    @property
    def pattern_shape(self) -> tuple[int, int]:
        """Shape (H, W) of the pattern."""
        return (self.rows * self.scale, self.cols * self.scale)

    @property
    def pad_width(self) -> int:
        """Number of values that the model takes of each pad; 0 without pad input."""
        return 2 * len(self.pad_inputs) + self.takes_gains

    @property
    def nominal_counts_per_newton(self) -> float | None:
        """Summed z per [N] in the middle of the training's pads; None if the model does not take it."""
        return next((middle for name, middle, _ in self.pad_inputs if name == "counts_per_newton"), None)

    @property
    def traction_shape(self) -> tuple[int, int, int] | None:
        """Shape (3, h, w) of the traction x, y, z; None if the model gives none."""
        scale = self.traction_scale
        return None if scale is None else (len(AXES), self.rows * scale, self.cols * scale)

    @property
    def input_shapes(self) -> dict[str, Shape]:
        """Shapes of the graph's inputs by name."""
        shapes: dict[str, Shape] = {INPUT_NAME: self.window_shape}
        if self.takes_poses:
            shapes[POSES_NAME] = (ANY_BATCH, ANY_TAPS, POSE_WIDTH)
        if self.pad_width:
            shapes[PAD_NAME] = (ANY_BATCH, self.pad_width)
        return shapes

    @property
    def output_shapes(self) -> dict[str, Shape]:
        """Shapes of the graph's outputs by name."""
        shapes: dict[str, Shape] = {OUTPUT_NAME: (ANY_BATCH, *self.pattern_shape)}
        if self.interval_factor is not None:
            shapes[DEVIATION_NAME] = (ANY_BATCH, *self.pattern_shape)
        if self.traction_shape is not None:
            shapes[TRACTION_NAME] = (ANY_BATCH, *self.traction_shape)
        return shapes

    def to_metadata(self) -> dict[str, str]:
        """Return the contract as the string map of ONNX metadata."""
        return {KEY_PREFIX + key: json.dumps(value) for key, value in asdict(self).items()}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> "Contract":
        """Read and check a contract of this version, or raise a ModelError that names the key."""
        version = _value(metadata, "version")
        # Before the other keys, which another version may lack.
        if type(version) is not int or version != CONTRACT_VERSION:
            expected = f"expected {CONTRACT_VERSION}: export the model again with this release"
            raise ModelError(f"contract key 'version' is {_shown(version)}, {expected}")
        metadata = {f"{KEY_PREFIX}made_for": "{}", **metadata}  # which models of before lack
        values = {key.name: _value(metadata, key.name) for key in fields(cls)}
        _check(values)
        values["counts_per_unit"] = tuple(values["counts_per_unit"])
        values["pad_inputs"] = tuple(map(tuple, values["pad_inputs"]))
        return cls(**values)

    def check_sensor(self, geometry: SensorGeometry) -> None:
        """Raise a ModelError, which names the key, for a sensor that the model was not trained for."""
        for key, name in (("sensor", "name"), ("rows", "rows"), ("cols", "cols"), ("pitch_mm", "pitch_mm")):
            expected, got = getattr(self, key), getattr(geometry, name)
            if got != expected:
                raise ModelError(
                    f"contract key '{key}' is {expected!r}, but the sensor's is {got!r}: the model is for a "
                    f"{self.sensor} of {self.rows} x {self.cols} taxels, the sensor is a {geometry.name} of "
                    f"{geometry.rows} x {geometry.cols}; give a --model trained for it, or the sensor's own --id-map"
                )

    def read_trust(self) -> Trust | None:
        """Return the forward model and the checks; None if the model has none."""
        return trust_of(self.trust, len(self.pad_inputs))

    def scale_window(
        self, deformation_counts: NDArray[np.float32], gains: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Convert zeroed counts (taps, 3, rows, cols), over gains (3, rows, cols), to network input units."""
        divisor = np.asarray(self.counts_per_unit, dtype=np.float32)[None, :, None, None]
        return deformation_counts / (divisor if gains is None else divisor * gains)

    def pad_row(self, pad: Pad | None) -> NDArray[np.float32]:
        """Return a pad as model input (pad_width,); a constant whose interval is wide counts as unknown.

        It has for each of `pad_inputs` (value - centre) / spread, 0 if unknown; then 1 for each that is known, else 0;
        last, if the model takes gains, their certainty.
        """
        row = np.zeros(self.pad_width, dtype=np.float32)
        if pad is None:
            return row
        for index, (name, centre, spread) in enumerate(self.pad_inputs):  # of a constant in training
            if (value := pad.constants.get(name)) is None:
                continue
            low, high = pad.intervals.get(name, (value, value))
            if (high - low) / 2 / LEVEL_90 <= 0.4 * spread:
                row[index] = (value - centre) / spread
                row[len(self.pad_inputs) + index] = 1
        if self.takes_gains:
            row[-1] = pad.gains_certainty
        return row

    def is_outside(self, pad: Pad | None) -> bool:
        """Return whether a constant that the model takes, or its whole interval, is far outside the training."""
        constants = {} if pad is None else pad.constants | {GAINS_CERTAINTY: pad.gains_certainty}
        for name, (least, most) in self.made_for.items():
            low, high = (constants.get(name, math.nan),) * 2
            if pad is not None and name in pad.intervals:
                low, high = pad.intervals[name]
            if not (low <= most and high >= least):
                return True
        for name, centre, spread in self.pad_inputs:
            if pad is not None and name in pad.constants:
                low, high = pad.intervals.get(name, (pad.constants[name],) * 2)
                if max(low - centre, centre - high) > 1.5 * spread:
                    return True
        return False


def _value(metadata: Mapping[str, str], key: str) -> Any:
    text = metadata.get(KEY_PREFIX + key)
    if text is None:
        raise ModelError(f"contract key '{key}' is missing: not a model made by export, or an old one")
    if len(text) > LONGEST_VALUE:
        raise ModelError(f"contract key '{key}' has {len(text)} characters, expected at most {LONGEST_VALUE}")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ModelError(f"contract key '{key}' is {_shown(text)}, expected JSON") from error


def _shown(value: object) -> str:
    """Return a value as text short enough for a line."""
    text = repr(value)
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}..."


def _check(values: Mapping[str, Any]) -> None:
    for key, is_kept, expected in _rules(values):
        if not is_kept:
            raise ModelError(f"contract key '{key}' is {_shown(values[key])}, expected {expected}")
    try:
        trust = trust_of(values["trust"], len(values["pad_inputs"]))
        readings = len(AXES) * values["rows"] * values["cols"]
        if trust is not None and trust.forward.operator.shape[1] != readings:
            raise ValueError(f"for {trust.forward.operator.shape[1]} readings, the sensor has {readings}")
        if trust is not None and not values["takes_gains"]:
            raise ValueError("for a model that takes gains")
    except ValueError as error:
        raise ModelError(f"contract key 'trust' is damaged ({error}): export the model again") from error


def _rules(values: Mapping[str, Any]) -> Iterator[tuple[str, bool, str]]:
    """Yield a key, whether its value is lawful, and what is expected; a rule may rely on those before it."""
    for key, most in MOST.items():
        yield key, _is_whole(values[key], most), f"a whole number from 1 to {most}"
    taxels = values["rows"] * values["cols"]
    yield "scale", taxels * values["scale"] ** 2 <= MOST_PIXELS, f"patterns of at most {MOST_PIXELS} pixels"
    yield "tap_order", values["tap_order"] == TAP_ORDER, repr(TAP_ORDER)
    yield "arithmetic", values["arithmetic"] in ARITHMETICS, " or ".join(map(repr, ARITHMETICS))
    for key in ("output_full_scale", "pitch_mm", "contact_level"):
        yield key, _is_from(LEAST_UNIT, values[key]), f"a positive number from {LEAST_UNIT:g}"
    yield "contact_level", values["contact_level"] < 1, "a number below 1"
    yield "angle_step_deg", is_number(values["angle_step_deg"]), "a number"
    factor = values["interval_factor"]
    is_factor = factor is None or (is_number(factor) and factor > 0)
    yield "interval_factor", is_factor, "a positive number, or null for a model without deviations"
    tables = "for each number of taps `doubt`, `error` and `gain`, lists of equal length, `doubt` rising"
    yield "confidence", is_confidence(values["confidence"], values["taps"]), tables
    yield "interval_levels", isinstance(values["interval_levels"], dict), "a map from percentages to factors"
    units = values["counts_per_unit"]
    is_units = isinstance(units, list) and len(units) == 3 and all(_is_from(LEAST_UNIT, unit) for unit in units)
    yield "counts_per_unit", is_units, f"three positive numbers from {LEAST_UNIT:g}, for x, y, z"
    for key in ("output_unit", "sensor", "training_sha256", "test_set_sha256"):
        text = values[key]
        is_text = isinstance(text, str) and text.isprintable() and 0 < len(text) <= LONGEST_SHOWN
        yield key, is_text, f"a printable text of 1 to {LONGEST_SHOWN} characters"
    error = values["test_error"]
    is_error = isinstance(error, dict) and all(isinstance(metrics, dict) for metrics in error.values())
    yield "test_error", is_error, "a map from taps to metrics"
    inputs = values["pad_inputs"]
    expected = f"centre as a pad may have it, spread from {LEAST_UNIT:g}, names of: {', '.join(PAD_RANGES)}"
    is_inputs = isinstance(inputs, list) and all(map(_is_pad_input, inputs))
    yield "pad_inputs", is_inputs, f"a list of [name, centre, spread], {expected}"
    yield "pad_inputs", len({name for name, _, _ in inputs}) == len(inputs), "no name twice"
    for key in ("takes_gains", "takes_poses"):
        yield key, isinstance(values[key], bool), "true or false"
    scale, most = values["traction_scale"], MOST["scale"]
    is_scale = scale is None or _is_whole(scale, most)
    yield "traction_scale", is_scale, f"a whole number from 1 to {most}, or null for a model without traction"
    is_small = scale is None or len(AXES) * taxels * scale**2 <= MOST_PIXELS
    yield "traction_scale", is_small, f"tractions of at most {MOST_PIXELS} numbers"
    yield "unposed_taps", _is_whole(values["unposed_taps"], values["taps"]), "a whole number from 1 to `taps`"
    least_mm = LEAST_UNIT if values["takes_poses"] else 0
    reach = f"a number from {LEAST_UNIT:g} for a model that takes poses, else 0"
    yield "reach_mm", _is_from(least_mm, values["reach_mm"]), reach
    made_for = values["made_for"]
    is_made_for = isinstance(made_for, dict) and all(map(_are_bounds, made_for, made_for.values()))
    yield "made_for", is_made_for, f"a map to two numbers, of names of: {', '.join((*PAD_RANGES, GAINS_CERTAINTY))}"


def _is_whole(value: object, most: int) -> bool:
    return type(value) is int and 1 <= value <= most


def _is_from(least: float, value: object) -> bool:
    return is_number(value) and value >= least


def _are_bounds(name: object, value: Any) -> bool:
    if name not in (*PAD_RANGES, GAINS_CERTAINTY) or not isinstance(value, list) or len(value) != 2:
        return False
    return all(map(is_number, value)) and value[0] <= value[1]


def _is_pad_input(value: Any) -> bool:
    if not isinstance(value, list) or len(value) != 3 or not all(map(is_number, value[1:])):
        return False
    name, centre, spread = value
    low, high = PAD_RANGES.get(name, (1.0, 0.0)) if isinstance(name, str) else (1.0, 0.0)
    return low <= centre <= high and spread >= LEAST_UNIT


def pose_rows(poses: Sequence[PadPose]) -> NDArray[np.float32]:
    """Return the poses (taps, 5) of taps as model input; the first is the newest."""
    rows = np.zeros((len(poses), POSE_WIDTH), dtype=np.float32)
    for row, pose in zip(rows[1:], poses[1:], strict=True):
        seen = pose.seen_from(poses[0])
        row[:] = (seen.x_mm, seen.y_mm, seen.turn_deg, seen.error_mm, seen.error_deg)
    return rows


def scheduled_rows(taps: int, angle_step_deg: float) -> NDArray[np.float32]:
    """Return the poses (taps, 5) of taps by the paper's schedule: tap k before the newest is turned by k steps."""
    rows = np.zeros((taps, POSE_WIDTH), dtype=np.float32)
    turn_deg = angle_step_deg * np.arange(1, taps)
    rows[1:, 2] = (turn_deg + 180) % 360 - 180
    rows[1:, 3:] = PLACE_ERROR_MM, TURN_ERROR_DEG
    return rows


class Model(Protocol):
    """Model that is ready to run: a session, or a user's own."""

    name: str
    contract: Contract

    def run(
        self,
        window: NDArray[np.float32],
        pad: NDArray[np.float32] | None = None,
        poses: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """Return the pattern (H, W) of a window (taps, 3, rows, cols) in network input units, its pad and its poses."""
        ...

    def run_together(
        self,
        windows: Sequence[NDArray[np.float32]],
        pads: Sequence[NDArray[np.float32]] | None = None,
        poses: Sequence[NDArray[np.float32]] | None = None,
    ) -> NDArray[np.float32]:
        """Return the patterns (n, H, W) of several windows in one call."""
        ...

    @property
    def deviation(self) -> NDArray[np.float32] | None:
        """Standard deviation of each pixel of the last run's patterns, of their shape."""
        ...

    @property
    def traction(self) -> NDArray[np.float32] | None:
        """Traction (3, h, w) of the last run, (n, 3, h, w) of several windows, in [kPa]."""
        ...
